"""A video or the camera of a bag -> one frame of each bin of 1/fps seconds, of which the best alone is in memory."""

from collections.abc import Iterator
from dataclasses import dataclass, replace
from itertools import groupby
from math import ceil, inf
from pathlib import Path
from typing import Literal

import numpy as np
from jaxtyping import UInt8, UInt16

from swimm3r.errors import InputError, UsageError
from swimm3r.io import images
from swimm3r.io.bags.bag import is_bag
from swimm3r.io.bags.clip import BagClip, BagImage
from swimm3r.io.files.atomic import write_text
from swimm3r.io.images import Rgb
from swimm3r.io.telemetry.gyroscope import gyroscope_of
from swimm3r.io.video import Video, VideoFrame
from swimm3r.prepare.bag_rig import BagRig, RigInstant
from swimm3r.prepare.candidates import (
    BLANK,
    GRAY_SIDE,
    STEP,
    SelectedImages,
    SourceImage,
    blank_warning,
    is_gray,
    scaled_down,
    sharpness,
    small_gray,
    thinned,
)
from swimm3r.prepare.development import Development, developed, developed_gray, development_of
from swimm3r.prepare.rig import NONE, SIDE_BY_SIDE, STEREO, rig_of, write_lens
from swimm3r.prepare.telemetry import with_telemetry
from swimm3r.progress import Progress
from swimm3r.scene.settings import FrameSettings

Camera = Video | BagClip
Clip = Camera | BagRig
ClipFrame = VideoFrame | BagImage | RigInstant

Half = UInt8[np.ndarray, "rows columns 3"] | UInt16[np.ndarray, "rows columns 3"]

LENS = "camera_info.yaml"  # the lens that a bag states, beside the frames


@dataclass(frozen=True)
class _View:
    """An image of one camera at a moment of a clip."""

    camera: str | None  # of a rig
    time: float
    pixels: Rgb


def open_camera(source: Path, settings: FrameSettings) -> Camera:
    """A video, or one camera of a bag. Raises InputError, and UsageError where a bag holds several."""
    if not is_bag(source):
        return Video(source)
    return BagClip(source, settings.topic, settings.stamps, start=settings.start, camera_info=settings.camera_info)


def open_clip(source: Path, settings: FrameSettings) -> Clip:
    """A video, a camera of a bag, or the rig whose topics are named. Raises InputError and UsageError."""
    if settings.rig in ((), (NONE,), (SIDE_BY_SIDE,)):
        return open_camera(source, settings)
    if is_bag(source):
        return BagRig(source, settings)
    raise UsageError(
        f"--rig {' '.join(settings.rig)} names sub-folders or topics, and {source.name} is a video",
        cause="of videos, only those that show two views side by side are rigs",
        hint="--rig side-by-side; or write the images of each camera into a folder of its name",
    )


class _Reading:
    """The frames of a clip within the seconds asked for, in bins of 1/fps, and how far they were read."""

    def __init__(self, clip: Clip, settings: FrameSettings, progress: Progress) -> None:
        self._clip, self._start, self._progress = clip, settings.start, progress
        self._end = settings.end if settings.end is not None else inf
        self.last = min(self._end, clip.seconds if clip.seconds is not None else inf)  # second; infinite if unknown
        self._rate = settings.fps or inf
        if settings.max_frames and self.last < inf:
            self._rate = min(self._rate, settings.max_frames / max(self.last - self._start, 1e-3))
        self._expected = ceil((self.last - self._start) * clip.rate) if self.last < inf else 0
        self.seen = 0
        self.reached = 0.0  # second of the last frame

    def bins(self) -> Iterator[Iterator[ClipFrame]]:
        """The frames of each bin that has any; every frame by itself at an unlimited rate."""
        for _, frames in groupby(self._frames(), self._bin):
            yield frames
        self._progress(STEP, max(self.seen, 1), max(self.seen, 1))

    def _frames(self) -> Iterator[ClipFrame]:
        for frame in self._clip.frames(self._start, self._end):
            self._progress(STEP, self.seen, max(self._expected, self.seen))
            self.seen, self.reached = self.seen + 1, frame.time
            yield frame

    def _bin(self, frame: ClipFrame) -> int:
        return int((frame.time - self._start) * self._rate + 1e-6) if self._rate < inf else self.seen


