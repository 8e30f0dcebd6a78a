"""Other programs' distortion polynomials as the nearest OPENCV lens, with what that costs in pixels.

A lens of k1, k2, p1, p2 is linear in them, so the nearest one over the image is a linear least-squares problem.
"""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from swimm3r.errors import InputError

_WORST = 0.5  # pixels
_SAMPLES = 33


@dataclass(frozen=True)
class OpencvFit:
    """The OPENCV lens nearest to another one."""

    distortion: np.ndarray  # k1, k2, p1, p2
    error: float  # pixels, the largest of the image


def nearest_opencv(
    distort: Callable[[np.ndarray, np.ndarray], tuple[np.ndarray, np.ndarray]], K: np.ndarray, width: int, height: int
) -> OpencvFit:
    """k1, k2, p1, p2 of a lens given as a map of points (x, y) at z = 1; exact where it is one of that kind.

    Raises ValueError where K is no camera's, InputError where the nearest lens is more than half a pixel away.
    """
    if not (np.isfinite(K).all() and min(K[0, 0], K[1, 1], width, height) > 0):
        raise ValueError(f"its lens has focal lengths of {K[0, 0]:g} and {K[1, 1]:g} in images of {width}x{height}")
    u, v = np.meshgrid(np.linspace(0, width, _SAMPLES), np.linspace(0, height, _SAMPLES))
    x, y = ((u - K[0, 2]) / K[0, 0]).ravel(), ((v - K[1, 2]) / K[1, 1]).ravel()
    r2 = x * x + y * y
    along_x = np.stack([x * r2, x * r2 * r2, 2 * x * y, r2 + 2 * x * x], -1)
    along_y = np.stack([y * r2, y * r2 * r2, r2 + 2 * y * y, 2 * x * y], -1)
    dx, dy = distort(x, y)
    A, b = np.concatenate([along_x, along_y]), np.concatenate([dx - x, dy - y])
    found = np.linalg.lstsq(A, b, rcond=None)[0]
    worst = float(np.abs(A @ found - b).max()) * float(max(K[0, 0], K[1, 1]))
    if worst > _WORST:
        raise InputError(
            f"the lens is {worst:.1f} pixels away from any that is supported",
            cause="its distortion has strong higher terms (k3, k4, skew)",
            hint="undistort the images in the program that calibrated them and export again",
        )
    return OpencvFit(found, worst)


def radial(k: tuple[float, ...], r2: np.ndarray) -> np.ndarray:
    """1 + k1 r^2 + k2 r^4 + ..."""
    return 1 + sum((factor * r2 ** (power + 1) for power, factor in enumerate(k)), np.zeros_like(r2))
