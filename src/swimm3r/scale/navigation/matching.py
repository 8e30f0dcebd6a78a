"""Positions and attitude of the vehicle at the moments of frames: by names of images, else by time.

t_navigation = t_frame + offset
"""

from collections.abc import Mapping, Sequence, Set
from dataclasses import dataclass
from pathlib import PurePosixPath
from typing import Literal

import numpy as np
from jaxtyping import Bool, Float, Int

from swimm3r.errors import InputError
from swimm3r.io.navigation.clock import is_date, seconds_of, seconds_of_name, utc
from swimm3r.io.navigation.record import Navigation
from swimm3r.scene.frames import Frames

FEWEST = 3  # frames with a position
_ZONES = [half * 1800.0 for half in range(-28, 29) if half]  # offsets of time zones, seconds


@dataclass(frozen=True)
class FrameTimes:
    """Moments of the registered frames: since 1970 where `clock` is "utc", seconds of the clip where it is "clip".

    Frames without a clock ("none") have their places in the order instead.
    """

    names: tuple[str, ...]
    clock: Literal["utc", "clip", "none"]
    seconds: Float[np.ndarray, " c"]


@dataclass(frozen=True)
class Matched:
    """Rows of navigation that belong to frames."""

    frame: Int[np.ndarray, " k"]  # index of the registered frame
    navigation: Navigation  # one row per entry of `frame`
    by: Literal["name", "time"]


def frame_times(names: Sequence[str], frames: Frames, clip_start: str | None) -> FrameTimes:
    """The best moments that are known of frames: of their names, of the recording's begin, else of the clip.

    Raises InputError for a begin that is no date.
    """
    times = np.array(frames.times_of(names))
    stated = [seconds_of_name(name) for name in names]
    if clip_start is None and all(moment is not None for moment in stated):
        return FrameTimes(tuple(names), "utc", np.array(stated, np.float64))
    if clip_start is None and frames.start_ns is not None:  # a bag's, of a clock that need not count from 1970
        seconds = frames.start_ns * 1e-9 + times
        return FrameTimes(tuple(names), "utc" if is_date(float(seconds[0])) else "clip", seconds)
    if not frames.timed:
        return FrameTimes(tuple(names), "none", times)
    begin = clip_start or frames.recorded
    if begin is None:
        return FrameTimes(tuple(names), "clip", times)
    try:
        return FrameTimes(tuple(names), "utc", seconds_of(begin) + times)
    except ValueError as error:
        raise InputError(
            f"the begin of the clip, {begin!r}, is no date and time",
            cause="a slip in --clip-start",
            hint="--clip-start 2026-05-14T09:30:00Z",
        ) from error


def match_names(navigation: Navigation, names: Sequence[str]) -> Matched | None:
    """The rows whose image is a frame, by their names without suffix; None where fewer than 3 are.

    Folders count where several images of the navigation have one name, and as far as both sides state them.
    """
    if navigation.names is None:
        return None
    rows = {_endings(name)[0]: row for row, name in enumerate(navigation.names)}
    images: dict[str, set[str]] = {}
    for name in rows:
        for end in _endings(name):
            images.setdefault(end, set()).add(name)
    pairs = [(i, rows[image]) for i, name in enumerate(names) if (image := _image_of(name, images)) is not None]
    if len(pairs) >= FEWEST:
        frame, row = np.array(pairs).T
        return Matched(frame, navigation.rows(row), "name")
    if navigation.clock == "names":
        raise InputError(
            f"{navigation.path} names {len(navigation.names)} images, and {len(pairs)} of them are frames of this run",
            cause=f"it is of another dive: it names {navigation.names[0]}, the frames are {names[0]} and so on",
            hint="the navigation of this dive, or one with times",
        )
    return None


def check_timed(navigation: Navigation, times: FrameTimes) -> None:
    """Raise InputError for frames that have no times, and so no place in navigation by them."""
    if times.clock == "none":
        raise InputError(
            f"the frames cannot be found in {navigation.path} by time: they have no times",
            cause="images without the time of the camera's clock, at least one of them: an editor left EXIF out",
            hint="a table that names the images, without --nav-offset; or date and time in their names"
            " (20190404_120001.jpg) or EXIF",
        )