def prepare_clip(source: Path, draft: Path, settings: FrameSettings, progress: Progress) -> SelectedImages:
    """Write the frames of a clip into `draft`, in one pass. Raises InputError."""
    clip = open_clip(source, settings)
    development = development_of(settings)
    reading = _Reading(clip, settings, progress)
    instants: list[list[SourceImage]] = []
    blank = 0
    for frames in reading.bins():
        best = _best(frames, settings.pick, development)
        if best is None:
            blank += 1
            continue
        views = _views(best[0], split=settings.rig == (SIDE_BY_SIDE,))
        instants.append([_written(view, best[1], len(instants), draft, settings, development) for view in views])
    if not reading.seen:
        raise InputError(
            f"{source} has no frames from second {settings.start:g} on",
            cause="the video is shorter than that, or cut off",
            hint="a smaller start",
        )
    warnings = [blank_warning(blank, "times of the video")] if blank else []
    warnings += _warnings(clip, reading.last, reading.reached)
    mask_folders = [settings.masks] if settings.masks is not None else []
    kept = [image for views in thinned(instants, settings.max_frames) for image in views]
    originals = [image.original for views in instants for image in views]
    told = str(development) if development.changes else None
    chosen = SelectedImages(kept, True, warnings, mask_folders, originals, recorded=clip.recorded, development=told)
    return _completed(chosen, clip, draft, settings) if kept else chosen


def _completed(chosen: SelectedImages, clip: Clip, draft: Path, settings: FrameSettings) -> SelectedImages:
    """The images with all that their clip tells about them: telemetry, clock, lens and rig."""
    if isinstance(clip, Video):
        images = with_telemetry(chosen.images, clip.path)
        chosen = replace(chosen, images=images, gyroscope=gyroscope_of(clip.path))
    else:
        chosen = _of_bag(chosen, clip, draft)
    if isinstance(clip, BagRig):
        rig = clip.rig
    elif settings.rig == (SIDE_BY_SIDE,):
        rig = rig_of(STEREO, settings, chosen.images[0].size)
    else:
        return chosen
    lens = write_lens(draft, rig, settings)
    return replace(chosen, rig=rig, calibration=lens or chosen.calibration)


def _of_bag(chosen: SelectedImages, clip: BagClip | BagRig, draft: Path) -> SelectedImages:
    """The images with the clock of their headers, and the lens that the bag states."""
    if clip.lens is None:
        return replace(chosen, start_ns=clip.start_ns)
    write_text(draft / LENS, clip.lens)
    return replace(chosen, start_ns=clip.start_ns, calibration=draft / LENS)


def _views(frame: ClipFrame, *, split: bool) -> list[_View]:
    """The image of a moment: its two halves where it is `split`, and of a rig one for each camera."""
    if isinstance(frame, RigInstant):
        return [_View(camera, image.time, image.rgb()) for camera, image in frame.images.items()]
    if not split:
        return [_View(None, frame.time, frame.rgb())]
    return [_View(camera, frame.time, half) for camera, half in halves(frame.rgb()).items()]


def _written(
    view: _View,
    sharp: float,
    instant: int,
    draft: Path,
    settings: FrameSettings,
    development: Development,
) -> SourceImage:
    """A view on disk."""
    name = f"frame_{instant:06d}.png" if view.camera is None else f"{view.camera}/frame_{instant:06d}.png"
    rgb = scaled_down(developed(view.pixels, development), settings.long_side)
    images.write_rgb(draft / name, rgb)
    size = view.pixels.shape[1], view.pixels.shape[0]
    of_rig = None if view.camera is None else instant
    return SourceImage(name, Path(name), size, view.time, sharp, is_gray(rgb), view.camera, of_rig)


def halves(image: Rgb) -> dict[str, Half]:
    """The left and the right half of an image that shows two views side by side."""
    width = image.shape[1] // 2
    left, right = STEREO
    return {left: image[:, :width], right: image[:, image.shape[1] - width :]}


def _warnings(video: Clip, last: float, reached: float) -> list[str]:
    """The warnings about a clip that was read up to second `reached` and should last until `last`."""
    name, warnings = video.path.name, video.warnings()
    if last < inf and last - reached > max(1.0, 0.02 * last, 2 / video.rate):
        warnings.append(
            f"{name} should last {last:.1f} s, but ends at {reached:.1f} s: it is cut off or damaged. "
            "What decoded is used; copy it again if the original is longer."
        )
    return warnings


def _best(
    frames: Iterator[ClipFrame], pick: Literal["sharpest", "uniform"], development: Development
) -> tuple[ClipFrame, float] | None:
    """The frame to take of a bin with its sharpness; None where all show nothing."""
    best: tuple[ClipFrame, float] | None = None
    for frame in frames:
        if best and pick == "uniform":
            continue
        gray = _judged_gray(frame, development)
        if gray.std() < BLANK:
            continue
        sharp = sharpness(gray)
        if best is None or sharp > best[1]:
            best = (frame, sharp)
    return best


def _judged_gray(frame: ClipFrame, development: Development) -> UInt8[np.ndarray, "rows columns"]:
    """The small gray copy that a frame is judged by, developed as the frame will be: linear light is dark before."""
    if not development.changes:
        return frame.gray(GRAY_SIDE)
    if isinstance(frame, VideoFrame):
        return developed_gray(frame.gray(GRAY_SIDE), development)
    views = frame.images.values() if isinstance(frame, RigInstant) else [frame]
    small = [developed(scaled_down(view.rgb(), GRAY_SIDE), development) for view in views]
    return np.concatenate([small_gray(view) for view in small], axis=1)
