"""Vertices as PLY (Turk 1994), binary little-endian; of clouds float x y z, uchar red green blue."""

from collections.abc import Sequence
from pathlib import Path

import numpy as np
from jaxtyping import Float, Float32

from swimm3r.io.files.atomic import atomic_path
from swimm3r.io.files.damage import Remedy, guard

_REMEDY = Remedy(
    "save it as binary PLY with colors, in CloudCompare or MeshLab for example",
    cause="the file is cut off, or a PLY of another kind (text, big-endian, without colors)",
    fault="cannot be read as a colored point cloud",
)
_RECORD = np.dtype([(axis, "<f4") for axis in "xyz"] + [(color, "u1") for color in ("red", "green", "blue")])
_TYPES = {
    **dict.fromkeys(("char", "int8"), "i1"),
    **dict.fromkeys(("uchar", "uint8"), "u1"),
    **dict.fromkeys(("short", "int16"), "<i2"),
    **dict.fromkeys(("ushort", "uint16"), "<u2"),
    **dict.fromkeys(("int", "int32"), "<i4"),
    **dict.fromkeys(("uint", "uint32"), "<u4"),
    **dict.fromkeys(("float", "float32"), "<f4"),
    **dict.fromkeys(("double", "float64"), "<f8"),
}


def write_points(path: Path, xyz: Float[np.ndarray, "n 3"], rgb: Float[np.ndarray, "n 3"]) -> None:
    """Write a cloud, whole or not at all; colors 0..1 are clipped and rounded to 8 bits."""
    points = np.empty(len(xyz), _RECORD)
    for axis, name in enumerate("xyz"):
        points[name] = xyz[:, axis]
    for channel, name in enumerate(("red", "green", "blue")):
        points[name] = np.clip(rgb[:, channel], 0, 1) * 255 + 0.5
    write_vertices(path, points)


def write_vertices(path: Path, vertices: np.ndarray, comments: Sequence[str] = ()) -> None:
    """Write a structured array of float32 and uint8 fields, one property each, whole or not at all."""
    kinds = {np.dtype("<f4"): "float", np.dtype("u1"): "uchar"}
    fields = [(name, vertices.dtype[name]) for name in vertices.dtype.names or ()]
    properties = "".join(f"property {kinds[kind]} {name}\n" for name, kind in fields)
    told = "".join(f"comment {line}\n" for line in comments)
    header = f"ply\nformat binary_little_endian 1.0\n{told}element vertex {len(vertices)}\n{properties}end_header\n"
    with atomic_path(path) as draft, draft.open("wb") as file:
        file.write(header.encode("ascii"))
        file.write(vertices.tobytes())


def is_ply(path: Path) -> bool:
    """Return whether a file begins as PLY files do."""
    with path.open("rb") as file:
        return file.read(4) in (b"ply\n", b"ply\r")


def read_points(path: Path, remedy: Remedy = _REMEDY) -> tuple[Float32[np.ndarray, "n 3"], Float32[np.ndarray, "n 3"]]:
    """Positions and colors 0..1 of a cloud. Raises InputError.

    Other tools' clouds are read too where they are binary little-endian, begin with the vertices, and give them
    scalar properties; those that are neither position nor color are left out.
    """
    with guard(path, remedy):
        data = path.read_bytes()
        head, found, body = data.partition(b"end_header\n")
        lines = head.decode("ascii").splitlines()
        if not found or lines[:2] != ["ply", "format binary_little_endian 1.0"]:
            raise ValueError("a binary little-endian header was expected")
        count, record = _vertices(lines[2:])
        if not 0 <= count * record.itemsize <= len(body):
            raise ValueError(f"{count} vertices are promised, and {len(body)} bytes follow")
        points = np.frombuffer(body, record, count)
        missing = {"x", "y", "z", "red", "green", "blue"} - set(record.names or ())
        if missing:
            raise ValueError(f"its vertices have no {', '.join(sorted(missing))}")
        with np.errstate(over="ignore"):  # double precision beyond single is infinite, and refused
            xyz = np.stack([points[name] for name in "xyz"], -1).astype(np.float32)
        rgb = np.stack([points[name] for name in ("red", "green", "blue")], -1)
        rgb = rgb.astype(np.float32) / (1 if rgb.dtype.kind == "f" else np.iinfo(rgb.dtype).max)
        if not (np.isfinite(xyz).all() and np.isfinite(rgb).all()):
            raise ValueError("it has positions or colors that are not finite numbers")
        return xyz, rgb


def _vertices(lines: list[str]) -> tuple[int, np.dtype]:
    """The number of vertices, and the layout of one in the file."""
    words = [line.split() for line in lines if not line.startswith(("comment", "obj_info"))]
    if not words or words[0][:2] != ["element", "vertex"] or len(words[0]) != 3:
        raise ValueError("the vertices were expected first")
    fields = []
    for word in words[1:]:
        if not word or word[0] != "property":
            break  # the next element: faces
        if len(word) != 3 or word[1] not in _TYPES:
            raise ValueError(f"a property of its vertices is {' '.join(word[1:])}")
        fields.append((word[2], _TYPES[word[1]]))
    return int(words[0][2]), np.dtype(fields)
