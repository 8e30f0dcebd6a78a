"""Images smoothed, over all neighbors or along those that look alike, and their texture."""

import numpy as np
import torch
from jaxtyping import Bool, Float
from torch import Tensor

_SLOW = 12.0  # pixels: what varies slower is no surface texture
_FAST = 0.7  # pixels: what varies faster is noise, or the lines of interlaced video


def blur(x: Float[Tensor, "h w c"], sigma: float) -> Float[Tensor, "h w c"]:
    """Gaussian blur over rows and columns."""
    import cv2

    size = 2 * round(2.5 * sigma) + 1
    blurred = cv2.GaussianBlur(x.numpy(), (size, size), sigma, borderType=cv2.BORDER_REFLECT)
    return torch.from_numpy(blurred.reshape(x.shape))


def texture(values: Float[np.ndarray, "h w *c"], seen: Bool[np.ndarray, "h w"]) -> Float[np.ndarray, "h w *c"]:
    """Images without slow changes, and without those faster than a surface's texture; 0 where not seen."""
    import cv2

    there = seen.reshape(seen.shape + (1,) * (values.ndim - 2))
    share = cv2.GaussianBlur(seen.astype(np.float32), (0, 0), _SLOW, borderType=cv2.BORDER_REFLECT)
    slow = cv2.GaussianBlur(np.where(there, values, 0), (0, 0), _SLOW, borderType=cv2.BORDER_REFLECT)
    fine = cv2.GaussianBlur(values, (0, 0), _FAST)
    return np.where(there, fine - slow / np.maximum(share, 1e-6).reshape(there.shape), 0).astype(np.float32)


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
