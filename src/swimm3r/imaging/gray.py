"""Gray images of color ones: luma, or the channels in which the texture of a scene stands out from noise.

Water takes the channels away one after the other. A lamp in deep water, or the sun there, shows nearly all texture in
blue, of which luma takes a ninth: less than the noise that green and red add.
"""

import numpy as np
import torch
from jaxtyping import Bool, Float, Float64, UInt8
from torch import Tensor

from swimm3r.imaging.filters import texture

LUMA = torch.tensor([0.299, 0.587, 0.114])
"""Weights of red, green and blue by ITU-R BT.601."""
FEATURE_SIDE = 480
"""Long side in pixels of the copy of an image whose texture decides which gray its features are looked for in."""
_GAIN = 1.5  # times the texture that luma shows, from which on other weights pay: red and blue are the noisier channels


def gray_levels(image: Float[Tensor, "h w 3"], weights: Float[Tensor, "3"] = LUMA) -> UInt8[np.ndarray, "h w"]:
    """The weighted mean of the channels in 0..255, as OpenCV's detectors and trackers take images."""
    return (image.numpy() @ weights.numpy() * 255).round().astype(np.uint8)


def texture_moments(
    image: Float[Tensor, "h w 3"], seen: Bool[Tensor, "h w"], long_side: int
) -> Float64[np.ndarray, "3 3"]:
    """Second moments of the channels' texture in a copy of at most `long_side` pixels, summed over the pixels seen."""
    import cv2

    values, mask = image.numpy(), seen.numpy().astype(np.uint8)
    scale = min(1.0, long_side / max(mask.shape))
    size = max(1, round(scale * mask.shape[1])), max(1, round(scale * mask.shape[0]))
    values = cv2.resize(values, size, interpolation=cv2.INTER_AREA)
    there = cv2.resize(mask, size, interpolation=cv2.INTER_NEAREST) > 0
    found = texture(values, there)[there].astype(np.float64)
    return found.T @ found


def strongest(moments: Float64[np.ndarray, "3 3"]) -> Float[Tensor, "3"]:
    """Weights in which texture of these moments stands out most: its first principal component; luma for none.

    Noise is no stronger in them than in luma, be it independent in the channels or common to them as in gray images.
    """
    if not moments.any():
        return LUMA
    first = np.linalg.eigh(moments).eigenvectors[:, -1]
    first = torch.from_numpy((first * np.sign(first.sum())).clip(0)).float()
    return first / torch.maximum(first.norm() / LUMA.norm(), first.sum() / LUMA.sum())


def texture_shown(moments: Float64[np.ndarray, "3 3"], weights: Float[Tensor, "3"]) -> float:
    """Strength of texture of these moments in a gray, a root of summed squares."""
    w = weights.double().numpy()
    return float(np.sqrt(w @ moments @ w))


def weights_for_features(image: Float[Tensor, "h w 3"], seen: Bool[Tensor, "h w"]) -> Float[Tensor, "3"]:
    """Luma, unless an image's texture is far stronger in other weights; with a sum of 1.

    Each image decides for itself, so that those of other dives, and of a vehicle at work, need nothing but themselves.
    """
    moments = texture_moments(image, seen, FEATURE_SIDE)
    own = strongest(moments)
    return own / own.sum() if texture_shown(moments, own) > _GAIN * texture_shown(moments, LUMA) else LUMA
