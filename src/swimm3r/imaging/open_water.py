"""Open water: the pixels of an image that show no surface.

Such a region has no depth and next to no texture (the local standard deviation, after removing slopes, of any channel
in 7 x 7 pixels), is large, reaches the upper or a side edge of the image, is in its brightest channel brighter than
the darkest fifth of what has texture (veil only grows with distance; shadows and urchins are smooth, too), or, where it
is small, than half of it, and the surfaces at its rim are among the far ones: smooth sand has no depth either.
"""

from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Bool, Float
from torch import Tensor

from swimm3r.imaging.filters import blur, local_linear

_WINDOW = 7
_RIM = 9  # pixels around a region in which its neighbors are looked for
_SAMPLES = 50_000  # pixels whose quantiles stand for all
_SPILL = 0.02  # of the longer side, how far depth spills over silhouettes
_NEARBY = 1e-3  # share of open water around a pixel, from which its own colors are the measure
_WEDGE = 4  # times the distance of open water nearby, to which a wedge between silhouettes reaches
_WEDGE_STD = 0.006  # of colors of open water there, at most: where they vary more, they tell nothing from afar
_BRIGHT = 0.5  # open water under a lamp, in its brightest channel, from which colors count as in daylight
_SEA_STD = 0.004  # of the colors of open water about their local mean, at least
_WATER_STD, _SURFACE_STD = 0.01, 0.03  # of colors about their local mean, at least
_FEW = 100  # pixels of known depth that decide nothing


