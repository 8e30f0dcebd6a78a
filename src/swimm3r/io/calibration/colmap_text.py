"""COLMAP's cameras as text: a cameras.txt, or a line of it with or without the number and the size.

    1 OPENCV 1920 1080 fx fy cx cy k1 k2 p1 p2        OPENCV 1920 1080 fx fy ...        OPENCV fx,fy,...

Pixels are those of `cameras`. FULL_OPENCV is OpenCV's rational polynomial; RADIAL_FISHEYE and SIMPLE_RADIAL_FISHEYE are
OPENCV_FISHEYE with zeros.
"""

import re

import numpy as np

from swimm3r.io.calibration.models import unknown_model
from swimm3r.io.calibration.record import Calibration

_PROGRAM = "COLMAP"
_FOCALS = {  # number of focal lengths, then the number of coefficients
    "SIMPLE_PINHOLE": (1, 0),
    "PINHOLE": (2, 0),
    "SIMPLE_RADIAL": (1, 1),
    "RADIAL": (1, 2),
    "OPENCV": (2, 4),
    "FULL_OPENCV": (2, 8),
    "SIMPLE_RADIAL_FISHEYE": (1, 1),
    "RADIAL_FISHEYE": (1, 2),
    "OPENCV_FISHEYE": (2, 4),
}
_LINE = re.compile(r"\s*(?:(\d+)[\s,]+)?([A-Z][A-Z_0-9]{2,})[\s,:]+([-+.\deE\s,naifNAIF]+)")


def is_colmap(text: str) -> bool:
    """Return whether the first line that is no comment looks like a camera of COLMAP."""
    first = next(iter(_lines(text)), "")
    return _LINE.fullmatch(first) is not None


def read(text: str) -> list[Calibration]:
    """The cameras of a text, named by their numbers. Raises InputError for unknown models, else ValueError."""
    found = []
    for number, line in enumerate(_lines(text), 1):
        match = _LINE.fullmatch(line)
        if match is None:
            raise ValueError(f"camera {number} is not NUMBER MODEL WIDTH HEIGHT PARAMETERS")
        found.append(_camera(match[1] or str(number), match[2], [float(word) for word in _words(match[3])]))
    return found


def _camera(name: str, model: str, numbers: list[float]) -> Calibration:
    if model not in _FOCALS:
        raise unknown_model(name, model, _PROGRAM)
    focals, others = _FOCALS[model]
    count, size = focals + 2 + others, None
    if len(numbers) == count + 2:
        if any(number != int(number) for number in numbers[:2] if np.isfinite(number)):
            raise ValueError(f"the size of camera {name} is not in whole pixels")
        if not np.isfinite(numbers[:2]).all():
            raise ValueError(f"the size of camera {name} is not finite")
        size, numbers = (int(numbers[0]), int(numbers[1])), numbers[2:]
    if len(numbers) != count:
        raise ValueError(f"camera {name} ({model}) has {len(numbers)} parameters, and {count} are expected")
    f, (cx, cy), k = numbers[:focals], numbers[focals : focals + 2], tuple(numbers[focals + 2 :])
    K = np.array([[f[0], 0, cx], [0, f[-1], cy], [0, 0, 1]])
    if model.endswith("FISHEYE"):
        return Calibration(name, _PROGRAM, size, K, fisheye=True, k=k)
    if not model.endswith("OPENCV"):
        return Calibration(name, _PROGRAM, size, K, k=k)
    k1, k2, p1, p2, *rest = k
    return Calibration(name, _PROGRAM, size, K, k=(k1, k2, *rest[:1]), p=(p1, p2), divisor=tuple(rest[1:]))


def _lines(text: str) -> list[str]:
    return [line for line in text.splitlines() if line.strip() and not line.lstrip().startswith("#")]


def _words(text: str) -> list[str]:
    return [word for word in re.split(r"[\s,]+", text) if word]
