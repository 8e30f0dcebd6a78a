"""From a source to a complete folder of frames, and back from the folder.

The folder appears when it is complete, and not before. frames.json holds name, time, split, sharpness and mask of each
frame, and width, height, ordered, gray, masks (how many are used and unused), source, date of the recording, stamp of
second 0, lens, development of raw or log images, and warnings of them all.
"""

import logging
import os
import shutil
from collections.abc import Callable, Container, Iterator
from contextlib import contextmanager, suppress
from dataclasses import dataclass, replace
from datetime import datetime
from functools import lru_cache, partial
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import UInt8

from swimm3r.cameras import Cameras
from swimm3r.errors import InputError
from swimm3r.io import images
from swimm3r.io.bags.bag import is_bag, open_bag
from swimm3r.io.files.atomic import DRAFT
from swimm3r.io.files.cache_key import cache_key, given_digest
from swimm3r.io.files.damage import guard, remake
from swimm3r.io.files.json_file import read_json
from swimm3r.io.files.safe_names import check_name, check_names, shown_name
from swimm3r.io.video import Video
from swimm3r.prepare.candidates import SelectedImages, SourceImage, small_gray, target_size
from swimm3r.prepare.clip import prepare_clip
from swimm3r.prepare.image_folder import images_of, only_video, prepare_stills, source_digest
from swimm3r.prepare.keyframes import SIDE as MOTION_SIDE
from swimm3r.prepare.keyframes import Gray
from swimm3r.prepare.masks import check_masks, prepare_masks
from swimm3r.prepare.rotation import RotationMotion, rotation_motion
from swimm3r.prepare.split import split_frames
from swimm3r.progress import Progress, silent
from swimm3r.scene.frames import Frame, Frames, Part, write_index
from swimm3r.scene.rig import Rig, first_of_instants
from swimm3r.scene.settings import FrameSettings

LensOf = Callable[[int, int, Path | None], Cameras | None]
"""The lens of frames of a width and a height, by the calibration file of their source or a better one; None unknown."""

log = logging.getLogger(__name__)

LEAST = 3  # frames: the first is held back for testing, and depth takes two
_HELD = 8  # small copies in memory while the frames are split


def read_frames(
    source: str | Path,
    settings: FrameSettings | None = None,
    folder: Path | None = None,
    progress: Progress = silent,
    lens: LensOf | None = None,
    **changes: Any,
) -> Frames:
    """See `swimm3r.prepare.read_frames`."""
    settings = replace(settings or FrameSettings(), **changes)
    check_masks(settings)
    given, source = Path(source), check_source(Path(source))
    if source != given:
        log.info("%s holds no images and one video, which is taken: %s", given, source.name)
    if folder is None:
        if lens is not None:
            raise ValueError("frames of a known lens are prepared into a folder of their own, and none was given")
        folder = _cache_folder(source, settings)
        if (folder / "frames.json").is_file():
            return load_frames(folder)
    with _whole_folder(folder) as draft:
        if source.is_dir() and not is_bag(source):
            dive = prepare_stills(source, draft, settings, progress, leave_out=[folder, folder.parent])
        else:
            dive = prepare_clip(source, draft, settings, progress)
        _write_frames(dive, draft, source, settings, progress, lens)
    return load_frames(folder)


@dataclass(frozen=True)
class _Entry:
    """A frame in frames.json."""

    name: str
    time: float
    sharpness: float
    split: Part
    mask: str | None = None
    camera: str | None = None
    instant: int | None = None
    up: tuple[float, float, float] | None = None
    gains: tuple[float, float, float] | None = None

    def __post_init__(self) -> None:
        if self.gains is not None and not min(self.gains) > 0:
            raise ValueError(f"gains of an exposure are above 0, got {list(self.gains)} of {self.name}")


@dataclass(frozen=True)
class _Masks:
    unused: int = 0


