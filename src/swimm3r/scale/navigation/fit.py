"""Navigation as a source of scale and place: read, put into local metres, matched with frames, aligned, and doubted.

Navigation that does not fit the path of the cameras is refused. Where a common slip (columns exchanged, a sign, a time
zone, another unit of angles) would make it fit, the message names it; nothing is corrected silently.
"""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path as FilePath
from typing import Literal

import numpy as np
from jaxtyping import Float

from swimm3r.errors import InputError
from swimm3r.io.navigation.read import read_navigation
from swimm3r.io.navigation.record import Navigation, vehicle_attitude
from swimm3r.scale.navigation.alignment import GROUND_STD, Alignment, Path, align, realign, without_attitude
from swimm3r.scale.navigation.latency import at_offset, find_latency, within_path
from swimm3r.scale.navigation.matching import (
    FEWEST,
    FrameTimes,
    Matched,
    check_overlap,
    check_timed,
    frame_times,
    match_names,
    match_times,
    offset_range,
    zones_that_overlap,
)
from swimm3r.scale.navigation.place import Place, localized
from swimm3r.scale.navigation.time_offset import Offset, find_offset
from swimm3r.scale.settings import ScaleSettings
from swimm3r.scene.frames import Frames
from swimm3r.scene.georeference import up_from_scene
from swimm3r.scene.reconstruction import Reconstruction

_MISFIT = 0.2  # of the extent of the path: more than any navigation errs, less than any slip makes
_MUCH_BETTER = 0.4  # a slip is named where its correction leaves this share of the misfit
_GRAVITY_STD = np.radians(1.0)  # of up as the camera measured it
_BELOW = 60.0  # degrees between up and the scene's up: cameras that film from below
_TURNED = 15.0  # degrees, root mean square, between stated attitude and the cameras


@dataclass(frozen=True)
class NavigationFit:
    """Navigation aligned with a run."""

    path: FilePath
    matched: Matched  # positions in local metres
    alignment: Alignment
    place: Place
    by: Literal["name", "time"]
    offset: Offset | None  # None where images are named and their times are not known
    offset_found: bool  # rather than given
    notes: tuple[str, ...] = ()


def fit_navigation(rec: Reconstruction, frames: Frames, settings: ScaleSettings) -> NavigationFit:
    """The similarity from the run to local metres. Raises InputError where the navigation does not fit."""
    assert settings.nav is not None
    raw = read_navigation(settings.nav, settings.nav_topic)
    local = localized(raw, settings)
    times = frame_times(rec.names, frames, settings.clip_start)
    matched, offset, notes = _match(local.navigation, times, rec, settings)
    path = path_of(rec, matched, settings)
    _check_spread(path, settings.nav)
    alignment = align(path, settings)
    _check_fit(rec, path, alignment, local.navigation, raw, times, matched, settings)
    if matched.by == "name" and times.clock == "utc":
        matched, alignment, offset = _at_latency(path, matched, alignment, times, settings)
    elif offset is not None and settings.nav_offset is None:
        alignment = _as_uncertain(alignment, _beside(rec, local.navigation, times, offset, settings))
    return NavigationFit(
        settings.nav, matched, alignment, local.place, matched.by, offset, settings.nav_offset is None, tuple(notes)
    )


def _at_latency(
    path: Path, matched: Matched, alignment: Alignment, times: FrameTimes, settings: ScaleSettings
) -> tuple[Matched, Alignment, Offset | None]:
    """The alignment under the offset of the clocks that the path shows; its scale is as uncertain as that offset."""
    seconds = times.seconds[matched.frame]
    offset = find_latency(path, seconds, settings)
    if offset is None:
        return matched, alignment, None
    rows = within_path(seconds, offset.seconds, settings)
    matched = Matched(matched.frame[rows], matched.navigation.rows(np.flatnonzero(rows)), matched.by)
    found = align(at_offset(path, seconds, offset.seconds).rows(rows), settings)
    sides = [
        realign(at_offset(path, seconds, offset.seconds + side).rows(rows), settings, found)
        for side in (-offset.std, offset.std)
    ]
    return matched, _as_uncertain(found, sides), offset


