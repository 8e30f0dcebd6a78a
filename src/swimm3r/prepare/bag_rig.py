"""Several cameras of one bag as a clip of instants: images that were taken together, by the times of their headers."""

import logging
import math
import re
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from itertools import takewhile
from pathlib import Path

import numpy as np
from jaxtyping import UInt8

from swimm3r.errors import InputError, UsageError
from swimm3r.io.bags.clip import BagClip, BagImage
from swimm3r.io.bags.rig import stated_poses
from swimm3r.io.bags.topics import COMPRESSED_END
from swimm3r.io.calibration.documents import from_yaml, read_document
from swimm3r.prepare.instants import CameraImages, instants_of, missing
from swimm3r.prepare.rig import lens_line, rig_of
from swimm3r.scene.rig import Rig, RigCamera, pose_of
from swimm3r.scene.settings import FrameSettings

log = logging.getLogger(__name__)

_TOLD_S = 1.0  # from which images that one camera has before or after the others are told


@dataclass(frozen=True)
class RigInstant:
    """The images of all cameras at one instant."""

    time: float  # of the earliest, seconds of the clip
    images: dict[str, BagImage]  # by camera

    def gray(self, long_side: int) -> UInt8[np.ndarray, "h w"]:
        """Small gray copies side by side."""
        return np.concatenate([image.gray(long_side) for image in self.images.values()], axis=1)


class BagRig:
    """The instants of a bag at which all cameras of a rig have an image; each call of `frames` reads the bag anew."""

    path: Path
    rig: Rig
    width: int  # of each image
    height: int
    seconds: float | None  # from the first instant to the last
    rate: float  # instants per second on average
    recorded: str | None  # date of second 0, ISO 8601; None of a clock that was not set
    start_ns: int  # stamp of second 0, that of the first image since all cameras have some
    lens: str | None  # ROS camera_info of the first camera, as YAML

    def __init__(self, path: Path, settings: FrameSettings) -> None:
        """The topics of `settings.rig`. Raises InputError and UsageError where they are no rig."""
        _check_options(path, settings)
        self.path, self._settings = path, settings
        self._clips = [
            BagClip(path, topic, settings.stamps, start=settings.start, camera_info=settings.camera_info)
            for topic in settings.rig
        ]
        self._notes: list[str] = []
        first = self._clips[0]
        self.width, self.height, self.lens = first.width, first.height, first.lens
        self._check_sizes()
        self.rig = self._rig()
        spans = [(clip.start_ns, clip.start_ns + round((clip.seconds or 0.0) * 1e9)) for clip in self._clips]
        begin, end = max(start for start, _ in spans), min(stop for _, stop in spans)
        if begin >= end:  # clocks that have nothing in common: pairing tells how far they are apart
            begin, end = min(start for start, _ in spans), max(stop for _, stop in spans)
        self._note_more(spans, begin, end)
        begin = self._first_partner(begin)
        for clip in self._clips:
            clip.count_from(begin)
        self.start_ns, self.recorded = begin, first.recorded
        self.seconds = (end - begin) * 1e-9 or None
        self._last = (end - begin + 1) * 1e-9 + settings.rig_tolerance
        self.rate = min(clip.rate for clip in self._clips)

    def frames(self, start: float = 0.0, end: float = math.inf) -> Iterator[RigInstant]:
        """The instants from second `start` up to before second `end`, of which all images decode.

        Raises InputError where too many lack a camera, or where a clock is no clock.
        """
        margin = self._settings.rig_tolerance
        span = max(start - margin, 0.0), min(end + margin, self._last)
        times = {clip.topic.name: clip.times(*span) for clip in self._clips}
        instants = [instant for instant in self._paired(times) if start - 1e-6 <= min(instant) < end]
        beyond = math.nextafter(max(map(max, instants), default=0.0), math.inf)
        reading = [_Reading(clip.frames(span[0], beyond)) for clip in self._clips]
        for instant in instants:
            begin = min(instant)
            found = zip(self.rig.names, reading, instant, strict=True)
            images = {name: image for name, read, time in found if (image := read.at(time)) is not None}
            if len(images) == len(reading):
                yield RigInstant(begin, images)

    def warnings(self) -> list[str]:
        """Faults that were met so far, in plain words."""
        return list(dict.fromkeys([*(note for clip in self._clips for note in clip.warnings()), *self._notes]))

    def _paired(self, times: dict[str, list[float]]) -> list[tuple[float, ...]]:
        """Times of the images of each whole instant, in the order of the cameras; about the others there is a note."""
        cameras = [
            CameraImages(topic, [f"{topic} at {time:.3f} s" for time in found], found) for topic, found in times.items()
        ]
        instants = instants_of(cameras, self._settings)
        told = missing(instants, cameras, self._settings)
        if told is not None:
            self._notes.append(f"{told} They are left out.")
        whole = [instant for instant in instants if len(instant) == len(cameras)]
        return sorted(tuple(times[camera.name][instant[camera.name]] for camera in cameras) for instant in whole)

    def _rig(self) -> Rig:
        """The cameras, with their poses by a calibration, or as the bag states them."""
        settings = self._settings
        names = camera_names(settings.rig)
        stated = None
        if settings.rig_calibration is None:
            stated = stated_poses(self._clips)
        if stated is None:
            rig = rig_of(names, settings, (self.width, self.height))
            return rig if settings.rig_calibration is not None else self._with_lenses(rig)
        poses, where = stated
        bare = Rig(tuple(RigCamera(name, pose_of(pose)) for name, pose in zip(names, poses, strict=True)))
        rig = self._with_lenses(bare)
        first, *others = rig.cameras
        lengths = ", ".join(f"{camera.name} {camera.baseline:.4g} m" for camera in others)
        log.info("%s: from %s by %s: %s.", self.path.name, first.name, where, lengths)
        return rig

    def _with_lenses(self, rig: Rig) -> Rig:
        """The rig with the lenses that the camera_info of its topics state."""
        stated = [None if clip.lens is None else read_document(from_yaml(clip.lens))[0] for clip in self._clips]
        size = self.width, self.height
        lines = [None if lens is None else lens_line(lens, size) for lens in stated]
        return Rig(tuple(replace(camera, lens=line) for camera, line in zip(rig.cameras, lines, strict=True)))

    def _first_partner(self, begin: int) -> int:
        """The stamp of the first image that may belong to the same instant as one at a stamp."""
        margin = self._settings.rig_tolerance
        stamps = [begin]
        for clip in self._clips:
            at = (begin - clip.start_ns) * 1e-9
            stamps += [clip.start_ns + round(time * 1e9) for time in clip.times(at - margin, at + 1e-9)]
        return min(stamps)

    def _check_sizes(self) -> None:
        for clip in self._clips[1:]:
            if (clip.width, clip.height) != (self.width, self.height):
                raise InputError(
                    f"{clip.topic.name} in {self.path} has images of {clip.width}x{clip.height}, and"
                    f" {self._clips[0].topic.name} of {self.width}x{self.height}",
                    cause="the cameras are of different kinds, or one of the topics is reduced",
                    hint="--rig with topics of images of one size; swimm3r topics lists them",
                )

    def _note_more(self, spans: Sequence[tuple[int, int]], begin: int, end: int) -> None:
        for clip, (start, stop) in zip(self._clips, spans, strict=True):
            more = (max(0, begin - start) + max(0, stop - end)) * 1e-9
            if more > _TOLD_S:
                self._notes.append(
                    f"{clip.topic.name} has images for {more:.1f} s during which another camera of the rig has none:"
                    " they are left out."
                )