@dataclass(frozen=True)
class _Document:
    """frames.json."""

    width: int
    height: int
    ordered: bool
    frames: tuple[_Entry, ...]
    warnings: tuple[str, ...] = ()
    gray: bool = False
    masks: _Masks = _Masks()
    recorded: str | None = None
    start_ns: int | None = None
    calibration: str | None = None
    rig: Rig | None = None
    development: str | None = None
    rows_rectified: bool = False
    timed: bool = True

    def __post_init__(self) -> None:
        if min(self.width, self.height) < 1:
            raise ValueError(f"frames have a size in whole pixels, got {self.width}x{self.height}")
        if not self.frames:
            raise ValueError("it names no frames")
        if self.recorded is not None:
            datetime.fromisoformat(self.recorded)
        check_names(entry.name for entry in self.frames)
        cameras = {None} if self.rig is None else set(self.rig.names)
        if unknown := {entry.camera for entry in self.frames} - cameras:
            raise ValueError(f"its frames are of a camera {unknown.pop()}, which its rig does not have")


def load_frames(folder: Path) -> Frames:
    """Load the frames that `read_frames` prepared in a folder. Raises InputError where they are incomplete."""
    path, remedy = folder / "frames.json", remake(folder)
    document = read_json(path, _Document, remedy)
    with guard(path, remedy):
        frames = tuple(
            Frame(
                name=entry.name,
                path=_inside(folder, entry.name),
                time=entry.time,
                sharpness=entry.sharpness,
                split=entry.split,
                mask=_inside(folder, entry.mask) if entry.mask else None,
                camera=entry.camera,
                instant=entry.instant,
                up=entry.up,
                gains=entry.gains,
            )
            for entry in document.frames
        )
        calibration = _inside(folder, document.calibration) if document.calibration else None
    return Frames(
        frames,
        document.width,
        document.height,
        document.ordered,
        document.warnings,
        gray=document.gray,
        unused_masks=document.masks.unused,
        recorded=document.recorded,
        start_ns=document.start_ns,
        calibration=calibration,
        rig=document.rig,
        development=document.development,
        rows_rectified=document.rows_rectified,
        timed=document.timed,
    )


def check_source(source: Path) -> Path:
    """See `swimm3r.prepare.check_source`."""
    try:
        return _checked(source)
    except OSError as error:
        raise InputError(
            f"{shown_name(source)} cannot be read: {error.strerror}",
            cause="it belongs to another user, lies in a folder that may not be entered, or its name is too long",
            hint="check the name; change the permissions (chmod -R u+rX FOLDER), or copy it to a folder of your own",
        ) from error


def _checked(source: Path) -> Path:
    if is_bag(source):
        with open_bag(source):
            return source
    if source.is_dir():
        video = only_video(source)
        if video is None:
            images_of(source)
            return source
        source = video
    elif not source.exists():
        raise InputError(
            f"there is no {source}",
            cause="a slip in the name, or a disk that is not mounted",
            hint="give the path of a video, of a ROS bag, or of a folder with images",
        )
    elif source.suffix.lower() in images.SUFFIXES:
        raise InputError(
            f"{source} is a single image",
            cause="one image shows no depth",
            hint="give the folder that holds the images of the dive",
        )
    Video(source)
    return source


def _write_frames(
    dive: SelectedImages,
    draft: Path,
    source: Path,
    settings: FrameSettings,
    progress: Progress,
    lens: LensOf | None,
) -> None:
    """Masks and frames.json; frames.json is the last file of the folder."""
    warnings = list(dive.warnings)
    size = target_size(dive.images[0].size, settings.long_side) if dive.images else (0, 0)
    masks = prepare_masks(dive, draft, size, settings, warnings)
    kept = _unmasked(dive, masks.covered, warnings)
    if len(kept) < LEAST:
        raise InputError(
            f"{source} gives {len(kept)} usable frame{'s' * (len(kept) != 1)}, and at least {LEAST} are needed",
            cause=" ".join(warnings) or "the clip is too short, or the images are too few",
            hint="more images with overlap, a longer clip, or a larger fps",
        )
    known = None if lens is None else partial(lens, *size, dive.calibration)
    parts = _parts(replace(dive, images=kept), draft, settings, progress, known)
    listed = tuple(
        Frame(
            name=image.name,
            path=draft / image.name,
            time=round(image.time, 9),
            sharpness=round(image.sharpness, 3),
            split=part,
            mask=draft / masks.places[image.name] if image.name in masks.places else None,
            camera=image.camera,
            instant=image.instant,
            up=image.up,
            gains=image.gains,
        )
        for image, part in zip(kept, parts, strict=True)
    )
    _remove_all_but(draft, {dive.calibration, *(path for frame in listed for path in (frame.path, frame.mask))})
    frames = Frames(
        listed,
        *size,
        dive.ordered,
        tuple(warnings),
        gray=all(image.gray for image in kept),
        unused_masks=masks.unused,
        recorded=dive.recorded,
        start_ns=dive.start_ns,
        calibration=dive.calibration,
        rig=dive.rig,
        development=dive.development,
        timed=dive.timed,
    )
    write_index(draft, frames, str(source.resolve()))


