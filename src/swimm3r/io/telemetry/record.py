"""Telemetry of a clip: one record per stream, in SI units, with times of the clip.

ACCL and GYRO are in the camera's axes by GoPro's letters: X to the left of the image, Y out of the back, Z up. GRAV has
the order X, Z, Y and points up, as an accelerometer at rest does. In the axes of images (x right, y down, z forward)

    (x, y, z) = (-X, -Z, -Y)

which fits the rotations between frames of a HERO10. CORI is the orientation of the camera since the recording began,
and IORI that of the stabilized image in the camera: quaternions w, x, y, z, as the file has them.
"""

from dataclasses import dataclass
from pathlib import Path

import numpy as np
from jaxtyping import Float


@dataclass(frozen=True)
class Stream:
    """Samples of one sensor."""

    key: str  # GPMF's four letters, as ACCL; ACCL.TMPC for the temperature of the accelerometer
    device: str  # that measured, as "HERO10 Black"
    name: str  # in words, as the camera states it
    units: tuple[str, ...]  # of each channel
    channels: tuple[str, ...]  # names of the columns
    time: Float[np.ndarray, " n"]  # seconds of the clip, as those of its frames
    values: Float[np.ndarray, "n k"]
    rate: float  # samples per second

    def __len__(self) -> int:
        return len(self.time)


@dataclass(frozen=True)
class Telemetry:
    """All streams of a clip."""

    path: Path
    streams: tuple[Stream, ...]
    not_numbers: tuple[str, ...]  # keys of streams of text and codes, which are not read
    warnings: tuple[str, ...]

    def stream(self, key: str) -> Stream | None:
        """The first stream of a key that has samples."""
        return next((stream for stream in self.streams if stream.key == key and len(stream)), None)