def _beside(
    rec: Reconstruction, local: Navigation, times: FrameTimes, offset: Offset, settings: ScaleSettings
) -> list[Alignment]:
    """The alignments a standard deviation of the offset before and after it, where enough positions are left."""
    sides = (match_times(local, times, offset.seconds + side, settings.nav_gap) for side in (-offset.std, offset.std))
    return [align(path_of(rec, side, settings), settings) for side in sides if len(side.frame) >= FEWEST]


def _as_uncertain(found: Alignment, sides: Sequence[Alignment]) -> Alignment:
    """The alignment whose scale is also as uncertain as those under other offsets differ."""
    by_offset = np.ptp(np.log([each.scale for each in (found, *sides)])) / 2
    return replace(found, scale_std=float(np.hypot(found.scale_std, by_offset)))


def path_of(rec: Reconstruction, matched: Matched, settings: ScaleSettings) -> Path:
    """The matched cameras beside their navigation."""
    poses = rec.cameras.cam2world.double().numpy()[matched.frame]
    navigation, count = matched.navigation, len(matched.frame)
    std = navigation.std
    if settings.nav_std is not None:
        given = np.tile(settings.nav_std, (count, 1))
        std = given if std is None else np.where(np.isnan(std), given, std)
    heading, pitch, roll = (np.full(count, value) for value in settings.attitude_std)
    stated = navigation.attitude_std
    if stated is not None:
        heading, pitch, roll = np.where(np.isfinite(stated), stated, np.stack([heading, pitch, roll], -1)).T
    attitude_std = np.radians(np.stack([roll, pitch, heading], -1))  # about forward, starboard and down
    up, up_std = up_from_scene(rec)[2], GROUND_STD if rec.up is None else _GRAVITY_STD
    return Path(
        poses[:, :3, 3], poses[:, :3, :3], navigation.position, std, navigation.attitude, attitude_std, up, up_std
    )


def _match(
    navigation: Navigation, times: FrameTimes, rec: Reconstruction, settings: ScaleSettings
) -> tuple[Matched, Offset | None, list[str]]:
    named = match_names(navigation, rec.names) if settings.nav_offset is None else None
    if named is not None:
        return named, None, []
    check_timed(navigation, times)
    notes: list[str] = []
    centers = rec.cameras.centers.double().numpy()
    if settings.nav_offset is not None:
        offset = Offset(settings.nav_offset, 0.0)
        check_overlap(navigation, replace(times, seconds=times.seconds + offset.seconds), 0.0)
    else:
        check_overlap(navigation, times, settings.nav_window)
        low, high = offset_range(navigation, times, settings.nav_window)
        found = find_offset(navigation, times, centers, (min(low, high), max(low, high)), settings.nav_gap)
        offset = found or Offset(0.0, np.inf)
        known = navigation.clock == times.clock
        if offset.std > max(settings.nav_window, 0.1) / 2:
            if not known:
                raise InputError(
                    f"the offset between the clocks of {navigation.path} and of the clip cannot be found: the path of"
                    " the cameras fits everywhere",
                    cause="a straight path at constant speed, or too few frames",
                    hint="--nav-offset SECONDS, or --clip-start with the date and time of the first frame",
                )
            notes.append("The path does not show an offset between the clocks; none is assumed.")
            offset = Offset(0.0, settings.nav_window)
    matched = match_times(navigation, times, offset.seconds, settings.nav_gap)
    if len(matched.frame) < FEWEST:
        raise InputError(
            f"{len(matched.frame)} of {len(times.seconds)} frames have a position in {navigation.path}, and {FEWEST}"
            " are needed",
            cause=f"the navigation covers another part of the dive, or has gaps of more than {settings.nav_gap:g} s",
            hint="navigation of the whole clip; --nav-gap SECONDS; or --nav-offset SECONDS",
        )
    return matched, offset, notes