def _unmasked(dive: SelectedImages, covered: Container[str], warnings: list[str]) -> list[SourceImage]:
    """The images that are not masked out wholly. Raises InputError where all are."""
    kept = [image for image in dive.images if image.name not in covered]
    if dive.images and not kept:
        raise InputError(
            f"the masks leave nothing: every one of {len(dive.images)} frames is wholly masked out",
            cause="the masks are the wrong way round; here 0 means leave out, anything else means use",
            hint="invert the masks, or run without them",
        )
    if len(kept) < len(dive.images):
        left_out = len(dive.images) - len(kept)
        warnings.append(f"{left_out} frames were left out because their masks cover them wholly.")
    return kept


def _parts(
    dive: SelectedImages,
    draft: Path,
    settings: FrameSettings,
    progress: Progress,
    lens: Callable[[], Cameras | None] | None,
) -> list[Part]:
    """The part of each image; those of one instant of a rig are of one part."""
    starts = first_of_instants([image.instant for image in dive.images])
    first = [dive.images[start] for start in starts]

    @lru_cache(maxsize=_HELD)
    def gray_of(i: int) -> UInt8[np.ndarray, "h w"]:
        return small_gray(images.read_rgb(draft / first[i].name), MOTION_SIDE)

    def rotation(gray_of: Callable[[int], Gray]) -> RotationMotion | None:
        if dive.gyroscope is None:
            return None
        times = [image.time for image in first]
        return rotation_motion(dive.gyroscope, times, gray_of, None if lens is None else lens())

    sharpness = [image.sharpness for image in first]
    of_instant = split_frames(gray_of, sharpness, settings, progress, ordered=dive.ordered, rotation=rotation)
    counts = np.diff([*starts, len(dive.images)])
    return [part for part, count in zip(of_instant, counts, strict=True) for _ in range(count)]


def _inside(folder: Path, name: str) -> Path:
    """The file of that name in the folder. Names come from a file: they must not lead out of it."""
    check_name(name)
    path = folder / name
    if not path.is_file():
        raise ValueError(f"{name} is missing")
    return path


def _remove_all_but(folder: Path, kept: set[Path | None]) -> None:
    """Drop what was written for frames that were left out in the end."""
    for path in folder.rglob("*"):
        if path.is_file() and path not in kept:
            path.unlink()


@contextmanager
def _whole_folder(folder: Path) -> Iterator[Path]:
    """A draft that takes the place of `folder` if the block succeeds, and leaves no trace if not."""
    if folder.exists() and any(folder.iterdir()) and not (folder / "frames.json").is_file():
        raise InputError(
            f"{folder} is not empty and holds no prepared frames",
            cause="the folder is used for something else",
            hint="a folder that does not exist yet",
        )
    missing = [parent for parent in folder.parents if not parent.exists()]
    draft = folder.with_name(f"{DRAFT}{folder.name}")
    shutil.rmtree(draft, ignore_errors=True)  # left by a run that was killed
    draft.mkdir(parents=True)
    try:
        yield draft
        if folder.exists():
            shutil.rmtree(folder)
        draft.rename(folder)
    except BaseException:
        shutil.rmtree(draft, ignore_errors=True)
        with suppress(OSError):  # somebody else has put something there meanwhile
            for parent in missing:
                parent.rmdir()
        raise


def _cache_folder(source: Path, settings: FrameSettings) -> Path:
    """Folder in the cache for frames that were given none; the same source, settings and files find it again."""
    named = [None if path is None else given_digest(path) for path in (settings.masks, settings.rig_calibration)]
    key = cache_key(str(source.resolve()), source_digest(source), settings, *named)[:16]
    return Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache") / "swimm3r" / "frames" / key
