"""A calibrated lens as its file states it, and the same lens as a camera of `cameras` in images of any size.

K counts pixels as `cameras` does: the center of the first pixel is (0.5, 0.5). OpenCV, ROS and Kalibr have it at
(0, 0), so their readers add half a pixel to cx and cy (`half_pixel_later`). Distortion of (x, y) at z = 1:

    r^2 = x^2 + y^2,    s = (1 + k1 r^2 + k2 r^4 + ...) / (1 + d1 r^2 + d2 r^4 + ...)
    x' = x s + 2 p1 x y + p2 (r^2 + 2 x^2),    y' = y s + p1 (r^2 + 2 y^2) + 2 p2 x y

and of a fisheye lens theta (1 + k1 theta^2 + ... + k4 theta^8), with theta = atan r in the place of r.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import torch

from swimm3r.cameras import Cameras, check_cameras, check_lens, resized
from swimm3r.errors import InputError, UsageError
from swimm3r.io.files.damage import Remedy
from swimm3r.io.imports.opencv_fit import nearest_opencv, radial

REMEDY = Remedy(
    "a Kalibr camchain, ROS camera_info, OpenCV FileStorage (YAML or XML), COLMAP cameras.txt, Agisoft lens or cameras"
    " XML, or nerfstudio transforms.json",
    cause="the file is damaged, or of another program",
    fault="cannot be read as a calibration",
)


@dataclass(frozen=True)
class Calibration:
    """One lens of a file."""

    name: str  # of the camera in its file
    program: str  # whose format the file has
    size: tuple[int, int] | None  # width and height of the images of the calibration
    K: np.ndarray  # [3, 3] pixels
    fisheye: bool = False
    k: tuple[float, ...] = ()  # of the radius; of the angle where `fisheye`
    p: tuple[float, float] = (0.0, 0.0)
    divisor: tuple[float, ...] = ()
    error: float = 0.0  # pixels that k and p are from what the file says, at most

    def __post_init__(self) -> None:
        if not all(np.isfinite(values).all() for values in (self.K, self.k, self.p, self.divisor)):
            raise ValueError(f"the camera {self.name} has a number that is not finite")
        if not min(self.K[0, 0], self.K[1, 1]) > 0:
            raise ValueError(f"the camera {self.name} has focal lengths of {self.K[0, 0]:g} and {self.K[1, 1]:g} px")
        if self.size is not None and min(self.size) < 1:
            raise ValueError(f"the camera {self.name} has images of {self.size[0]}x{self.size[1]}")


@dataclass(frozen=True)
class CalibratedLens:
    """A calibration in the pixels of a run's frames."""

    camera: Cameras  # one, at the origin
    error: float  # pixels of the calibration's images that it is from the file's lens, at most


def half_pixel_later(K: np.ndarray) -> np.ndarray:
    """K of a program that has the center of the first pixel at (0, 0)."""
    return K + np.array([[0, 0, 0.5], [0, 0, 0.5], [0, 0, 0]])


def with_size(calibration: Calibration, size: tuple[int, int] | None) -> tuple[int, int]:
    """The size of the images of a calibration. Raises UsageError where neither the file nor `size` tells it."""
    stated = calibration.size
    if stated is not None and size is not None and stated != size:
        raise UsageError(
            f"the calibration was made at {stated[0]}x{stated[1]}, and --calibration-size says {size[0]}x{size[1]}",
            cause="the file states its size itself",
            hint="leave out --calibration-size; frames of another size are scaled to",
        )
    found = size if stated is None else stated
    if found is None:
        raise UsageError(
            f"the file ({calibration.program}) does not say at which image size the lens was calibrated",
            cause="this format does not always hold the size",
            hint="--calibration-size WIDTH HEIGHT, in pixels of the images of the calibration",
        )
    return found


def lens_at(calibration: Calibration, width: int, height: int, size: tuple[int, int] | None = None) -> CalibratedLens:
    """The lens in images of another size; `size` is that of the calibration where its file does not tell.

    Raises ValueError where the numbers are no lens's, InputError where the shape of the images is another or the lens
    is more than half a pixel away from any that is supported, and UsageError where the size is not known.
    """
    own = with_size(calibration, size)
    scale = width / own[0], height / own[1]
    if abs(own[1] * scale[0] - height) > max(1.0, scale[0]):
        raise InputError(
            f"the calibration is of images of {own[0]}x{own[1]}, and the prepared frames are {width}x{height}",
            cause="the camera cropped one of the two, recorded them in another mode, or turned them by 90 degrees",
            hint="a calibration with the settings of the dive; only images of the same shape can be scaled",
        )
    model, distortion, error = _as_model(calibration, own)
    K = torch.from_numpy(np.asarray(calibration.K, np.float64))[None]
    origin = torch.eye(4, dtype=torch.float64)[None]
    camera = Cameras(K, torch.tensor([distortion], dtype=torch.float64), origin, *own, model)
    check_cameras(camera)
    if not (0 < K[0, 0, 2] < own[0] and 0 < K[0, 1, 2] < own[1]):
        raise ValueError(
            f"its principal point ({K[0, 0, 2]:.0f}, {K[0, 1, 2]:.0f}) is outside images of {own[0]}x{own[1]}"
        )
    check_lens(camera)
    return CalibratedLens(resized(camera, width, height), error)


def _as_model(calibration: Calibration, size: tuple[int, int]) -> tuple[str, Sequence[float], float]:
    """Camera model, its distortion, and the largest error of that in pixels."""
    k, p, divisor = calibration.k, calibration.p, calibration.divisor
    if calibration.fisheye:
        if any(p) or any(divisor) or any(k[4:]):
            raise ValueError("its fisheye lens has distortion beyond k1 to k4, which no supported lens has")
        return "OPENCV_FISHEYE", [*k[:4], *[0.0] * (4 - len(k))], calibration.error
    if not any((*k, *p, *divisor)):
        return "PINHOLE", [], calibration.error
    if not any((*k[2:], *divisor)):
        if len(k) == 1 and not any(p):
            return "SIMPLE_RADIAL", list(k), calibration.error
        return "OPENCV", [*k[:2], *[0.0] * (2 - len(k)), *p], calibration.error

    def distort(x: np.ndarray, y: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        r2 = x * x + y * y
        s = radial(k, r2) / radial(divisor, r2)
        dx = x * s + 2 * p[0] * x * y + p[1] * (r2 + 2 * x * x)
        return dx, y * s + p[0] * (r2 + 2 * y * y) + 2 * p[1] * x * y

    fit = nearest_opencv(distort, calibration.K, *size)
    return "OPENCV", fit.distortion.tolist(), fit.error
