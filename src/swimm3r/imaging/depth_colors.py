"""Depth in colors: near warm, far cold, in even steps of inverse depth, and the numbers that go with the colors."""

import cv2
import numpy as np
from jaxtyping import Float, UInt8
from torch import Tensor

_UNKNOWN = (210, 215, 221)  # of pixels without depth


def depth_span(point_depths: Float[Tensor, " n"]) -> tuple[float, float]:
    """The z depths between which all but the nearest and farthest fiftieth of a dive's points lie."""
    near, far = np.quantile(point_depths.numpy(), [0.02, 0.98]).tolist()
    return near, max(far, near * 1.01)


def depth_image(z_depth: Float[np.ndarray, "h w"], near: float, far: float) -> UInt8[np.ndarray, "h w 3"]:
    """Depth in colors, RGB: `near` red, `far` blue, gray where nothing is known."""
    inverse = (1 / np.maximum(z_depth, 1e-9) - 1 / far) / max(1 / near - 1 / far, 1e-12)
    colors = cv2.applyColorMap((inverse.clip(0, 1) * 255).astype(np.uint8), cv2.COLORMAP_TURBO)[..., ::-1].copy()
    colors[z_depth <= 0] = _UNKNOWN
    return colors


def depth_scale(near: float, far: float, count: int) -> tuple[UInt8[np.ndarray, "n 3"], Float[np.ndarray, " n"]]:
    """Colors and depths at `count` even steps along a color bar, from near to far."""
    inverse = np.linspace(1 / near, 1 / far, count)
    return depth_image(1 / inverse[None], near, far)[0], 1 / inverse
