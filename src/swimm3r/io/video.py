"""Video files -> frames, one at a time: true timestamps, upright, square pixels.

A video is decoded once from front to back, and nothing is kept, so its length does not matter. Packets that do not
decode are passed over and counted.
"""

import math
from collections.abc import Iterator
from dataclasses import dataclass
from datetime import datetime
from fractions import Fraction
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from jaxtyping import UInt8

from swimm3r.errors import InputError
from swimm3r.io.files.regular_file import require_regular_file

if TYPE_CHECKING:
    import av
    from av.container import InputContainer

VIDEO_SUFFIXES = (".mp4", ".mov", ".m4v", ".mkv", ".webm", ".avi", ".mts", ".m2ts", ".mpg", ".mpeg", ".wmv", ".3gp")
"""Suffixes of videos that are searched for in a folder without images; FFmpeg reads more."""

_NOT_VIDEO = ("tty", "image2", "_pipe")  # FFmpeg's readers of text and of single images
_INDEXED = ("mov,mp4,m4a,3gp,3g2,mj2", "matroska,webm")  # the containers whose seeking can be relied on
_FARTHEST = 2**62  # ticks; FFmpeg counts them in 64 bits
_UNSPECIFIED = 2  # AVCOL_SPC_UNSPECIFIED
_FIRST_YEAR = 1990  # QuickTime counts from 1904 and Unix from 1970: what a clock that was never set shows
_HD_LINES = 720  # from here on untagged video is BT.709, as players take it; below BT.601


@dataclass(frozen=True)
class VideoFrame:
    """A decoded frame; its image is only made when asked for."""

    time: float  # seconds since the start of the clip
    _decoded: Any  # av.VideoFrame
    _video: "Video"

    def gray(self, long_side: int) -> UInt8[np.ndarray, "h w"]:
        """A small gray copy, as the sensor lay (not turned upright)."""
        scale = min(1.0, long_side / max(self._decoded.width, self._decoded.height))
        width, height = (max(2, round(side * scale)) for side in (self._decoded.width, self._decoded.height))
        return self._video._scale(self._decoded, "gray", width, height)

    def rgb(self) -> UInt8[np.ndarray, "h w 3"]:
        """The image at full size, upright, [video.height, video.width]."""
        width, height = self._video._sensor_size
        lying = self._video._scale(self._decoded, "rgb24", width, height)
        return np.ascontiguousarray(np.rot90(lying, self._video._quarter_turns))


