"""Clear colors of two visits in one light: gains of the later visit, and differences in CIELAB.

The value that a camera stores of a surface without its water is albedo times the light that reaches it times the
exposure. Light and exposure differ between visits by a factor per channel, the same for the whole site where its depth
varies little:

    g = exp median(log J_a - log J_b)   over ground of unchanged height,   J in linear light

The median is that of the unchanged majority; a bleached coral does not move it. A factor cannot tell a change of all of
the ground from a change of the light: colors are compared with those of the rest of the site.
"""

import numpy as np
import torch
from jaxtyping import Bool, Float, Float32

from swimm3r.medium import linear_from_srgb, srgb_from_linear

_LEAST_LIGHT = 0.004  # linear light below which the ratio of two colors is noise
_LEAST_CELLS = 50
_XYZ = np.array(
    [[0.4124564, 0.3575761, 0.1804375], [0.2126729, 0.7151522, 0.0721750], [0.0193339, 0.1191920, 0.9503041]]
)
_WHITE = _XYZ.sum(1)  # of linear RGB 1, 1, 1: D65
_POWER = 6  # of the norm whose tint is made gray, as restored images are (`sfm.medium.restore.display_gains`)


def light_gains(
    a: Float32[np.ndarray, "h w 3"], b: Float32[np.ndarray, "h w 3"], stable: Bool[np.ndarray, "h w"]
) -> tuple[Float[np.ndarray, "3"], Float[np.ndarray, "3"]]:
    """Factors on visit b's linear colors that bring them to the light of a, and their relative standard deviations.

    Ones, and infinite deviations, where too few cells show the same ground.
    """
    usable = stable & (a > _LEAST_LIGHT).all(-1) & (b > _LEAST_LIGHT).all(-1)
    if usable.sum() < _LEAST_CELLS:
        return np.ones(3), np.full(3, np.inf)
    ratio = np.log(a[usable].astype(np.float64)) - np.log(b[usable].astype(np.float64))
    middle = np.median(ratio, axis=0)
    spread = 1.4826 * np.median(np.abs(ratio - middle), axis=0)
    return np.exp(middle), 1.2533 * spread / np.sqrt(len(ratio))


def neutral(a: Float32[np.ndarray, "h w 3"]) -> Float[np.ndarray, "3"]:
    """Factors on linear colors that make the tint of the first visit's bright ground gray and its white 1."""
    known = a[~np.isnan(a).any(-1)].astype(np.float64)
    if not len(known):
        return np.ones(3)
    tint = np.mean(np.clip(known, 0, 1) ** _POWER, axis=0) ** (1 / _POWER)
    bright = np.quantile(known / np.maximum(tint, 1e-6), 0.995)
    return 1 / np.maximum(tint * max(float(bright), 1e-6), 1e-6)


def lab(light: Float[np.ndarray, "*b 3"]) -> Float[np.ndarray, "*b 3"]:
    """CIELAB (D65) of linear RGB."""
    t = np.maximum(light @ _XYZ.T / _WHITE, 0)
    f = np.where(t > (6 / 29) ** 3, np.cbrt(t), t / (3 * (6 / 29) ** 2) + 4 / 29)
    return np.stack([116 * f[..., 1] - 16, 500 * (f[..., 0] - f[..., 1]), 200 * (f[..., 1] - f[..., 2])], -1)


def lab_variance(light: Float[np.ndarray, "*b 3"], std: Float[np.ndarray, "*b 3"]) -> Float[np.ndarray, "*b 3"]:
    """Variance of L*, a* and b* for independent errors of the channels."""
    middle, total = lab(light), np.zeros(light.shape)
    for channel in range(3):
        moved = light.copy()
        moved[..., channel] += std[..., channel]
        total += (lab(moved) - middle) ** 2
    return total


def linear(stored: Float32[np.ndarray, "*b 3"]) -> Float[np.ndarray, "*b 3"]:
    """Linear light of stored colors (sRGB); NaN stays NaN."""
    return linear_from_srgb(torch.from_numpy(np.clip(stored, 0, 1))).double().numpy()


def shown(light: Float[np.ndarray, "*b 3"]) -> Float32[np.ndarray, "*b 3"]:
    """Linear colors as images show them: sRGB, 0..1."""
    known = torch.from_numpy(np.clip(np.nan_to_num(light), 0, 1))
    return srgb_from_linear(known).clamp(0, 1).float().numpy()
