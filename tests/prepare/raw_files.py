"""Camera raw files as tests need them: DNG of a Bayer sensor, whose light is known."""

from pathlib import Path

import numpy as np
import tifffile

NEUTRAL = np.array([0.5, 1.0, 0.625])  # the camera's values of white
BLACK, WHITE = 512, 16383
_RGB_FROM_XYZ = np.array(  # linear sRGB, D65
    [[3.2404542, -1.5371385, -0.4985314], [-0.9692660, 1.8760108, 0.0415560], [0.0556434, -0.2040259, 1.0572252]]
)


def write_dng(path: Path, light: np.ndarray, orientation: int = 1) -> Path:
    """A raw file whose development in daylight is `light` [h, w, 3], linear sRGB 0..1."""
    sensor = light * NEUTRAL
    bayer = sensor[..., 1].copy()
    bayer[0::2, 0::2], bayer[1::2, 1::2] = sensor[0::2, 0::2, 0], sensor[1::2, 1::2, 2]
    stored = (BLACK + bayer * (WHITE - BLACK) + 0.5).astype(np.uint16)
    tags = [
        (50706, "B", 4, bytes((1, 4, 0, 0)), True),  # DNGVersion
        (50708, "s", 0, "Test Camera", True),  # UniqueCameraModel
        (271, "s", 0, "Test", True),
        (272, "s", 0, "Camera", True),
        (274, "H", 1, orientation, True),
        (33421, "H", 2, (2, 2), True),  # CFARepeatPatternDim
        (33422, "B", 4, bytes((0, 1, 1, 2)), True),  # CFAPattern: RGGB
        (50721, "2i", 9, _fractions((np.diag(NEUTRAL) @ _RGB_FROM_XYZ).ravel()), True),  # ColorMatrix1
        (50728, "2I", 3, _fractions(NEUTRAL), True),  # AsShotNeutral
        (50778, "H", 1, 21, True),  # CalibrationIlluminant1: D65
        (50714, "H", 1, BLACK, True),
        (50717, "I", 1, WHITE, True),
    ]
    tifffile.imwrite(path, stored, photometric=32803, extratags=tags, metadata=None)
    return path


def _fractions(values: np.ndarray) -> list[int]:
    return [part for value in values for part in (round(value * 10_000), 10_000)]