def open_water_mask(
    image: Float[Tensor, "h w 3"],
    z_depth: Float[Tensor, "h w"],
    veil: Float[Tensor, "*#image 3"] | None = None,
    max_texture: float = 0.006,
    min_share: float = 0.02,
) -> Bool[Tensor, "h w"]:
    """True where the image shows water and nothing else; z_depth is 0 where unknown.

    Pixels within 0.05 of `veil`, the color of open water where it is known already, need not be bright, and regions of
    that color may be a tenth as large. A veil that differs from pixel to pixel is that of a lamp on the camera, whose
    light falls off on the way, too: the darker it is, the closer to it colors have to be, and the less texture tells
    far surfaces.
    """
    known = z_depth.numpy() > 0
    if not known.any():
        return torch.zeros_like(z_depth, dtype=torch.bool)
    value = _without_pixel_noise(image.numpy())
    off = 0.05
    if veil is not None and veil.dim() > 1:
        share = min(1.0, float(veil.max()) / _BRIGHT)
        off, max_texture = share * off, share * max_texture
    smooth = _texture(value) < max_texture
    crowded = _box(known.astype(np.float32), _RIM) > 0.1
    textured = value[~smooth] if (~smooth).any() else value.reshape(-1, 3)
    few = textured[:: max(1, len(textured) // _SAMPLES)]
    fifth, half = np.quantile(few, [0.2, 0.5], axis=0).astype(np.float32)
    brightness = _largest(value)
    leading = np.where(value[..., 0] == brightness, 0, np.where(value[..., 1] == brightness, 1, 2))  # brightest channel
    bright, brightest = brightness >= fifth[leading], brightness >= half[leading]
    alike = np.zeros_like(bright)
    if veil is not None:
        alike = _largest(np.abs(value - veil.numpy())) < off
        bright |= alike
    labels = _pieces(_dilated(_eroded(smooth & bright & ~crowded, 3), 3))
    found = np.zeros(labels.shape, dtype=bool)
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
        rim = _dilated(region, 2 * _RIM) & known
        if rim.sum() < _FEW or np.median(z_depth.numpy()[rim]) >= 0.8 * middle:
            found |= region
    return torch.from_numpy(_without_specks(found, known))


def sea_share(
    image: Float[Tensor, "h w 3"], z_depth: Float[Tensor, "h w"], veil: Float[Tensor, "*#image 3"] | None = None
) -> Float[Tensor, "h w"]:
    """Probability that a pixel shows water only: open water, or unknown depth of the same color; soft where hazy.

    Colors are compared with those of the open water nearby in units of their spread there, channel by channel: far
    rocks may stand out in one channel only. Farther from it, in wedges between silhouettes, pixels of the color of the
    wider surroundings are water where they are joined to it.
    """
    water = open_water_mask(image, z_depth, veil).float()
    if not water.any():
        return water
    reach = 0.02 * max(image.shape[:2])
    near, far = _Nearby.of(image, water, reach), _Nearby.of(image, water, reach, _WEDGE, _WEDGE_STD)
    known = z_depth > 0
    there = near.share > _NEARBY
    hard = torch.maximum(near.alike * there, water)
    wedge = _joined(hard > 0.5, ~there & ~known & (far.alike > 0.5))
    hard = torch.maximum(hard, far.alike * wedge)
    guide = torch.where(wedge, far.off, near.off)
    soft = local_linear(guide, hard[..., None], torch.ones_like(hard)[..., None], reach / 2, 2e-5)[..., 0]
    share = blur(torch.maximum(soft, hard)[..., None], reach / 5)[..., 0]
    return torch.where(known, 0.0, share.clamp(0, 1))


@dataclass(frozen=True)
class _Nearby:
    """Open water around each pixel, and the pixel beside its colors."""

    share: Float[Tensor, "h w"]  # of the surroundings
    off: Float[Tensor, "h w"]  # distance of the pixel's color from the mean color there
    alike: Float[Tensor, "h w"]  # 0..1, likelihood of the color over that of the mean color

    @classmethod
    def of(
        cls,
        image: Float[Tensor, "h w 3"],
        water: Float[Tensor, "h w"],
        reach: float,
        step: int = 1,
        most_std: float = np.inf,
    ) -> "_Nearby":
        """Within `step` times `reach`, by means over squares of `step` pixels; colors spread by `most_std` at most."""
        weight = water[..., None]
        share = _coarsely_blurred(weight, reach, step)
        total = share.clamp(min=1e-6)
        local = _coarsely_blurred(weight * image, reach, step) / total
        square = _coarsely_blurred(weight * image**2, reach, step) / total
        variance = ((square - local**2).clamp(min=0) + _SEA_STD**2).clamp(max=most_std**2)
        difference = blur(image, 0.7) - local
        alike = torch.exp(-(difference**2 / (2 * variance)).sum(-1))
        return cls(share[..., 0], difference.norm(dim=-1), alike)


def _coarsely_blurred(x: Float[Tensor, "h w c"], sigma: float, step: int) -> Float[Tensor, "h w c"]:
    """Gaussian blur by `step` times `sigma` of means over squares of `step` pixels, at the size of `x`."""
    import cv2

    if step == 1:
        return blur(x, sigma)
    h, w = x.shape[:2]
    small = cv2.resize(x.numpy(), (max(1, w // step), max(1, h // step)), interpolation=cv2.INTER_AREA)
    blurred = blur(torch.from_numpy(small.reshape(*small.shape[:2], -1)), sigma).numpy()
    return torch.from_numpy(cv2.resize(blurred, (w, h), interpolation=cv2.INTER_LINEAR).reshape(x.shape))


def _joined(seeds: Bool[Tensor, "h w"], others: Bool[Tensor, "h w"]) -> Bool[Tensor, "h w"]:
    """Those of the `others` that hang together with a seed."""
    pieces = _pieces((seeds | others).numpy())
    with_seed = np.zeros(pieces.max() + 1, dtype=bool)
    with_seed[pieces[seeds.numpy()]] = True
    return others & torch.from_numpy(with_seed[pieces])


def without_fringe(
    image: Float[Tensor, "h w 3"], z_depth: Float[Tensor, "h w"], veil: Float[Tensor, "*#image 3"] | None = None
) -> Float[Tensor, "h w"]:
    """The depth without that of surfaces which spilled over their silhouettes into open water.

    Depth from patches is a few pixels too wide around what stands before water without texture. Within that reach of
    open water, and joined to it, pixels whose color is more likely that of the water nearby than that of the surface
    farther in lose their depth.
    """
    water = sea_share(image, z_depth, veil) > 0.5
    if not bool(water.any()):
        return z_depth
    reach = max(3, round(_SPILL * max(image.shape[:2])))
    known = z_depth > 0
    near = torch.from_numpy(_dilated(water.numpy(), reach)) & ~water
    top, bottom, left, right = _bounds(near, 4 * reach)
    part = (slice(top, bottom), slice(left, right))
    smooth = blur(image[part], 0.7)
    of_water, of_surface = (
        _log_likelihood(smooth, image[part], of[part], 1.5 * reach, floor)
        for of, floor in ((water, _WATER_STD), (known & ~near & ~water, _SURFACE_STD))
    )
    likelier = torch.zeros_like(water)
    likelier[part] = near[part] & (of_water > of_surface)
    joined = water.numpy().copy()
    for _ in range(reach):
        joined |= _dilated(joined, 1) & likelier.numpy()
    return torch.where(torch.from_numpy(joined) & likelier & known, 0.0, z_depth)


def _bounds(mask: Bool[Tensor, "h w"], margin: int) -> tuple[int, int, int, int]:
    """Rows and columns around a mask's pixels; all of an empty one's."""
    rows, columns = torch.nonzero(mask.any(1))[:, 0], torch.nonzero(mask.any(0))[:, 0]
    if not len(rows):
        return 0, mask.shape[0], 0, mask.shape[1]
    low = [max(0, int(at[0]) - margin) for at in (rows, columns)]
    high = [int(at[-1]) + margin + 1 for at in (rows, columns)]
    return low[0], high[0], low[1], high[1]


def _log_likelihood(
    color: Float[Tensor, "h w 3"], image: Float[Tensor, "h w 3"], of: Bool[Tensor, "h w"], sigma: float, floor: float
) -> Float[Tensor, "h w"]:
    """Log density of colors under a normal distribution of the image's colors `of` which there are around."""
    weight = of.float()[..., None]
    total = blur(weight, sigma)
    mean = blur(weight * image, sigma) / total.clamp(min=1e-6)
    variance = (blur(weight * image**2, sigma) / total.clamp(min=1e-6) - mean**2).clamp(min=0) + floor**2
    density = -((color - mean) ** 2 / (2 * variance) + variance.log() / 2).sum(-1)
    return torch.where(total[..., 0] > 1e-4, density, -torch.inf)


def _without_specks(found: np.ndarray, known: np.ndarray) -> np.ndarray:
    """Drifting particles inside open water belong to it: holes without depth below 1 % of the image are closed."""
    closed = _eroded(_dilated(found, 3), 3) | found
    holes = _pieces(~closed)
    size = np.bincount(holes.ravel())
    has_depth = np.bincount(holes.ravel(), known.ravel()) > 0
    return (closed | ((size < 0.01 * found.size) & ~has_depth)[holes]) & ~known


def _without_pixel_noise(image: np.ndarray) -> np.ndarray:
    import cv2

    return cv2.GaussianBlur(image, (9, 9), 1.0, borderType=cv2.BORDER_REFLECT)


def _texture(value: np.ndarray) -> np.ndarray:
    detail = value - _box(value, 3 * _WINDOW)
    return np.sqrt(_largest(_box(detail**2, _WINDOW)).clip(0))


def _largest(value: np.ndarray) -> np.ndarray:
    """The largest of three channels; NumPy's own maximum along a short axis takes ten times as long."""
    return np.maximum(np.maximum(value[..., 0], value[..., 1]), value[..., 2])


def _box(x: np.ndarray, window: int) -> np.ndarray:
    """Mean over a square window, per channel."""
    import cv2

    return cv2.blur(x, (window, window), borderType=cv2.BORDER_REFLECT)


def _dilated(mask: np.ndarray, steps: int) -> np.ndarray:
    """The mask and all within `steps` of it, along rows and columns."""
    import cv2

    cross = cv2.getStructuringElement(cv2.MORPH_CROSS, (3, 3))
    return cv2.dilate(mask.astype(np.uint8), cross, iterations=steps) > 0


def _eroded(mask: np.ndarray, steps: int) -> np.ndarray:
    """The mask without all within `steps` of its outside, to which the image's border belongs."""
    import cv2

    cross = cv2.getStructuringElement(cv2.MORPH_CROSS, (3, 3))
    framed = cv2.copyMakeBorder(mask.astype(np.uint8), 1, 1, 1, 1, cv2.BORDER_CONSTANT, value=(0,))
    return cv2.erode(framed, cross, iterations=steps)[1:-1, 1:-1] > 0


def _pieces(mask: np.ndarray) -> np.ndarray:
    """The number of the connected piece that each pixel belongs to, 0 outside of the mask."""
    import cv2

    return cv2.connectedComponents(mask.astype(np.uint8), connectivity=4, ltype=cv2.CV_32S)[1]
