"""Images of a stream in the order they were taken: of a folder, which may still be written, of a video or of a bag."""

import time
from collections.abc import Iterator
from dataclasses import dataclass, replace
from pathlib import Path

from swimm3r.errors import InputError, UsageError
from swimm3r.io import images
from swimm3r.io.bags.bag import is_bag
from swimm3r.io.bags.clip import BagClip
from swimm3r.io.image_folder import find_images
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
    """The images of a source. Raises InputError where it is none, UsageError where a file is to be followed."""
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
    for number, frame in enumerate(clip.frames()):
        stamp = None if start is None else start + round(frame.time * 1e9)
        yield StreamImage(f"{number:06d}", frame.time, frame.rgb(), stamp)


def _of_folder(folder: Path) -> Iterator[StreamImage]:
    paths = find_images(folder).paths
    if not paths:
        raise InputError(
            f"{folder} holds no images",
            cause="another folder was meant, or the camera has written nothing yet",
            hint="--follow, which waits for them",
        )
    first = paths[0].stat().st_mtime
    for path in paths:
        yield _image(path, folder, first)


def _followed(folder: Path, settings: StreamSettings) -> Iterator[StreamImage]:
    """Images as they appear. One that is still being written is waited for, and those after it with it."""
    taken: set[Path] = set()
    first: float | None = None
    last = time.monotonic()
    while not settings.idle or time.monotonic() - last < settings.idle:
        new = [path for path in find_images(folder).paths if path not in taken]
        if settings.latest:
            taken.update(new[:-1])
            new = new[-1:]
        for path in new:
            changed = path.stat().st_mtime
            first = changed if first is None else first
            image = _image(path, folder, first)
            if image.pixels is None and time.time() - changed < _UNFINISHED_S:
                break
            taken.add(path)
            last = time.monotonic()
            yield image
        time.sleep(_POLL_S)


def _image(path: Path, folder: Path, first: float) -> StreamImage:
    found = StreamImage(path.relative_to(folder).as_posix(), path.stat().st_mtime - first, None)
    try:
        return replace(found, pixels=images.read_rgb(path))
    except InputError as error:
        return replace(found, fault=error.what)
