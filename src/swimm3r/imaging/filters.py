"""Images in gray, and smoothed: over all neighbors, or along those that look alike."""

import numpy as np
import torch
from jaxtyping import Float, UInt8
from torch import Tensor

LUMA = torch.tensor([0.299, 0.587, 0.114])  # ITU-R BT.601


def gray_levels(image: Float[Tensor, "h w 3"]) -> UInt8[np.ndarray, "h w"]:
    """Luma in 0..255, as OpenCV's detectors and trackers take images."""
    return (image.numpy() @ LUMA.numpy() * 255).round().astype(np.uint8)


def blur(x: Float[Tensor, "h w c"], sigma: float) -> Float[Tensor, "h w c"]:
    """Gaussian blur over rows and columns."""
    import cv2

    size = 2 * round(2.5 * sigma) + 1
    blurred = cv2.GaussianBlur(x.numpy(), (size, size), sigma, borderType=cv2.BORDER_REFLECT)
    return torch.from_numpy(blurred.reshape(x.shape))


def local_linear(
    guide: Float[Tensor, "h w"],
    value: Float[Tensor, "h w c"],
    weight: Float[Tensor, "h w c"],
    sigma: float,
    ridge: float,
) -> Float[Tensor, "h w c"]:
    """`value` as a locally linear function of `guide` (a weighted guided filter with Gaussian windows)."""
    g = guide[..., None]
    total = blur(weight, sigma).clamp(min=1e-8)
    mean_g, mean_v = blur(weight * g, sigma) / total, blur(weight * value, sigma) / total
    covariance = blur(weight * g * value, sigma) / total - mean_g * mean_v
    variance = (blur(weight * g * g, sigma) / total - mean_g**2).clamp(min=0)
    slope = covariance / (variance + ridge)
    return mean_v + slope * (g - mean_g)