class Video:
    """A video file that was looked into; each call of `frames` reads it anew."""

    path: Path
    width: int  # of the upright image with square pixels
    height: int
    seconds: float | None  # length as the file states it
    rate: float  # frames per second on average
    recorded: str | None  # begin of the recording by the container, ISO 8601; None where it does not tell
    damaged: int  # packets that did not decode so far
    interlaced: bool  # true once an interlaced frame was seen

    def __init__(self, path: Path) -> None:
        """Raises InputError where the file is missing or nothing in it decodes."""
        from av.error import FFmpegError
        from av.video.reformatter import VideoReformatter

        require_regular_file(path, "a video")
        self.path, self.damaged, self.interlaced = path, 0, False
        self._reformatters = {"gray": VideoReformatter(), "rgb24": VideoReformatter()}  # each keeps its scaler
        try:
            with self._open() as file:
                self._look_into(file)
        except FFmpegError as error:
            raise _unreadable(path, error.strerror) from error
        first = next(self.frames(), None)  # only a frame tells its rotation, and that there is one
        if first is None:
            raise _unreadable(path, "not one frame of it decodes")
        self.damaged = 0
        decoded = first._decoded
        self._sensor_size = (max(1, round(decoded.width * self._aspect)), decoded.height)
        self._quarter_turns = round(decoded.rotation / 90) % 4  # counter-clockwise, as numpy turns
        self.width, self.height = self._sensor_size[:: -1 if self._quarter_turns % 2 else 1]

    @property
    def quarter_turns(self) -> int:
        """Quarter turns counter-clockwise that bring the stored images upright."""
        return self._quarter_turns

    @property
    def begin(self) -> float:
        """Time of the first frame in the container, seconds; times of frames count from it."""
        return float(self._origin * self._tick)

    def frames(self, start: float = 0.0, end: float = math.inf) -> Iterator[VideoFrame]:
        """The frames from second `start` up to before second `end`, in time order."""
        for index, frame in enumerate(self._decode(start)):
            # raw streams carry no clock
            seconds = float((frame.pts - self._origin) * self._tick) if frame.pts is not None else index / self.rate
            if seconds >= end:
                return
            self.interlaced |= frame.interlaced_frame
            if seconds >= start - 1e-6:
                yield VideoFrame(seconds, frame, self)

    def warnings(self) -> list[str]:
        """Faults that were met so far, in plain words."""
        name, found = self.path.name, []
        if self.damaged:
            found.append(
                f"{self.damaged} damaged packets of {name} were passed over; frames are missing or smeared there. "
                "Copy the video again if the original is whole."
            )
        if self.interlaced:
            found.append(
                f"{name} is interlaced, which tears moving images into combs. "
                "Deinterlace it first: ffmpeg -i IN -vf bwdif OUT.mp4"
            )
        return found

    def _open(self) -> "InputContainer":
        import av

        return av.open(f"file:{self.path}")  # the prefix keeps names with a colon from being taken for a protocol

    def _look_into(self, file: "InputContainer") -> None:
        if file.format.name.endswith(_NOT_VIDEO):
            raise _unreadable(self.path, "it is a text or a single image")
        streams = [s for s in file.streams.video if not s.disposition & s.disposition.attached_pic]
        if not streams:
            raise _unreadable(self.path, "it holds no moving images")
        stream = streams[0]
        if stream.codec_context is None:
            raise _unreadable(self.path, "its codec is unknown")
        self._stream = stream.index
        self._origin, self._tick = stream.start_time or 0, stream.time_base or Fraction(1)
        self._aspect = float(stream.sample_aspect_ratio or 1)
        stated = file.metadata.get("creation_time") or stream.metadata.get("creation_time")
        self.recorded = _plausible_date(stated)
        self.rate = float(stream.average_rate or stream.guessed_rate or 25)
        if stream.duration is not None:
            self.seconds = float(stream.duration * self._tick)
        else:
            self.seconds = None if file.duration is None else file.duration / 1e6

    def _decode(self, start: float) -> "Iterator[av.VideoFrame]":
        """The frames that decode, from a key frame before second `start` on."""
        from av.error import FFmpegError

        with self._open() as file:
            stream: Any = file.streams[self._stream]
            stream.thread_type = "AUTO"
            if start > 0 and file.format.name in _INDEXED:
                file.seek(self._origin + int(min(start / self._tick, _FARTHEST)), stream=stream)
            packets = file.demux(stream)
            while True:
                try:
                    packet: Any = next(packets, None)
                    if packet is None:
                        return
                except FFmpegError:  # the container is broken from here on
                    self.damaged += 1
                    return
                try:
                    decoded = packet.decode()
                except EOFError:
                    return
                except FFmpegError:
                    self.damaged += 1
                    continue
                for frame in decoded:
                    if frame.is_corrupt:
                        self.damaged += 1
                    else:
                        yield frame

    def _scale(self, frame: Any, pixels: str, width: int, height: int) -> np.ndarray:
        from av.video.reformatter import Interpolation

        matrix = int(frame.colorspace)
        if matrix == _UNSPECIFIED and min(frame.width, frame.height) >= _HD_LINES:
            matrix = 1  # BT.709
        scaled = self._reformatters[pixels].reformat(
            frame, width, height, pixels, src_colorspace=matrix, interpolation=Interpolation.AREA
        )
        return scaled.to_ndarray()


def _plausible_date(stated: str | None) -> str | None:
    """A container's date of recording; None where it is absent, or of a clock that was never set."""
    try:
        date = datetime.fromisoformat(stated or "")
    except ValueError:
        return None
    return date.strftime("%Y-%m-%dT%H:%M:%S") if date.year >= _FIRST_YEAR else None


def _unreadable(path: Path, why: object) -> InputError:
    return InputError(
        f"{path} cannot be read as a video: {why}",
        cause="the file is missing, cut off (a recording that was not closed, an unfinished copy) or of another kind",
        hint="play it in a video player; copy it again, or repair it (ffmpeg -i BROKEN -c copy WHOLE.mp4)",
    )
