"""Measurements of a camera at the times of its images (axes: `record`), from GoPro's streams:

    up      -GRAV / |GRAV|
    gains   t ISO / 100 (w_r, w_g, w_b), with SHUT t in seconds, ISOE (else 100 ISOG) and the white balance WRGB:
            stored linear light is gains times that of the scene

A stream that a camera does not write counts as constant.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from jaxtyping import Float

from swimm3r.io.telemetry.read import gpmf_payloads
from swimm3r.io.telemetry.record import Stream
from swimm3r.io.telemetry.streams import streams_of
from swimm3r.io.video import Video

_AROUND = 0.25  # seconds on either side of an image


@dataclass(frozen=True)
class ImageTelemetry:
    """Measurements at the times of some images; None where the video has none of a kind, NaN at times without any."""

    up: Float[np.ndarray, "n 3"] | None  # unit vectors away from the earth, x right, y down, z forward
    gains: Float[np.ndarray, "n 3"] | None  # red, green, blue, of linear light


def telemetry_of_images(path: Path, times: Sequence[float]) -> ImageTelemetry:
    """The measurements at seconds of a video, in its upright images."""
    video = Video(path)
    payloads, _ = gpmf_payloads(video)
    streams = {stream.key: stream for stream in reversed(streams_of(payloads)[0]) if len(stream)}
    return ImageTelemetry(_up(streams.get("GRAV"), video.quarter_turns, times), _gains(streams, times))


def _up(gravity: Stream | None, quarter_turns: int, times: Sequence[float]) -> Float[np.ndarray, "n 3"] | None:
    if gravity is None:
        return None
    up = -gravity.values / np.linalg.norm(gravity.values, axis=1, keepdims=True)  # X, Z, Y of the camera
    for _ in range(quarter_turns):
        up = np.stack([up[:, 1], -up[:, 0], up[:, 2]], -1)
    mean = _means(gravity.time, up, times)
    return mean / np.linalg.norm(mean, axis=1, keepdims=True)


def _gains(streams: dict[str, Stream], times: Sequence[float]) -> Float[np.ndarray, "n 3"] | None:
    sensitivity = "ISOE" if "ISOE" in streams else "ISOG"
    found = [streams[key] for key in ("SHUT", sensitivity, "WRGB") if key in streams]
    if not found:
        return None
    gains = np.ones((len(times), 3))
    for stream in found:
        values = stream.values / (100.0 if stream.key == "ISOE" else 1.0)
        with np.errstate(divide="ignore", invalid="ignore"):  # of a camera that does not know: no gains then
            gains *= np.exp(_interpolated(stream.time, np.log(values), times))
    gains[~(np.isfinite(gains) & (gains > 0)).all(1)] = np.nan
    return gains


def _means(
    time: Float[np.ndarray, " m"], values: Float[np.ndarray, "m k"], times: Sequence[float]
) -> Float[np.ndarray, "n k"]:
    """Means of the samples around some times; NaN at those without any."""
    out = np.full((len(times), values.shape[1]), np.nan)
    for i, at in enumerate(times):
        near = np.abs(time - at) <= _AROUND
        if near.any():
            out[i] = values[near].mean(0)
    return out


def _interpolated(
    time: Float[np.ndarray, " m"], values: Float[np.ndarray, "m k"], times: Sequence[float]
) -> Float[np.ndarray, "n k"]:
    """Samples interpolated to some times; NaN before the first and after the last."""
    out = np.stack([np.interp(times, time, column) for column in values.T], -1)
    at = np.asarray(times)
    out[(at < time[0] - _AROUND) | (at > time[-1] + _AROUND)] = np.nan
    return out
