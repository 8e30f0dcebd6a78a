"""Rotation of a camera between two times, by the rates that its gyroscope measured (GoPro's GYRO; axes: `record`).

    R_begin_end = product over the samples between of exp([w_k] (t_k+1 - t_k))

takes directions in the axes of the image at the end to those at the begin.
"""

from dataclasses import dataclass
from functools import cached_property
from pathlib import Path

import numpy as np
from jaxtyping import Float
from scipy.spatial.transform import Rotation

from swimm3r.io.telemetry.read import gpmf_payloads
from swimm3r.io.telemetry.streams import streams_of
from swimm3r.io.video import Video


@dataclass(frozen=True)
class Gyroscope:
    """Rates of rotation about the axes of the images, x right, y down, z forward."""

    time: Float[np.ndarray, " n"]  # seconds of the clip, rising
    rate: Float[np.ndarray, "n 3"]  # rad/s

    def turn(self, begin: float, end: float) -> Float[np.ndarray, "3 3"]:
        """Rotation from the axes at the end to those at the begin."""
        return (self._at(begin).inv() * self._at(end)).as_matrix()

    def _at(self, time: float) -> Rotation:
        """Rotation from the axes at a time to those at the first sample; rates hold until the next sample."""
        k = int(np.clip(np.searchsorted(self.time, time, side="right") - 1, 0, len(self.time) - 1))
        return self._turned[k] * Rotation.from_rotvec(self.rate[k] * (time - self.time[k]))

    @cached_property
    def _turned(self) -> Rotation:
        """Rotation from the axes at each sample to those at the first."""
        steps = Rotation.from_rotvec(self.rate[:-1] * np.diff(self.time)[:, None])
        turned = [Rotation.identity()]
        for step in steps:
            turned.append(turned[-1] * step)
        return Rotation.concatenate(turned)


def gyroscope_of(path: Path) -> Gyroscope | None:
    """The gyroscope of a video in the axes of its upright images; None where it has none."""
    video = Video(path)
    payloads, _ = gpmf_payloads(video)
    found = next((stream for stream in streams_of(payloads)[0] if stream.key == "GYRO" and len(stream) > 1), None)
    if found is None or found.channels != ("X", "Y", "Z") or not (np.diff(found.time) > 0).all():
        return None
    rate = -found.values[:, [0, 2, 1]]
    for _ in range(video.quarter_turns):
        rate = np.stack([rate[:, 1], -rate[:, 0], rate[:, 2]], -1)
    return Gyroscope(found.time, rate)