def _check_spread(path: Path, file: FilePath) -> None:
    """Refuse navigation that stands still, which holds no scale."""
    spread = np.linalg.norm(path.position - path.position.mean(0), axis=1).max()
    if spread < 1e-3:
        raise InputError(
            f"all positions in {file} during the clip are the same",
            cause="the vehicle stood still, or the navigation was not updated",
            hint="another source of scale, as --scale-bar or --markers",
        )


def _misfit(path: Path, alignment: Alignment) -> float:
    """Distance from the stated positions as a share of the path's extent."""
    known = np.isfinite(alignment.std)
    around = np.where(known, path.position - np.median(path.position, axis=0), 0.0)
    away = np.where(known, alignment.residual, 0.0)
    return float(np.median(np.linalg.norm(away, axis=1)) / max(np.linalg.norm(around, axis=1).mean(), 1e-9))


def _is_upside_down(path: Path, alignment: Alignment) -> bool:
    return bool((alignment.R @ path.up)[2] < np.cos(np.radians(_BELOW)))


def _check_fit(
    rec: Reconstruction,
    path: Path,
    alignment: Alignment,
    local: Navigation,
    raw: Navigation,
    times: FrameTimes,
    matched: Matched,
    settings: ScaleSettings,
) -> None:
    """Raise InputError where positions or attitude contradict the cameras, with the slip that explains it."""
    file = raw.path
    misfit, upside_down = _misfit(path, alignment), _is_upside_down(path, alignment)
    if path.attitude is not None:
        _check_attitude(path, alignment, upside_down, settings, file)
    if misfit < _MISFIT and not upside_down:
        return
    for slip, hint, other in _slips(rec, path, local, times, matched, settings):
        tried = align(other, settings)
        better = _misfit(other, tried) < max(_MUCH_BETTER * misfit, 0.02) if misfit >= _MISFIT else True
        if better and _misfit(other, tried) < _MISFIT and not _is_upside_down(other, tried):
            raise InputError(_told(file, alignment, misfit, upside_down), cause=slip, hint=hint)
    raise InputError(
        _told(file, alignment, misfit, upside_down),
        cause="the navigation of another dive or time, coordinates in different units, or a reconstruction that bends",
        hint="compare its path with the one in the report; --nav-offset SECONDS; or a scale bar or markers instead",
    )


def _told(file: FilePath, alignment: Alignment, misfit: float, upside_down: bool) -> str:
    if upside_down:
        return f"with {file} the cameras would film from below the ground"
    return (
        f"{file} does not fit the path of the cameras: {alignment.rms:.3g} m root mean square, {100 * misfit:.0f}% of"
        " the extent of the path"
    )


def _slips(
    rec: Reconstruction, path: Path, local: Navigation, times: FrameTimes, matched: Matched, settings: ScaleSettings
) -> Iterator[tuple[str, str, Path]]:
    """Common slips: the cause, the way out, and the path without it."""
    bare = without_attitude(path)
    exchanged = None if path.std is None else path.std[:, [1, 0, 2]]
    yield (
        "the columns of east and north (or longitude and latitude) are swapped",
        "exchange the names of the two columns",
        replace(bare, position=path.position[:, [1, 0, 2]], std=exchanged),
    )
    yield (
        "depth and height are confused: the vertical coordinate has the other sign",
        "name the column depth where it grows downwards, height where it grows upwards",
        replace(bare, position=path.position * [1, 1, -1]),
    )
    for axis, name in enumerate(("east", "north")):
        yield (
            f"the {name} coordinate has the other sign",
            "west and south are negative: correct the column",
            replace(bare, position=path.position * np.where(np.arange(3) == axis, -1, 1)),
        )
    if matched.by == "time":
        for zone in zones_that_overlap(local, times):
            other = match_times(local, times, zone, settings.nav_gap)
            if len(other.frame) >= FEWEST:
                hours = abs(zone) / 3600
                yield (
                    f"the time zone: frames {hours:g} h {'later' if zone > 0 else 'earlier'} fit",
                    f"--nav-offset {zone:g}, which is added to the frames' times",
                    without_attitude(path_of(rec, other, settings)),
                )


