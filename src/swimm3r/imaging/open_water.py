"""Open water: the pixels of an image that show no surface.

Such a region has no depth and next to no texture (the local standard deviation, after removing slopes, of any channel
in 7 x 7 pixels), is large, reaches the upper or a side edge of the image, is in its brightest channel brighter than
the darkest fifth of what has texture (veil only grows with distance; shadows and urchins are smooth, too), or, where it
is small, than half of it, and the surfaces at its rim are among the far ones: smooth sand has no depth either.
"""

import numpy as np
import torch
from jaxtyping import Bool, Float
from scipy import ndimage
from torch import Tensor

from swimm3r.imaging.filters import LUMA, blur, local_linear

_WINDOW = 7
_RIM = 9  # pixels around a region in which its neighbors are looked for
_FEW = 100  # pixels of known depth that decide nothing


def open_water_mask(
    image: Float[Tensor, "h w 3"],
    z_depth: Float[Tensor, "h w"],
    veil: Float[Tensor, "3"] | None = None,
    max_texture: float = 0.006,
    min_share: float = 0.02,
) -> Bool[Tensor, "h w"]:
    """True where the image shows water and nothing else; z_depth is 0 where unknown.

    Pixels within 0.05 of `veil`, the color of open water where it is known already, need not be bright, and regions of
    that color may be a tenth as large.
    """
    known = z_depth.numpy() > 0
    if not known.any():
        return torch.zeros_like(z_depth, dtype=torch.bool)
    smooth = local_texture(image).numpy() < max_texture
    crowded = _box(known.astype(np.float32), _RIM) > 0.1
    value = ndimage.gaussian_filter(image.numpy(), (1.0, 1.0, 0.0))
    textured = value[~smooth] if (~smooth).any() else value.reshape(-1, 3)

    def brighter_than(share: float) -> np.ndarray:
        """In the pixel's brightest channel, than this share of what has texture."""
        difference = value - np.quantile(textured, share, axis=0)
        return np.take_along_axis(difference, value.argmax(-1)[..., None], -1)[..., 0] >= 0

    bright, brightest = brighter_than(0.2), brighter_than(0.5)
    alike = np.zeros_like(bright)
    if veil is not None:
        alike = np.abs(value - veil.numpy()).max(-1) < 0.05
        bright |= alike
    candidates = np.asarray(ndimage.binary_opening(smooth & bright & ~crowded, iterations=3))
    labels = np.empty(candidates.shape, dtype=np.int32)
    ndimage.label(candidates, output=labels)
    found = np.zeros_like(candidates)
    middle = np.median(z_depth.numpy()[known])
    edge = 2 * _WINDOW
    reaching = {0, *np.unique(labels[:edge]), *np.unique(labels[:, :edge]), *np.unique(labels[:, -edge:])} - {0}
    for k in sorted(reaching):
        region = labels == k
        if alike[region].mean() > 0.5:
            needed = 0.1 * min_share
        else:
            needed = min_share if brightest[region].mean() > 0.5 else 5 * min_share
        if region.mean() < needed:
            continue
        rim = np.logical_and(ndimage.binary_dilation(region, iterations=2 * _RIM), known)
        if rim.sum() < _FEW or np.median(z_depth.numpy()[rim]) >= 0.8 * middle:
            found |= region
    return torch.from_numpy(_without_specks(found, known))


def sea_share(
    image: Float[Tensor, "h w 3"], z_depth: Float[Tensor, "h w"], veil: Float[Tensor, "3"] | None = None
) -> Float[Tensor, "h w"]:
    """Probability that a pixel shows water only: open water, or unknown depth of the same color; soft where hazy."""
    water = open_water_mask(image, z_depth, veil).float()
    if not water.any():
        return water
    reach = 0.02 * max(image.shape[:2])
    nearby = blur(water[..., None], reach)
    local = blur(water[..., None] * image, reach) / nearby.clamp(min=1e-6)
    away = (blur(image, 0.7) - local).square().sum(-1) / (2 * 0.02**2)
    hard = torch.maximum(torch.exp(-away) * (nearby[..., 0] > 1e-3), water)
    guide = blur(image @ LUMA[:, None], 0.7)[..., 0]
    soft = local_linear(guide, hard[..., None], torch.ones_like(hard)[..., None], reach / 2, 2e-5)[..., 0]
    share = blur(torch.maximum(soft, hard)[..., None], reach / 5)[..., 0]
    return torch.where(z_depth > 0, 0.0, share.clamp(0, 1))


def _without_specks(found: np.ndarray, known: np.ndarray) -> np.ndarray:
    """Drifting particles inside open water belong to it: holes without depth below 1 % of the image are closed."""
    closed = np.asarray(ndimage.binary_closing(found, iterations=3)) | found
    holes = np.empty(found.shape, dtype=np.int32)
    ndimage.label(~closed, output=holes)
    size = np.bincount(holes.ravel())
    has_depth = np.bincount(holes.ravel(), known.ravel()) > 0
    return (closed | ((size < 0.01 * found.size) & ~has_depth)[holes]) & ~known


def local_texture(image: Float[Tensor, "h w 3"]) -> Float[Tensor, "h w"]:
    """Standard deviation in a small window, after removing pixel noise and the slope of brightness."""
    value = ndimage.gaussian_filter(image.numpy(), (1.0, 1.0, 0.0))
    detail = value - _box(value, 3 * _WINDOW)
    return torch.from_numpy(np.sqrt(_box(detail**2, _WINDOW).max(-1).clip(0)))


def _box(x: np.ndarray, window: int) -> np.ndarray:
    """Mean over a square window, per channel."""
    for axis in (0, 1):
        x = ndimage.uniform_filter1d(x, window, axis=axis)
    return x