def match_times(navigation: Navigation, times: FrameTimes, offset: float, max_gap: float) -> Matched:
    """Positions interpolated at the moments of the frames; frames outside or in gaps are left out."""
    from scipy.spatial.transform import Rotation, Slerp

    moments = times.seconds + offset
    known = navigation.time
    after = np.clip(np.searchsorted(known, moments), 1, len(known) - 1)
    gap = known[after] - known[after - 1]
    frame = np.flatnonzero((moments >= known[0]) & (moments <= known[-1]) & (gap <= max_gap))
    moments, after = moments[frame], after[frame]
    share = (moments - known[after - 1]) / gap[frame]
    near = navigation.rows(np.where(share < 0.5, after - 1, after))
    attitude = near.attitude
    if navigation.attitude is not None and len(frame):
        whole = np.asarray(np.isfinite(navigation.attitude).all((1, 2)))
        attitude = np.full((len(frame), 3, 3), np.nan)
        both = whole[after] & whole[after - 1]
        if whole.sum() >= 2 and both.any():
            turning = Slerp(known[whole], Rotation.from_matrix(navigation.attitude[whole]))
            attitude[both] = turning(moments[both]).as_matrix()
    return Matched(
        frame,
        Navigation(
            path=navigation.path,
            frame=navigation.frame,
            position=(1 - share[:, None]) * navigation.position[after - 1]
            + share[:, None] * navigation.position[after],
            clock=navigation.clock,
            time=moments,
            std=near.std,
            attitude=attitude,
            attitude_std=near.attitude_std,
            altitude=near.altitude,
        ),
        "time",
    )


def offset_range(navigation: Navigation, times: FrameTimes, window: float) -> tuple[float, float]:
    """The offsets that may be: around 0 where both clocks state the date, else all that leave an overlap."""
    if navigation.clock == times.clock:
        return -window, window
    span = times.seconds[-1] - times.seconds[0]
    return float(navigation.time[0] - times.seconds[0]), float(navigation.time[-1] - times.seconds[0] - span)


def check_overlap(navigation: Navigation, times: FrameTimes, slack: float) -> None:
    """Raise InputError where the clocks do not meet, with the time zone that would make them."""
    if navigation.clock != times.clock or _covered(navigation, times.seconds, slack).any():
        return
    off = [zone for zone in _ZONES if _covered(navigation, times.seconds + zone, slack).mean() > 0.8]
    told = utc if times.clock == "utc" else (lambda seconds: f"{seconds:.1f} s")
    cause, hint = "the navigation is of another dive, or one of the two clocks is wrong", "--nav-offset SECONDS"
    if off:
        hours = off[0] / 3600
        cause = f"the time zone: frames {abs(hours):g} h {'later' if hours > 0 else 'earlier'} would lie within it"
        hint = f"--nav-offset {off[0]:g}, which is added to the frames' times"
    raise InputError(
        f"no frame was taken while {navigation.path} was recorded: frames {told(times.seconds.min())} to"
        f" {told(times.seconds.max())}, navigation {told(navigation.time[0])} to {told(navigation.time[-1])}",
        cause=cause,
        hint=hint,
    )


def zones_that_overlap(navigation: Navigation, times: FrameTimes) -> list[float]:
    """Offsets of whole and half hours under which most frames lie within the navigation."""
    if navigation.clock != times.clock:
        return []
    return [zone for zone in _ZONES if _covered(navigation, times.seconds + zone, 0.0).mean() > 0.8]


def _covered(navigation: Navigation, seconds: Float[np.ndarray, " c"], slack: float) -> Bool[np.ndarray, " c"]:
    return (seconds >= navigation.time[0] - slack) & (seconds <= navigation.time[-1] + slack)


def _image_of(name: str, images: Mapping[str, Set[str]]) -> str | None:
    """The one image whose name ends as a frame's does, as long as it can be; None without one, or with several."""
    ends = _endings(name)
    found = next((images[end] for end in ends if end in images), frozenset())
    if ends[0] in found:
        return ends[0]
    return next(iter(found)) if len(found) == 1 else None


def _endings(name: str) -> list[str]:
    """A name without suffix and case, then without its first folder, and so on."""
    path = PurePosixPath(name.replace("\\", "/").lower())
    parts = [*path.parts[:-1], path.stem]
    return ["/".join(parts[k:]) for k in range(len(parts))]
