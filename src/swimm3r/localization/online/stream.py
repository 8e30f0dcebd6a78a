"""A stream of images localized in a run, and the record of it.

A JSON object per image, in the order of the images, on OUT/stream.jsonl as it is found:

    name, time       of the image, seconds; stamp_ns too where the source is a bag
    status           tracked, relocalized or lost
    c2w              4x4, OpenCV camera axes, camera to world, in the axes and `unit` of sfm/cameras.json; null if lost
    covariance       6x6, as ROS's PoseWithCovariance: x, y, z, then turns about the map's axes (radians); null if lost
    inliers          landmarks that agree on the pose, of so many `matches`
    turn             rotation vector of the camera while the image's rows were exposed, radians in its axes; the pose is
                     that of half time. Only in runs whose rows are rectified
    seconds          from the image to the pose
    reason           why it is lost

OUT/stream.tum       timestamp tx ty tz qx qy qz qw of the images that are not lost, where it is asked for
"""

import json
from collections import Counter, deque
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import ExitStack
from dataclasses import dataclass
from decimal import Decimal
from pathlib import Path
from time import perf_counter
from typing import TextIO

import numpy as np
import torch

from swimm3r.cameras import Cameras
from swimm3r.errors import InputError, RegistrationError
from swimm3r.io.trajectory import tum_line
from swimm3r.localization.lenses import unnamed_camera
from swimm3r.localization.online.images import StreamImage
from swimm3r.localization.online.tracker import Keypoints, TrackedPose, Tracker
from swimm3r.prepare.candidates import scaled_down

_AHEAD = 2  # images of a finished source whose keypoints are found while the one before is placed


@dataclass(frozen=True)
class StreamOutcome:
    """Number of images of a stream by their status, and the time it took."""

    counts: Counter[str]
    seconds: float  # from the first image to the last pose
    interrupted: bool  # by Ctrl-C

    @property
    def asked(self) -> int:
        """Number of images."""
        return self.counts.total()

    def __str__(self) -> str:
        per_second = self.asked / self.seconds if self.seconds else 0.0
        parts = ", ".join(f"{self.counts[status]} {status}" for status in ("tracked", "relocalized", "lost"))
        return f"{self.asked} images: {parts}; {per_second:.1f} per second"


@dataclass(frozen=True)
class _Described:
    image: StreamImage
    keypoints: Keypoints | None
    fault: str
    begun: float


def localize_stream(
    tracker: Tracker,
    stream: Iterator[StreamImage],
    out: Path,
    lens: Cameras | None = None,
    say: Callable[[str], None] = lambda _: None,
    *,
    live: bool = False,
    tum: bool = False,
) -> StreamOutcome:
    """Place the images of a stream and write the record; `say` gets every line as it is written.

    Of a `live` stream the next image is asked for when the one before is answered; of others keypoints are found ahead,
    in a second thread. Ctrl-C ends the stream with everything written. Raises RegistrationError where every image is
    lost, unless it was interrupted, InputError where the map is of several lenses and none is given.
    """
    if lens is None and tracker.map.several_lenses:
        raise unnamed_camera()
    counts: Counter[str] = Counter()
    started, interrupted = perf_counter(), False
    if not tum:  # one of an earlier stream would lie beside the record of this one
        (out / "stream.tum").unlink(missing_ok=True)
    with ExitStack() as files:
        record = files.enter_context((out / "stream.jsonl").open("w", encoding="utf-8"))
        path = files.enter_context((out / "stream.tum").open("w", encoding="utf-8")) if tum else None
        try:
            for each in _described(tracker, stream, lens, ahead=0 if live else _AHEAD):
                pose = _located(tracker, each)
                counts[pose.status] += 1
                line = json.dumps(_entry(each, pose, tracker))
                _write(record, line)
                say(line)
                if path is not None and pose.cam2world is not None:
                    _write(path, tum_line(_stamp(each.image), pose.cam2world.numpy()))
        except KeyboardInterrupt:
            interrupted = True
    outcome = StreamOutcome(counts, perf_counter() - started, interrupted)
    if not interrupted and counts["lost"] == outcome.asked:
        raise RegistrationError(
            f"none of the {outcome.asked} images could be placed in the map",
            cause="they show other places than the map, it was made in very different water, or no image came",
            hint="images from nearer to the dive's path; --lens for another camera than the map's",
        )
    return outcome


def _described(
    tracker: Tracker, stream: Iterator[StreamImage], lens: Cameras | None, ahead: int
) -> Iterator[_Described]:
    """The images with their keypoints, those of the next `ahead` images under way."""
    with ThreadPoolExecutor(max_workers=1) as thread:
        waiting = deque()
        for image in stream:
            waiting.append(thread.submit(_describe, tracker, image, lens))
            if len(waiting) > ahead:
                yield waiting.popleft().result()
        while waiting:
            yield waiting.popleft().result()


def _describe(tracker: Tracker, image: StreamImage, lens: Cameras | None) -> _Described:
    begun = perf_counter()
    if image.pixels is None:
        return _Described(image, None, image.fault, begun)
    small = scaled_down(image.pixels, tracker.settings.image_side)
    values = torch.from_numpy(small.astype(np.float32) / np.iinfo(small.dtype).max)
    try:
        return _Described(image, tracker.describe(values, lens=lens), "", begun)
    except InputError as error:  # of another shape than the lens's images
        return _Described(image, None, error.what, begun)


def _located(tracker: Tracker, each: _Described) -> TrackedPose:
    if each.keypoints is None:
        return TrackedPose("lost", None, None, 0, 0, each.fault)
    return tracker.locate(each.keypoints, each.image.time)


def _entry(each: _Described, pose: TrackedPose, tracker: Tracker) -> dict[str, object]:
    stamp = {} if each.image.stamp_ns is None else {"stamp_ns": each.image.stamp_ns}
    return {
        "name": each.image.name,
        "time": round(each.image.time, 9),
        **stamp,
        "status": pose.status,
        "unit": "m" if tracker.map.metric else "scene unit",
        "c2w": None if pose.cam2world is None else pose.cam2world.tolist(),
        "covariance": None if pose.covariance is None else pose.covariance.tolist(),
        "inliers": pose.inliers,
        "matches": pose.matches,
        "seconds": round(perf_counter() - each.begun, 4),
        **({} if pose.turn is None else {"turn": pose.turn.tolist()}),
        **({"reason": pose.reason} if pose.reason else {}),
    }


def _stamp(image: StreamImage) -> float | Decimal:
    return image.time if image.stamp_ns is None else Decimal(image.stamp_ns).scaleb(-9)


def _write(file: TextIO, line: str) -> None:
    """A line that is on disk before the next image."""
    file.write(line + "\n")
    file.flush()
