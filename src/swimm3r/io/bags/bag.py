"""A ROS bag that is open for reading: version 1 (.bag), version 2 (a folder with metadata.yaml, a .db3 or an .mcap).

rosbags (Apache-2.0) reads and writes them without ROS. All messages used here but those of tf begin with a
std_msgs/Header, whose stamp lies four bytes into the message in both versions, so that images that are not taken are
never decoded.
"""

import struct
import zlib
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from importlib import import_module
from pathlib import Path
from types import ModuleType
from typing import Any

from swimm3r.errors import DeviceError, InputError
from swimm3r.io.files.damage import first_line

BAG_SUFFIXES = (".bag", ".mcap", ".db3")
TRANSFORMS = "tf2_msgs/msg/TFMessage"
_STORAGES = (".mcap", ".db3")  # the files of a bag of version 2
_MARK = b"rosbag2_bagfile_information"  # in its metadata.yaml
_BEGIN = 4096  # bytes that hold the mark
_BACK = (1, 10, 100)  # seconds before the end in which the last message of a topic is looked for

# of damaged files: rosbags lets through what its decoders and its own assertions raise
_FAULTS = (zlib.error, struct.error, OSError, EOFError, ValueError, TypeError, LookupError)
_FAULTS += (AssertionError, RuntimeError, MemoryError)


@dataclass(frozen=True)
class Message:
    """A message as recorded; `Bag.content` decodes it."""

    topic: str
    type: str  # "sensor_msgs/msg/Image", for version 1 too
    stamp: int  # of its header, nanoseconds; of a message without one as `received`
    received: int  # by the recorder, nanoseconds since 1970
    data: bytes


def is_bag(path: Path) -> bool:
    """Return whether a path is that of a bag: by the suffix of a file, or the files in a folder."""
    if path.is_file():
        return path.suffix.lower() in BAG_SUFFIXES
    if not path.is_dir():
        return False
    return _has_metadata(path) or (bool(files := _storage_files(path)) and files == sorted(path.iterdir()))


@contextmanager
def open_bag(path: Path) -> Iterator["Bag"]:
    """A bag, closed at the end. Raises InputError where it cannot be read, DeviceError without rosbags."""
    place = _place_of(path)
    highlevel, typesys = ros_package("highlevel"), ros_package("typesys")
    of_readers = import_module("rosbags.highlevel.anyreader").ReaderErrors
    faults = (*_FAULTS, highlevel.AnyReaderError, *of_readers, import_module("apsw").Error)  # apsw reads .db3
    try:
        store = typesys.get_typestore(typesys.Stores.LATEST)  # for bags older than definitions within them
        reader = highlevel.AnyReader([place], default_typestore=store)
        reader.open()
    except faults as error:
        raise unreadable(path, first_line(error)) from error
    try:
        yield Bag(path, reader, faults)
    finally:
        reader.close()


class Bag:
    """The messages of an open bag."""

    def __init__(self, path: Path, reader: Any, faults: tuple[type[Exception], ...]) -> None:
        """`faults` are the errors that damaged bags cause."""
        self.path = path
        self.cut: str | None = None  # the fault at which reading ended before the end
        self._reader, self._faults = reader, faults

    @property
    def types(self) -> dict[str, str]:
        """The type of every topic, by its name."""
        return {each.topic: each.msgtype for each in self._reader.connections}

    def count(self, topic: str) -> int:
        """Number of messages of a topic, as the bag states it."""
        return sum(each.msgcount for each in self._reader.connections if each.topic == topic)

    def messages(self, *topics: str, since: int | None = None) -> Iterator[Message]:
        """Messages of topics in the order they were recorded, from nanosecond `since` on.

        Where the bag is cut off they end, and `cut` says why.
        """
        chosen = [each for each in self._reader.connections if each.topic in topics]
        if not chosen:
            return
        found = self._reader.messages(chosen, start=since)
        while True:
            try:
                one = next(found, None)
                if one is None:
                    return
                connection, received, data = one
                stamp = received if connection.msgtype == TRANSFORMS else self._stamp(data)
            except self._faults as error:
                self.cut = first_line(error)
                return
            yield Message(connection.topic, connection.msgtype, stamp, received, bytes(data))

    def first(self, topic: str) -> Message | None:
        """The message of a topic that was recorded first; None without one that can be read."""
        return next(self.messages(topic), None)

    def last(self, topic: str) -> Message | None:
        """The message of a topic that was recorded last."""
        end = int(self._reader.end_time)
        for seconds in _BACK:
            *_, found = [None, *self.messages(topic, since=end - seconds * 10**9)]
            if found is not None:
                return found
        *_, found = [None, *self.messages(topic)]
        return found

    def content(self, message: Message) -> Any:
        """The fields of a message. Raises ValueError where it is damaged."""
        try:
            return self._reader.deserialize(message.data, message.type)
        except self._faults as error:
            raise ValueError(first_line(error)) from error

    def _stamp(self, data: bytes) -> int:
        order = "<" if not self._reader.is2 or data[1] & 1 else ">"  # of CDR, its second byte tells
        seconds, nanoseconds = struct.unpack_from(f"{order}II", data, 4)
        return seconds * 10**9 + nanoseconds


def ros_package(name: str) -> ModuleType:
    """A module of rosbags. Raises DeviceError that says how to install it."""
    try:
        return import_module(f"rosbags.{name}")
    except ImportError as error:
        raise DeviceError(
            "ROS bags need rosbags, which is not installed",
            cause="the package that reads and writes them comes with the extra ros",
            hint="pip install 'swimm3r[ros]'",
        ) from error


def _place_of(path: Path) -> Path:
    """The path that rosbags opens: of a folder without metadata.yaml, its only file."""
    if not path.is_dir() or _has_metadata(path):
        return path
    files = _storage_files(path)
    if len(files) == 1:
        return files[0]
    raise InputError(
        f"{path} has no metadata.yaml, and {len(files)} files that may be a bag",
        cause="the recorder was killed before it wrote metadata.yaml, or the file was not copied",
        hint=f"ros2 bag reindex {path}; or give one of its files by its own path",
    )


def _has_metadata(folder: Path) -> bool:
    path = folder / "metadata.yaml"
    if not path.is_file():
        return False
    with path.open("rb") as file:
        return _MARK in file.read(_BEGIN)


def _storage_files(folder: Path) -> list[Path]:
    return sorted(path for path in folder.iterdir() if path.suffix.lower() in _STORAGES and path.is_file())


def unreadable(path: Path, why: str) -> InputError:
    """The error of a bag that cannot be read."""
    remedies = {
        ".bag": f"rosbag reindex {path}, which restores the index of a recording that was not closed",
        ".mcap": f"mcap recover {path} -o WHOLE.mcap, which keeps what was recorded",
    }
    return InputError(
        f"{path} cannot be read as a ROS bag: {why}",
        cause="it is cut off (the recorder was killed, the disk was full, an unfinished copy), or of another kind",
        hint=remedies.get(path.suffix.lower(), f"ros2 bag reindex {path}") + "; or copy it again",
    )
