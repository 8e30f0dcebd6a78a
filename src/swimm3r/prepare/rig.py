"""The images of a rig's cameras, one sub-folder each, put together by instants: by name, by time or by order."""

import logging
import re
from collections.abc import Sequence
from dataclasses import dataclass
from datetime import UTC, datetime
from pathlib import Path

import numpy as np

from swimm3r.errors import InputError, UsageError
from swimm3r.io.calibration.record import REMEDY, lens_at
from swimm3r.io.calibration.rig import read_rig
from swimm3r.io.files.atomic import write_text
from swimm3r.io.files.damage import guard
from swimm3r.io.image_folder import find_images, natural_key, numbered
from swimm3r.io.image_header import capture_time
from swimm3r.prepare.candidates import Taken, thinned
from swimm3r.scene.rig import Rig, RigCamera, pose_of
from swimm3r.scene.settings import FrameSettings

log = logging.getLogger(__name__)

NONE, SIDE_BY_SIDE = "none", "side-by-side"
STEREO = ("left", "right")
LENS = "rig_lens.txt"  # of the first camera of a calibrated rig, beside the frames
_UNITS = {19: 1e-9, 16: 1e-6, 13: 1e-3}  # seconds, by the number of digits of a stamp since 1970
_STAMP = re.compile(r"(?<!\d)(?:(\d{10})[._](\d{1,9})|(\d{19}|\d{16}|\d{13}))(?!\d)")
_SAME_NAMES = 0.5  # share of the instants with all cameras, from which equal names are no chance
_NAMED = 3  # images without partner that a message names


@dataclass(frozen=True)
class RigImages:
    """The images of a rig, those of an instant next to each other, in the order of the cameras."""

    images: tuple[Taken, ...]
    ordered: bool  # neighboring instants were taken in turn
    recorded: str | None  # date of the first instant, ISO 8601, where images carry it
    warnings: tuple[str, ...]


def cameras_of_folder(root: Path, settings: FrameSettings) -> tuple[str, ...]:
    """Names of the rig's cameras in a folder, empty without a rig.

    Named ones, or else left and right where these alone hold images. Raises InputError where a named one is not there.
    """
    if settings.rig == (NONE,):
        return ()
    if settings.rig:
        if len(settings.rig) < 2:
            raise UsageError(
                f"--rig names {', '.join(settings.rig)} alone",
                cause="a rig has two cameras and more",
                hint="--rig left right, --rig side-by-side for a video that shows two views, or --rig none",
            )
        missing = [name for name in settings.rig if not (root / name).exists()]
        if missing:
            there = sorted(path.name for path in root.iterdir() if path.is_dir())
            raise InputError(
                f"{root} has no camera {missing[0]}" + (f", only {', '.join(there[:8])}" if there else ""),
                cause="a slip in --rig, whose names are those of sub-folders",
                hint="--rig with the names of the cameras, the first of which gives the axes",
            )
        return settings.rig
    sides = {path.name.lower(): path for path in root.iterdir() if path.is_dir()}
    if not set(STEREO) <= sides.keys() or find_images(root, [path for path in sides.values()]).paths:
        return ()
    with_images = {name for name, path in sides.items() if name != "masks" and find_images(path).paths}
    if with_images != set(STEREO):
        return ()
    found = tuple(sides[name].name for name in STEREO)
    log.info("%s: %s/ and %s/ are taken as a stereo pair (--rig none: as one camera).", root, *found)
    return found


def check_rig(source: Path, settings: FrameSettings) -> None:
    """Read the calibration of a rig before any work is done. Raises InputError and UsageError where it cannot be used.

    The cameras of a folder of images must be there.
    """
    if settings.rig == (SIDE_BY_SIDE,):
        rig_of(STEREO, settings)
    elif source.is_dir() and settings.rig:
        inner = source / "images"
        cameras = cameras_of_folder(inner if inner.is_dir() else source, settings)
        if cameras:
            rig_of(cameras, settings)


