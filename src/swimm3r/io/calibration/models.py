"""Names of lens models, as the programs that calibrate write them, and their coefficients.

plumb_bob, radtan              k1 k2 p1 p2 [k3]
rational_polynomial            k1 k2 p1 p2 k3 k4 k5 k6    (k4, k5, k6 divide; then thin prism and tilt, refused)
equidistant, fisheye           k1 k2 k3 k4
"""

from collections.abc import Sequence

import numpy as np

from swimm3r.errors import InputError
from swimm3r.io.calibration.record import Calibration, half_pixel_later

_RADTAN = ("plumb_bob", "radtan", "radial-tangential", "rational_polynomial", "rational", "opencv")
_FISHEYE = ("equidistant", "equi", "fisheye", "kannala_brandt", "kannala_brandt4", "opencv_fisheye")
_NONE = ("none", "", "pinhole")
_COUNTS = (0, 4, 5, 8, 12, 14)  # of OpenCV's coefficients


def of_opencv(
    name: str,
    program: str,
    size: tuple[int, int] | None,
    K: np.ndarray,
    model: str | None,
    coefficients: Sequence[float],
) -> Calibration:
    """A lens with OpenCV's pixels and order of coefficients; without a `model` their number tells it.

    Raises InputError for a model that does not exist here, ValueError for numbers that are no lens's.
    """
    if K.shape != (3, 3):
        raise ValueError(f"the camera matrix of {name} has the shape {K.shape}")
    if K[0, 1] or K[1, 0] or not np.array_equal(K[2], [0, 0, 1]):
        raise ValueError(f"the camera matrix of {name} has not the form [[fx, 0, cx], [0, fy, cy], [0, 0, 1]]")
    kind = "radtan" if model is None else model.strip().lower()
    values = [float(value) for value in coefficients]
    pixels = half_pixel_later(K)
    if kind in _FISHEYE:
        if len(values) != 4:
            raise ValueError(f"the {kind} lens of {name} has {len(values)} coefficients, and 4 are expected")
        return Calibration(name, program, size, pixels, fisheye=True, k=tuple(values))
    if kind in _NONE:
        if any(values):
            raise ValueError(f"the camera {name} has coefficients of distortion and no model of them")
        return Calibration(name, program, size, pixels)
    if kind not in _RADTAN:
        raise unknown_model(name, model or "", program)
    if len(values) not in _COUNTS:
        raise ValueError(f"the {kind} lens of {name} has {len(values)} coefficients")
    if any(values[8:]):
        raise unknown_model(name, "thin prism or tilted sensor", program)
    k1, k2, p1, p2, k3, *divisor = [*values, *[0.0] * 8][:8]
    return Calibration(name, program, size, pixels, k=(k1, k2, k3), p=(p1, p2), divisor=tuple(divisor))


def unknown_model(name: str, model: str, program: str) -> InputError:
    """The refusal of a lens that `cameras` cannot express."""
    return InputError(
        f"the camera {name} has a lens of the model {model} ({program}), which Swimm3R does not have",
        cause="it has PINHOLE, SIMPLE_RADIAL, OPENCV (radtan, plumb_bob) and OPENCV_FISHEYE (equidistant)",
        hint="calibrate again with pinhole-radtan, or for a fisheye lens with pinhole-equi; or undistort the images"
        " with the program that calibrated them",
    )
