"""The images of one topic as a clip, like those of a video (`swimm3r.io.video.Video`).

Times are those of the headers, counted from the first image. A header that is zero, or a clock that runs back or leaps
ahead, is refused with the number of the image: times of recording (`stamps="received"`) take their place if asked.
"""

import math
from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from datetime import UTC, datetime
from functools import cached_property
from pathlib import Path
from typing import Any, Literal

import numpy as np
from jaxtyping import UInt8

from swimm3r.errors import InputError, Swimm3rError
from swimm3r.io.bags.bag import Bag, Message, open_bag
from swimm3r.io.bags.lens import LensChange, change_warning, lens_numbers, lens_text
from swimm3r.io.bags.pixels import compressed_image_of, image_of
from swimm3r.io.bags.topics import IMAGE, Topic, choose_images, lens_topic, topics_of
from swimm3r.io.calibration.documents import from_yaml, read_document
from swimm3r.io.calibration.record import lens_at
from swimm3r.io.files.damage import first_line
from swimm3r.io.images import Rgb

Stamps = Literal["header", "received"]

_TRIED = 100  # messages of a lens after the start among which a calibrated one is looked for: drivers are set up late
_STAMPED = 12  # bytes of a message that end with its stamp: another one of the same content differs in these alone
_LEAP = 60.0  # seconds that a header may be ahead of the recording between two images: buffers hold less
_FIRST_YEAR = 631_152_000  # 1990 in seconds since 1970: earlier stamps are of a clock that was never set


@dataclass(frozen=True)
class BagImage:
    """An image message; its pixels are only decoded when asked for."""

    time: float  # seconds since the first image
    _message: Message
    _clip: "BagClip"
    _bag: Bag

    def gray(self, long_side: int) -> UInt8[np.ndarray, "h w"]:
        """A small gray copy."""
        import cv2

        height, width = self._pixels.shape[:2]
        scale = min(1.0, long_side / max(width, height))
        size = max(1, round(width * scale)), max(1, round(height * scale))
        small = cv2.resize(self._pixels, size, interpolation=cv2.INTER_AREA)
        small = small if small.dtype == np.uint8 else np.right_shift(small, 8).astype(np.uint8)
        return cv2.cvtColor(small, cv2.COLOR_RGB2GRAY)

    def rgb(self) -> Rgb:
        """The image at full size."""
        return self._pixels

    @cached_property
    def _pixels(self) -> Rgb:
        return self._clip.decoded(self._bag.content(self._message), self._message)