def rig_of(cameras: Sequence[str], settings: FrameSettings) -> Rig:
    """The cameras, with their poses where a calibration gives them. Raises InputError where that cannot be used."""
    if settings.rig_calibration is None:
        return Rig(tuple(RigCamera(name) for name in cameras))
    found = read_rig(settings.rig_calibration, cameras).camera_from_rig
    return Rig(tuple(RigCamera(name, pose_of(pose)) for name, pose in zip(cameras, found, strict=True)))


def write_lens(draft: Path, cameras: Sequence[str], size: tuple[int, int], settings: FrameSettings) -> Path | None:
    """Write the calibrated lens of the first camera beside the frames, as a line of COLMAP; None without one."""
    if settings.rig_calibration is None:
        return None
    lens = read_rig(settings.rig_calibration, cameras).lenses[0]
    with guard(settings.rig_calibration, REMEDY):
        camera = lens_at(lens, *size, None if lens.size else size).camera
    (fx, _, cx), (_, fy, cy), _ = camera.K[0].tolist()
    bent = [*camera.distortion[0].tolist(), 0.0, 0.0, 0.0, 0.0][:4]
    model = camera.model if camera.model == "OPENCV_FISHEYE" else "OPENCV"
    numbers = " ".join(f"{value:.12g}" for value in (fx, fy, cx, cy, *bent))
    write_text(draft / LENS, f"1 {model} {size[0]} {size[1]} {numbers}\n")
    return draft / LENS


@dataclass(frozen=True)
class _Camera:
    """The images of one camera."""

    name: str
    paths: list[Path]
    times: list[float] | None  # seconds since 1970 or of the camera's clock; None where one image has none


def pair_images(root: Path, paths: Sequence[Path], cameras: Sequence[str], settings: FrameSettings) -> RigImages:
    """The images of the cameras by instants. Raises InputError where too many have no partner."""
    found = []
    for name in cameras:
        own = [path for path in paths if path.is_relative_to(root / name)]
        if not own:
            raise InputError(
                f"{root / name} holds no images",
                cause="the folder of that camera is empty, or holds another kind of files",
                hint="--rig with the names of the sub-folders that hold images",
            )
        found.append(_Camera(name, own, _times(own)))
    clocked = all(camera.times is not None for camera in found)
    instants = _instants(found, root, settings)
    warnings = _check_missing(instants, found, settings)
    moment = {path: t for camera in found for path, t in zip(camera.paths, camera.times or (), strict=False)}
    if clocked:
        instants.sort(key=lambda instant: min(moment[path] for path in instant.values()))
    else:
        instants.sort(key=lambda instant: natural_key(next(iter(instant.values())), root)[1:])
    instants = thinned(instants, settings.max_frames)
    begin = min(moment.values()) if clocked else 0.0
    images = [
        Taken(instant[name], moment[instant[name]] - begin if clocked else float(number), name, number)
        for number, instant in enumerate(instants)
        for name in cameras
        if name in instant
    ]
    recorded = datetime.fromtimestamp(begin, UTC).strftime("%Y-%m-%dT%H:%M:%S") if clocked else None
    return RigImages(tuple(images), clocked or numbered(found[0].paths), recorded, tuple(warnings))


def _instants(cameras: Sequence[_Camera], root: Path, settings: FrameSettings) -> list[dict[str, Path]]:
    """The images of each instant by their camera, in no order."""
    named = [[_key(path, root, camera.name) for path in camera.paths] for camera in cameras]
    unique = all(len(set(keys)) == len(keys) for keys in named)
    shared = len(set.intersection(*map(set, named))) / max(map(len, named))
    clocked = all(camera.times is not None for camera in cameras)
    how = settings.rig_pairs
    if how == "auto":
        how = "name" if (unique and shared >= _SAME_NAMES) or not clocked else "time"
    if how == "time" and clocked:
        return _by_time(cameras, settings.rig_tolerance)
    if how == "order" and len({len(camera.paths) for camera in cameras}) == 1:
        rows = zip(*(camera.paths for camera in cameras), strict=True)
        return [dict(zip((camera.name for camera in cameras), row, strict=True)) for row in rows]
    if how != "name" or not unique or not shared:
        raise InputError(
            f"the images of the rig cannot be paired by {how}: {_counts(cameras)}",
            cause={
                "time": "an image carries no time, neither in its name nor in EXIF",
                "order": "the cameras have different numbers of images",
                "name": "no names agree, and the images carry no times",
            }[how],
            hint="the same name for images of one instant (left/0001.png, right/0001.png); or --rig-pairs order where"
            " the first image of each camera is of the first instant, and so on",
        )
    found: dict[str, dict[str, Path]] = {}
    for camera, keys in zip(cameras, named, strict=True):
        for path, key in zip(camera.paths, keys, strict=True):
            found.setdefault(key, {})[camera.name] = path
    return list(found.values())


