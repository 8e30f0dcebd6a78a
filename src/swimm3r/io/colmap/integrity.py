"""Integrity of the binary files of a COLMAP model, checked before a reader relies on the counts in their headers.

    every file: uint64 count, then that many records; little-endian, without padding
    camera: id, model, width, height, parameters      image: id, quaternion, translation, camera, name\\0, points2D
    point: id, xyz, rgb, error, track                 rig: id, sensors with their poses
    frame: id, rig, pose, data ids

pycolmap takes whatever a truncated file leaves of a count for that count: it hangs, or fills memory, or reads on as if
nothing were missing.
"""

import struct
from collections.abc import Callable
from pathlib import Path

# parameters of each camera model, in the order of COLMAP's numbers
_PARAMETERS = (3, 4, 4, 5, 8, 8, 12, 5, 4, 5, 12, 16, 4, 5, 3, 4, 6, 2)


class _Bytes:
    """Reads forward, and never past the end."""

    def __init__(self, data: bytes) -> None:
        self.data = data
        self.at = 0

    def take(self, layout: str) -> tuple:
        size = struct.calcsize("<" + layout)
        self.skip(size)
        return struct.unpack_from("<" + layout, self.data, self.at - size)

    def skip(self, size: int) -> None:
        if self.at + size > len(self.data):
            raise EOFError
        self.at += size

    def skip_name(self) -> None:
        end = self.data.find(b"\0", self.at)
        if end < 0:
            raise EOFError
        self.at = end + 1


def damaged_file(folder: Path) -> str | None:
    """The name of a binary file in `folder` that ends too early or too late; None where all that are there are whole.

    Text models are not looked at: a line that is cut off is noticed by any reader.
    """
    records: dict[str, Callable[[_Bytes], None]] = {
        "cameras": _camera, "images": _image, "points3D": _point, "rigs": _rig, "frames": _frame,
    }  # fmt: skip
    for name, skip in records.items():
        path = folder / f"{name}.bin"
        if path.is_file() and not _is_whole(path.read_bytes(), skip):
            return path.name
    return None


def _is_whole(data: bytes, skip: Callable[[_Bytes], None]) -> bool:
    rest = _Bytes(data)
    try:
        for _ in range(rest.take("Q")[0]):
            skip(rest)
    except EOFError:
        return False
    return rest.at == len(data)


def _camera(rest: _Bytes) -> None:
    _, model, _, _ = rest.take("IiQQ")
    if not 0 <= model < len(_PARAMETERS):
        raise EOFError
    rest.skip(8 * _PARAMETERS[model])


def _image(rest: _Bytes) -> None:
    rest.skip(4 + 7 * 8 + 4)
    rest.skip_name()
    rest.skip(24 * rest.take("Q")[0])


def _point(rest: _Bytes) -> None:
    rest.skip(8 + 3 * 8 + 3 + 8)
    rest.skip(8 * rest.take("Q")[0])


def _rig(rest: _Bytes) -> None:
    _, sensors = rest.take("II")
    if sensors:
        rest.skip(8)  # the reference sensor has no pose
    for _ in range(sensors - 1):
        *_, posed = rest.take("iIB")
        rest.skip(7 * 8 * posed)


def _frame(rest: _Bytes) -> None:
    rest.skip(4 + 4 + 7 * 8)
    rest.skip(16 * rest.take("I")[0])