class BagClip:
    """The images of a topic, looked into; each call of `frames` reads the bag anew."""

    path: Path
    topic: Topic
    width: int
    height: int
    seconds: float | None  # from the first header to the last
    rate: float  # images per second on average
    recorded: str | None  # date of the first header, ISO 8601; None of a clock that was not set
    start_ns: int  # stamp of second 0, by default that of the first image
    lens: str | None  # ROS camera_info of the images, as YAML; None where it is not asked for or cannot be used
    damaged: int  # messages that did not decode so far
    interlaced: bool
    frame_id: str  # of the images' axes, as the first one states them

    def __init__(
        self,
        path: Path,
        topic: str | None = None,
        stamps: Stamps = "header",
        *,
        start: float = 0.0,
        camera_info: bool = True,
    ) -> None:
        """Take the lens of the images from second `start` on, unless no `camera_info` is wanted.

        Raises InputError where the bag cannot be read or has no images, UsageError where a topic is to be chosen.
        """
        self.path, self.stamps = path, stamps
        self.damaged, self.interlaced, self._notes, self._cut = 0, False, [], None
        self._lens_changes: list[LensChange] = []
        with open_bag(path) as bag:
            topics = topics_of(bag)
            self.topic = choose_images(topics, topic)
            first, last = bag.first(self.topic.name), bag.last(self.topic.name)
            assert first is not None  # or it would be no topic
            assert last is not None
            self.frame_id, image = self._first_decoded(bag)
            self.height, self.width = image.shape[:2]
            self._first_received = first.received
            self.start_ns, end = self._stamp(first), self._stamp(last)
            self._info = lens_topic(topics, self.topic) if camera_info else None
            self.lens = self._lens(bag, start) if camera_info else None
        self.seconds = (end - self.start_ns) * 1e-9 if end > self.start_ns else None
        self.rate = (self.topic.count - 1) / self.seconds if self.seconds else 1.0
        self.recorded = recorded_at(self.start_ns)

    def count_from(self, stamp: int) -> None:
        """Move second 0 to a stamp."""
        self._first_received += stamp - self.start_ns
        self.start_ns, self.recorded = stamp, recorded_at(stamp)

    def frames(self, start: float = 0.0, end: float = math.inf) -> Iterator[BagImage]:
        """The images from second `start` up to before second `end`. Raises InputError where the clock is no clock."""
        self._lens_changes = []
        with open_bag(self.path) as bag:
            for time, message in self._timed(self._beside_lenses(bag, start, end), start, end):
                image = BagImage(time, message, self, bag)
                if self._decodes(image):
                    yield image
            self._cut = bag.cut

    def times(self, start: float = 0.0, end: float = math.inf) -> list[float]:
        """Times of the images from second `start` up to before second `end`, of damaged ones too: none is decoded.

        Raises InputError where the clock is no clock.
        """
        with open_bag(self.path) as bag:
            messages = bag.messages(self.topic.name, since=self._since(start))
            return [time for time, _ in self._timed(messages, start, end)]

    def warnings(self) -> list[str]:
        """Faults that were met so far, in plain words."""
        name, found = self.path.name, list(self._notes)
        if self.damaged:
            found.append(f"{self.damaged} images of {self.topic.name} in {name} are damaged and were left out.")
        if self._info is not None and self._lens_changes:
            found.append(change_warning(self._info.name, self._lens_changes))
        if self._cut is not None:
            found.append(f"{name} cannot be read to its end ({self._cut}): what was read until there is used.")
        return found

    def decoded(self, content: Any, message: Message) -> Rgb:
        """The pixels of a message. Raises ValueError or InputError where they are damaged."""
        place = Path(f"{self.path}:{message.topic}")
        return image_of(content) if message.type == IMAGE else compressed_image_of(content, place)

    def _since(self, start: float) -> int | None:
        """The time of recording from which messages of second `start` may be expected; None for the whole bag."""
        skipped = start - _LEAP  # recorders write a message within that time of its header
        return self._first_received + int(skipped * 1e9) if skipped > 0 else None

    def _timed(self, messages: Iterable[Message], start: float, end: float) -> Iterator[tuple[float, Message]]:
        """The images from second `start` up to before second `end`, with their times."""
        before: Message | None = None
        for number, message in enumerate(messages, 1):
            place = f"image {number}" if start <= _LEAP else f"image {number} from {start - _LEAP:.0f} s on"
            self._check_clock(message, before, place)
            if before is not None and self._stamp(message) == self._stamp(before):
                continue  # the same image twice
            before = message
            time = self._time(message)
            if time >= end:
                return
            if time >= start - 1e-6:
                yield time, message

    def _decodes(self, image: BagImage) -> bool:
        """Return whether an image decodes in the size of the clip; damaged ones are counted."""
        try:
            shape = image.rgb().shape
        except (ValueError, InputError):
            self.damaged += 1
            return False
        if shape[:2] == (self.height, self.width):
            return True
        raise InputError(
            f"the images of {self.topic.name} in {self.path} change their size from {self.width}x{self.height} to"
            f" {shape[1]}x{shape[0]} after {image.time:.1f} s",
            cause="the mode of the camera was changed while it was recorded, or two cameras publish under one name",
            hint=f"--end {image.time:.1f}, or --start {image.time:.1f} for the images after",
        )

    def _first_decoded(self, bag: Bag) -> tuple[str, Rgb]:
        """The first image that decodes, with the name of its axes."""
        why: object = "the bag is cut off before it"
        for message in bag.messages(self.topic.name):
            try:
                content = bag.content(message)
                return str(content.header.frame_id), self.decoded(content, message)
            except (ValueError, InputError) as error:
                why = error.what if isinstance(error, InputError) else error
        raise InputError(
            f"no image of {self.topic.name} in {self.path} can be decoded: {why}",
            cause="the encoding is not one of sensor_msgs, or the bag is damaged",
            hint=f"swimm3r topics {self.path} lists the encodings; another --topic",
        )

    def _beside_lenses(self, bag: Bag, start: float, end: float) -> Iterator[Message]:
        """The messages of the images; of the lenses recorded between them, the changes from `lens` on are kept."""
        names = [self.topic.name] if self.lens is None or self._info is None else [self.topic.name, self._info.name]
        current, same = lens_numbers(self.lens) if self.lens is not None else "", b""
        end = min(end, (self.seconds or 0.0) + 1e-6)  # a lens that no image follows is that of none
        for message in bag.messages(*names, since=self._since(start)):
            if message.topic == self.topic.name:
                yield message
                continue
            body = message.data[_STAMPED:]
            if body == same or not start - 1e-6 <= (time := self._time(message)) < end:
                continue
            same = body
            try:
                found = lens_numbers(self._calibrated(bag, message))
            except (ValueError, Swimm3rError):  # a driver that starts or shuts down
                continue
            if found != current:
                self._lens_changes.append(LensChange(time, current, found))
                current = found

    def _lens(self, bag: Bag, start: float) -> str | None:
        """The camera_info that holds at a second, or the first after it; without a calibration None, and a note."""
        if self._info is None:
            space = self.topic.name
            self._notes.append(
                f"There is no camera_info beside {space}: the lens is estimated unless --calibration tells it."
            )
            return None
        why: object = "it holds no message that can be read"
        for since in dict.fromkeys((self._since(start), None)):  # one that is sent once lies long before the start
            held, same, tried = None, b"", 0
            for message in bag.messages(self._info.name, since=since):
                later, body = self._time(message) > start + 1e-6, message.data[_STAMPED:]
                tried += later
                if tried > _TRIED or (later and held is not None):
                    break
                if body != same:
                    try:
                        held = self._calibrated(bag, message)
                    except (ValueError, Swimm3rError) as error:
                        why = first_line(error)
                same = body
            if held is not None:
                return held
        self._notes.append(f"The lens in {self._info.name} is not used: {why}.")
        return None

    def _calibrated(self, bag: Bag, message: Message) -> str:
        """The text of a lens of these images. Raises ValueError and Swimm3rError where it is none."""
        text = lens_text(bag.content(message), message.topic, rectified="rect" in self.topic.name.rpartition("/")[2])
        lens_at(read_document(from_yaml(text))[0], self.width, self.height)
        return text

    def _time(self, message: Message) -> float:
        """Seconds of the clip; of a message without a stamp, those at which it was recorded."""
        if self._stamp(message) == 0:
            return (message.received - self._first_received) * 1e-9
        return (self._stamp(message) - self.start_ns) * 1e-9

    def _stamp(self, message: Message) -> int:
        return message.stamp if self.stamps == "header" else message.received

    def _check_clock(self, message: Message, before: Message | None, place: str) -> None:
        """Raise InputError for a stamp that is zero, earlier than the one before, or far ahead of the recording."""
        fault = None
        if self._stamp(message) == 0:
            fault = f"{place} has a stamp of zero"
        elif before is not None:
            step = (self._stamp(message) - self._stamp(before)) * 1e-9
            if step < 0:
                fault = f"the clock runs back by {-step:.3g} s at {place}"
            elif step - (message.received - before.received) * 1e-9 > _LEAP:
                fault = f"the clock leaps ahead by {step:.3g} s at {place}"
        if fault is not None:
            raise InputError(
                f"the headers of {self.topic.name} in {self.path} are no times: {fault}",
                cause="the driver does not stamp its images, or its clock was set while they were recorded",
                hint="--stamps received, which takes the times at which they were recorded",
            )


def recorded_at(stamp: int) -> str | None:
    """The date of a stamp, ISO 8601; None of a clock that was not set."""
    if stamp <= _FIRST_YEAR * 10**9:
        return None
    return datetime.fromtimestamp(stamp // 1000 * 1e-6, UTC).strftime("%Y-%m-%dT%H:%M:%S.%f")