def _by_time(cameras: Sequence[_Camera], tolerance: float) -> list[dict[str, Path]]:
    """Images that are each other's nearest in time, within the tolerance; the others are instants of their own."""
    first = cameras[0]
    instants = [{first.name: path} for path in first.paths]
    for camera in cameras[1:]:
        gap = np.abs(np.subtract.outer(np.array(camera.times), np.array(first.times)))
        nearest, back = gap.argmin(1), gap.argmin(0)
        for row, path in enumerate(camera.paths):
            column = int(nearest[row])
            if gap[row, column] <= tolerance and back[column] == row:
                instants[column][camera.name] = path
            else:
                instants.append({camera.name: path})
    return instants


def _check_missing(instants: list[dict[str, Path]], cameras: Sequence[_Camera], settings: FrameSettings) -> list[str]:
    """The warning about images without partners. Raises InputError where they are too many."""
    alone = [path for instant in instants if len(instant) < len(cameras) for path in instant.values()]
    lacking = sum(len(instant) < len(cameras) for instant in instants)
    if not lacking:
        return []
    names = ", ".join(f"{path.parent.name}/{path.name}" for path in alone[:_NAMED])
    told = (
        f"{lacking} of {len(instants)} instants lack the image of a camera ({names}{' ...' * (len(alone) > _NAMED)});"
        f" there are {_counts(cameras)}"
    )
    if lacking <= settings.rig_missing * len(instants):
        return [f"{told}. They are used as they are."]
    apart = _apart(cameras)
    raise InputError(
        told + ("" if apart is None else f", {apart:.3g} s apart in the median"),
        cause="the cameras were not triggered together, or images of one of them were lost or left out",
        hint=f"--rig-tolerance (now {settings.rig_tolerance:g} s) where the times differ by little, --rig-missing (now"
        f" {settings.rig_missing:g}) to go on without the partners, or --rig none: one camera after the other",
    )


def _apart(cameras: Sequence[_Camera]) -> float | None:
    """Median difference of the images' times from the nearest of the first camera; None without times."""
    if any(camera.times is None for camera in cameras):
        return None
    first = np.array(cameras[0].times)
    gaps = [np.abs(np.subtract.outer(np.array(camera.times), first)).min(1) for camera in cameras[1:]]
    return float(np.median(np.concatenate(gaps)))


def _counts(cameras: Sequence[_Camera]) -> str:
    return ", ".join(f"{len(camera.paths)} images of {camera.name}" for camera in cameras)


def _key(path: Path, root: Path, camera: str) -> str:
    """The name of an image without its camera's: left/left_0001.png and right/R-0001.jpg are both 0001."""
    inner = path.relative_to(root / camera).with_suffix("").as_posix().lower()
    words = [word.removeprefix(camera.lower()) for word in re.split(r"[^0-9a-z]+", inner)]
    return "_".join(word for word in words if word and word != camera[:1].lower())


def _times(paths: Sequence[Path]) -> list[float] | None:
    """Times of images in seconds: stamps in their names, else EXIF; None where one has none, or two have the same."""
    for time_of in (_stamp, capture_time):
        times = [time_of(path) for path in paths]
        if len(known := [t for t in times if t is not None]) == len(paths) == len(set(known)):
            return known
    return None


def _stamp(path: Path) -> float | None:
    """Seconds since 1970 in a name: 1403636579763555584, 1403636579763555, 1403636579763 or 1403636579.763555."""
    found = _STAMP.search(path.stem)
    if found is None:
        return None
    seconds, fraction, digits = found.groups()
    return float(f"{seconds}.{fraction}") if seconds else int(digits) * _UNITS[len(digits)]
