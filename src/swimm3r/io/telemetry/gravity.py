"""Up in the axes of a video's images, by the gravity that the camera measured (GoPro's GRAV; axes: `record`)."""

from collections.abc import Sequence
from pathlib import Path

import numpy as np
from jaxtyping import Float

from swimm3r.io.telemetry.read import gpmf_payloads
from swimm3r.io.telemetry.streams import streams_of
from swimm3r.io.video import Video

_AROUND = 0.25  # seconds on either side of an image


def up_of_images(path: Path, times: Sequence[float]) -> Float[np.ndarray, "n 3"] | None:
    """Unit vectors away from the earth at seconds of a video, x right, y down, z forward in its upright images.

    None where the video has no measurements of gravity; NaN at times without any.
    """
    video = Video(path)
    payloads, _ = gpmf_payloads(video)
    gravity = next((stream for stream in streams_of(payloads)[0] if stream.key == "GRAV" and len(stream)), None)
    if gravity is None:
        return None
    up = -gravity.values / np.linalg.norm(gravity.values, axis=1, keepdims=True)  # X, Z, Y of the camera
    for _ in range(video.quarter_turns):
        up = np.stack([up[:, 1], -up[:, 0], up[:, 2]], -1)
    out = np.full((len(times), 3), np.nan)
    for i, time in enumerate(times):
        near = up[np.abs(gravity.time - time) <= _AROUND]
        if len(near):
            mean = near.mean(0)
            out[i] = mean / np.linalg.norm(mean)
    return out
