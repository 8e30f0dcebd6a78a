"""The images of a rig's cameras, one sub-folder each, put together by instants: by name, by time or by order."""

import logging
import re
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path, PurePath

from swimm3r.errors import InputError, UsageError
from swimm3r.io.calibration.record import REMEDY, Calibration, lens_at
from swimm3r.io.calibration.rig import read_rig
from swimm3r.io.files.atomic import write_text
from swimm3r.io.files.damage import guard
from swimm3r.io.image_folder import find_files, find_images, natural_key, numbered
from swimm3r.io.image_header import capture_time
from swimm3r.io.raw import RAW_SUFFIXES
from swimm3r.prepare.candidates import Taken, recorded_on, thinned
from swimm3r.prepare.instants import CameraImages, instants_of, missing
from swimm3r.scene.rig import Rig, RigCamera, pose_of
from swimm3r.scene.settings import FrameSettings

log = logging.getLogger(__name__)

NONE, SIDE_BY_SIDE = "none", "side-by-side"
STEREO = ("left", "right")
LENS = "rig_lens.txt"  # of the first camera of a calibrated rig, beside the frames
_UNITS = {19: 1e-9, 16: 1e-6, 13: 1e-3}  # seconds, by the number of digits of a stamp since 1970
_STAMP = re.compile(r"(?<!\d)(?:(\d{10})[._](\d{1,9})|(\d{19}|\d{16}|\d{13}))(?!\d)")


@dataclass(frozen=True)
class RigImages:
    """The images of a rig, those of an instant next to each other, in the order of the cameras."""

    images: tuple[Taken, ...]
    ordered: bool  # neighboring instants were taken in turn
    timed: bool  # every image carries a time
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
        named = tuple(name.rstrip("/\\") for name in settings.rig)  # as a shell completes names of folders
        deeper = next((name for name in named if len(PurePath(name).parts) != 1), None)
        if deeper is not None:
            raise UsageError(
                f"--rig names {deeper or '/'}, which is no name of a folder right in {root}",
                cause="the cameras of a rig are the folders next to each other in the input",
                hint="the folder that holds those of the cameras as input, and --rig with their names alone",
            )
        missing = [name for name in named if not (root / name).exists()]
        if missing:
            there = sorted(path.name for path in root.iterdir() if path.is_dir())
            raise InputError(
                f"{root} has no camera {missing[0]}" + (f", only {', '.join(there[:8])}" if there else ""),
                cause="a slip in --rig, whose names are those of sub-folders",
                hint="--rig with the names of the cameras, the first of which gives the axes",
            )
        return named
    sides = {path.name.lower(): path for path in root.iterdir() if path.is_dir()}
    if not set(STEREO) <= sides.keys() or _has_images(root, list(sides.values())):
        return ()
    with_images = {name for name, path in sides.items() if name != "masks" and _has_images(path)}
    if with_images != set(STEREO):
        return ()
    found = tuple(sides[name].name for name in STEREO)
    log.info("%s: %s/ and %s/ are taken as a stereo pair (--rig none: as one camera).", root, *found)
    return found


def _has_images(folder: Path, leave_out: Sequence[Path] = ()) -> bool:
    """Return whether images or camera raw files are below a folder."""
    return bool(find_images(folder, leave_out).paths or find_files(folder, RAW_SUFFIXES, leave_out).paths)


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


def rig_of(cameras: Sequence[str], settings: FrameSettings, size: tuple[int, int] | None = None) -> Rig:
    """The cameras, with their poses where a calibration gives them, and for images of a known size their lenses.

    Raises InputError where the calibration cannot be used.
    """
    path = settings.rig_calibration
    if path is None:
        return Rig(tuple(RigCamera(name) for name in cameras))
    found = read_rig(path, cameras)
    with guard(path, REMEDY):
        lenses = [None if size is None else lens_line(lens, size) for lens in found.lenses]
    known = zip(cameras, found.camera_from_rig, lenses, strict=True)
    return Rig(tuple(RigCamera(name, pose_of(pose), lens) for name, pose, lens in known))


def lens_line(lens: Calibration, size: tuple[int, int]) -> str:
    """A lens in images of a size as a line of COLMAP's cameras.txt. Raises as `lens_at` does."""
    camera = lens_at(lens, *size, None if lens.size else size).camera
    (fx, _, cx), (_, fy, cy), _ = camera.K[0].tolist()
    bent = [*camera.distortion[0].tolist(), 0.0, 0.0, 0.0, 0.0][:4]
    model = camera.model if camera.model == "OPENCV_FISHEYE" else "OPENCV"
    numbers = " ".join(f"{value:.12g}" for value in (fx, fy, cx, cy, *bent))
    return f"1 {model} {size[0]} {size[1]} {numbers}"


def write_lens(draft: Path, rig: Rig, settings: FrameSettings) -> Path | None:
    """Write the lens of the first camera of a calibrated rig beside the frames; None without a calibration."""
    lens = rig.cameras[0].lens
    if settings.rig_calibration is None or lens is None:
        return None
    write_text(draft / LENS, f"{lens}\n")
    return draft / LENS


def pair_images(root: Path, paths: Sequence[Path], cameras: Sequence[str], settings: FrameSettings) -> RigImages:
    """The images of the cameras by instants. Raises InputError where too many have no partner."""
    own = _by_camera(root, paths, cameras)
    found = [_images_of(root, name, files) for name, files in own.items()]
    clocked = all(camera.times is not None for camera in found)
    together = instants_of(found, settings)
    told = missing(together, found, settings)
    instants = [{name: own[name][i] for name, i in instant.items()} for instant in together]
    moment = {path: t for camera in found for path, t in zip(own[camera.name], camera.times or (), strict=False)}
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
    recorded = recorded_on(begin) if clocked else None
    warnings = () if told is None else (f"{told} They are used as they are.",)
    return RigImages(tuple(images), clocked or numbered(own[cameras[0]]), clocked, recorded, warnings)


def _by_camera(root: Path, paths: Sequence[Path], cameras: Sequence[str]) -> dict[str, list[Path]]:
    """The images in the folder of each camera. Raises InputError where one has none."""
    own = {name: [path for path in paths if path.is_relative_to(root / name)] for name in cameras}
    for name, files in own.items():
        if not files:
            raise InputError(
                f"{root / name} holds no images",
                cause="the folder of that camera is empty, or holds another kind of files",
                hint="--rig with the names of the sub-folders that hold images",
            )
    return own


def _images_of(root: Path, name: str, paths: Sequence[Path]) -> CameraImages:
    """The images of a camera's folder."""
    labels = [f"{path.parent.name}/{path.name}" for path in paths]
    return CameraImages(name, labels, _times(paths), [_key(path, root, name) for path in paths])


def _key(path: Path, root: Path, camera: str) -> str:
    """The name of an image without its camera's: left/left_0001.png and right/R-0001.jpg are both 0001."""
    inner = path.relative_to(root / camera).with_suffix("").as_posix().lower()
    words = re.split(r"[^0-9a-z]+", inner)
    if camera.isdecimal():  # other numbers in a name are those of the image
        return "_".join(words[1:] if words[0] == camera and len(words) > 1 else words)
    words = [word.removeprefix(camera.lower()) for word in words]
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