def _check_attitude(
    path: Path, alignment: Alignment, upside_down: bool, settings: ScaleSettings, file: FilePath
) -> None:
    """Raise InputError where stated angles contradict the turns of the cameras."""
    assert path.attitude is not None
    shown = alignment.attitude_residual_deg
    if shown is None:
        return
    whole = np.isfinite(path.attitude).all((1, 2))
    stated, seen = (_turning(each[whole]) for each in (path.attitude, path.rotations))
    if seen > 5.0 and stated > 0 and 40 < seen / stated < 82:
        raise InputError(
            f"the attitude in {file} turns by {stated:.2f} degrees while the cameras turn by {seen:.1f}",
            cause="radians in columns that should hold degrees",
            hint="state the unit: heading [rad], pitch [rad], roll [rad]",
        )
    if shown < _TURNED and not upside_down:
        return
    bare = without_attitude(path)
    alone = align(bare, settings)
    if _misfit(bare, alone) >= _MISFIT or _is_upside_down(bare, alone):
        return  # the positions themselves are wrong
    told = f"heading, pitch and roll in {file} contradict the cameras by {max(shown, _TURNED):.0f} degrees or more"
    tried = [(slip, replace(path, attitude=attitude)) for slip, attitude in _attitude_slips(path.attitude)]
    found = [(slip, align(other, settings)) for slip, other in tried]
    fitting = [(slip, a) for (slip, a), (_, other) in zip(found, tried, strict=True) if not _is_upside_down(other, a)]
    slip, best = min(fitting, key=lambda pair: pair[1].attitude_residual_deg or 180.0, default=("", alone))
    if slip and (best.attitude_residual_deg or 180.0) < 0.3 * max(shown, _TURNED):
        raise InputError(
            told,
            cause=slip,
            hint="correct the columns: heading clockwise from north, pitch bow up, roll starboard down, degrees",
        )
    raise InputError(
        told,
        cause="the camera moved on the vehicle (pan and tilt), or the angles are of another convention",
        hint="leave the columns of heading, pitch and roll out",
    )


def _turning(rotations: Float[np.ndarray, "k 3 3"]) -> float:
    """Root mean square turn from the middle one of some rotations, degrees."""
    from scipy.spatial.transform import Rotation

    if not len(rotations):
        return 0.0
    turns = Rotation.from_matrix(rotations[len(rotations) // 2].T @ rotations).magnitude()
    return float(np.degrees(np.sqrt((turns**2).mean())))


def _attitude_slips(attitude: Float[np.ndarray, "k 3 3"]) -> Iterator[tuple[str, Float[np.ndarray, "k 3 3"]]]:
    heading, pitch, roll = angles_of(attitude)
    yield "pitch and roll are exchanged", vehicle_attitude(heading, roll, pitch)
    yield "the heading counts counter-clockwise, or from east", vehicle_attitude(-heading, pitch, roll)
    yield "the sign of the pitch, or that of the roll", vehicle_attitude(heading, -pitch, roll)
    yield "the signs of pitch and roll", vehicle_attitude(heading, -pitch, -roll)


def angles_of(attitude: Float[np.ndarray, "k 3 3"]) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Heading, pitch and roll in degrees, the inverse of `vehicle_attitude`."""
    ahead, right, down = attitude[:, :, 0], attitude[:, :, 1], attitude[:, :, 2]
    heading = np.degrees(np.arctan2(ahead[:, 0], ahead[:, 1]))
    pitch = np.degrees(np.arcsin(np.clip(ahead[:, 2], -1, 1)))
    roll = np.degrees(np.arctan2(-right[:, 2], -down[:, 2]))
    return heading, pitch, roll
