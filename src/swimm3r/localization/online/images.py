"""Images of a stream in the order they were taken: of a folder, which may still be written, of a video or of a bag."""

import math
import time
from collections.abc import Iterator
from dataclasses import dataclass, replace
from pathlib import Path

from swimm3r.errors import InputError, UsageError
from swimm3r.io import images
from swimm3r.io.bags.bag import is_bag
from swimm3r.io.bags.clip import BagClip
from swimm3r.io.image_folder import GrowingFolder, find_images
from swimm3r.io.images import Rgb
from swimm3r.localization.settings import StreamSettings
from swimm3r.prepare.clip import open_camera
from swimm3r.scene.settings import FrameSettings

_POLL_S = 0.1  # between two looks into a folder
_UNFINISHED_S = 2.0  # after its last change a file that does not decode is damaged, not still being written


@dataclass(frozen=True)
class StreamImage:
    """An image, or that a file is none."""

    name: str
    time: float  # seconds since the first image; of a folder by the files' times of modification
    pixels: Rgb | None  # None where it cannot be read
    stamp_ns: int | None = None  # of a bag, nanoseconds since 1970
    fault: str = ""  # why it cannot be read


def stream_images(source: Path, settings: StreamSettings) -> Iterator[StreamImage]:
    """The images of a source, which is looked into at once.

    Raises InputError where it holds none, UsageError where a file is to be followed.
    """
    if not source.exists():
        raise InputError(
            f"there is no {source}",
            cause="a slip in the name, or a disk that is not mounted",
            hint="--stream with a folder of images, a video or a ROS bag",
        )
    if source.is_dir() and not is_bag(source):
        found = _followed(source, settings) if settings.follow else _of_folder(source)
    elif settings.follow:
        raise UsageError(
            f"{source} cannot be followed: it is no folder of images",
            cause="--follow is for images that a camera writes one by one",
            hint="leave out --follow; a video or a bag is read to its end",
        )
    else:
        found = _of_clip(source, settings)
    return _thinned(found, settings.fps)


def _thinned(found: Iterator[StreamImage], fps: float) -> Iterator[StreamImage]:
    """At most so many images per second; 0 keeps all."""
    taken: int | None = None  # the interval of 1 / fps that the last image was taken from
    for image in found:
        interval = int(image.time * fps + 1e-6)
        if fps and interval == taken:
            continue
        taken = interval
        yield image


def _of_clip(source: Path, settings: StreamSettings) -> Iterator[StreamImage]:
    clip = open_camera(source, FrameSettings(topic=settings.topic, stamps=settings.stamps))
    start = clip.start_ns if isinstance(clip, BagClip) else None

    def images_of() -> Iterator[StreamImage]:
        for number, frame in enumerate(clip.frames()):
            stamp = None if start is None else start + round(frame.time * 1e9)
            yield StreamImage(f"{number:06d}", frame.time, frame.rgb(), stamp)

    return images_of()


def _of_folder(folder: Path) -> Iterator[StreamImage]:
    paths = find_images(folder).paths
    if not paths:
        raise InputError(
            f"{folder} holds no images",
            cause="another folder was meant, or the camera has written nothing yet",
            hint="--follow, which waits for them",
        )
    clock = _Clock()
    return (_image(path, folder, clock.seconds(path)) for path in paths)


def _followed(folder: Path, settings: StreamSettings) -> Iterator[StreamImage]:
    """Images as they appear. One that is still being written is waited for, and those after it with it."""
    growing, clock, waiting = GrowingFolder(folder), _Clock(), list[Path]()
    idle_since = time.monotonic()
    while not settings.idle or time.monotonic() - idle_since < settings.idle:
        waiting += _new_images(growing, folder)
        if settings.latest:
            waiting = waiting[-1:]
        while waiting:
            image = _image(waiting[0], folder, clock.seconds(waiting[0]))
            if image.pixels is None and time.time() - clock.changed < _UNFINISHED_S:
                break
            del waiting[0]
            yield image
            idle_since = time.monotonic()  # after the image was placed, however long that took
        time.sleep(_POLL_S)


def _new_images(growing: GrowingFolder, folder: Path) -> list[Path]:
    try:
        return growing.new_images()
    except FileNotFoundError as error:
        raise InputError(
            f"{folder} is no longer there",
            cause="it was removed or renamed, or its disk was taken away",
            hint="--stream with the folder that the camera writes to",
        ) from error


class _Clock:
    """Times of files by their last changes."""

    def __init__(self) -> None:
        self.changed = -math.inf  # the file asked for last, seconds since 1970; minus infinity where it was removed
        self._first: float | None = None
        self._seconds = 0.0

    def seconds(self, path: Path) -> float:
        """Seconds from the first file to this one; of a file that was removed, to the one before it."""
        try:
            self.changed = path.stat().st_mtime
        except FileNotFoundError:
            self.changed = -math.inf
            return self._seconds
        self._first = self.changed if self._first is None else self._first
        self._seconds = self.changed - self._first
        return self._seconds


def _image(path: Path, folder: Path, seconds: float) -> StreamImage:
    found = StreamImage(path.relative_to(folder).as_posix(), seconds, None)
    try:
        return replace(found, pixels=images.read_rgb(path))
    except InputError as error:
        return replace(found, fault=error.what)