class _Reading:
    """The images of a clip, asked for in the order of their times."""

    def __init__(self, images: Iterator[BagImage]) -> None:
        self._images = images
        self._next = next(images, None)

    def at(self, time: float) -> BagImage | None:
        """The image of that time; None where it is damaged."""
        while self._next is not None and self._next.time < time:
            self._next = next(self._images, None)
        return self._next if self._next is not None and self._next.time == time else None


def camera_names(topics: Sequence[str]) -> tuple[str, ...]:
    """Names of the cameras: the parts by which their topics differ, left of /stereo/left/image_raw."""
    parts = [topic.removesuffix(COMPRESSED_END).strip("/").split("/") for topic in topics]
    before = sum(1 for _ in takewhile(lambda same: len(set(same)) == 1, zip(*parts, strict=False)))
    ends = [row[before:][::-1] for row in parts]
    after = sum(1 for _ in takewhile(lambda same: len(set(same)) == 1, zip(*ends, strict=False)))
    names = tuple(re.sub(r"\W+", "_", "_".join(row[after:][::-1])) for row in ends)
    return names if all(names) and len(set(names)) == len(names) else tuple(f"camera{k}" for k in range(len(topics)))


def _check_options(path: Path, settings: FrameSettings) -> None:
    if len(set(settings.rig)) < max(2, len(settings.rig)):
        raise UsageError(
            f"--rig names {' '.join(settings.rig)}, and a rig has two cameras and more",
            cause="of a bag, it takes the topics of images of all cameras",
            hint=f"--rig TOPIC_LEFT TOPIC_RIGHT; swimm3r topics {path} lists them",
        )
    if settings.topic is not None:
        raise UsageError(
            f"--topic {settings.topic} and --rig name cameras",
            cause="--topic takes one camera of a bag, --rig several",
            hint="leave out one of the two",
        )
    if settings.rig_pairs == "name":
        raise UsageError(
            "--rig-pairs name is for images in files",
            cause="images of a bag have times and no names",
            hint="leave it out: images of a bag are paired by the times of their headers",
        )
