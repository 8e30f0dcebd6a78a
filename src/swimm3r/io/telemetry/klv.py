"""The elements of a GPMF payload: key, type, sample size, repeat, values; nested, and aligned to 4 bytes.

Numbers are big-endian. An element of type 0 holds elements; one of type "?" has samples of several numbers, whose types
a TYPE element before it lists ("lllllllSS", or "f[4]L" for four of a kind).
"""

import re
import struct
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

_HEADER = struct.Struct(">4scBH")
_DTYPES = {
    "b": "i1",
    "B": "u1",
    "s": ">i2",
    "S": ">u2",
    "l": ">i4",
    "L": ">u4",
    "q": ">i4",
    "f": ">f4",
    "d": ">f8",
    "j": ">i8",
    "J": ">u8",
    "Q": ">i8",
}
_FIXED_POINT = {"q": 2.0**16, "Q": 2.0**32}  # Q15.16 and Q31.32
_DEEPEST = 8  # devices, streams and their samples take three
_COUNTED = re.compile(r"(.)(?:\[(\d+)\])?")


@dataclass(frozen=True)
class Element:
    """One element; `children` is empty but for the nesting type."""

    key: str
    type: str  # "" for nested elements
    size: int  # bytes of a sample
    count: int  # samples
    data: bytes
    children: tuple["Element", ...] = ()


def parse(payload: bytes, depth: int = 0) -> tuple[Element, ...]:
    """The elements of a payload in their order. Raises ValueError where it is cut off or no GPMF."""
    if depth > _DEEPEST:
        raise ValueError(f"elements are nested more than {_DEEPEST} deep")
    elements = []
    at = 0
    while at < len(payload):
        if len(payload) - at < _HEADER.size:
            raise ValueError(f"it ends within the header of an element at byte {at}")
        name, kind, size, count = _HEADER.unpack_from(payload, at)
        if name == b"\0\0\0\0":  # the free space at the end
            break
        if not all(0x20 <= letter < 0x7F for letter in name):
            raise ValueError(f"byte {at} begins no element")
        at += _HEADER.size
        end = at + size * count
        if end > len(payload):
            raise ValueError(f"{name.decode()} needs {size * count} bytes, and {len(payload) - at} are left")
        data = payload[at:end]
        is_nest = kind == b"\0"
        children = parse(data, depth + 1) if is_nest else ()
        elements.append(Element(name.decode(), "" if is_nest else kind.decode("latin-1"), size, count, data, children))
        at = -(-end // 4) * 4
    return tuple(elements)


def numbers(element: Element, complex_type: str = "") -> Float[np.ndarray, "n k"] | None:
    """The samples of an element, a row each; None where they are not all numbers. Raises ValueError for bad sizes."""
    kinds = _letters(complex_type) if element.type == "?" else element.type
    if not kinds or any(kind not in _DTYPES for kind in kinds):
        return None
    if element.type != "?":
        width = np.dtype(_DTYPES[kinds]).itemsize
        if element.size % width and element.count:
            raise ValueError(f"samples of {element.key} have {element.size} bytes, and its numbers {width}")
        kinds = kinds * (element.size // width)
    fields = np.dtype([(str(k), _DTYPES[kind]) for k, kind in enumerate(kinds)])
    if fields.itemsize != element.size:
        raise ValueError(f"samples of {element.key} have {element.size} bytes, and its types {fields.itemsize}")
    rows = np.frombuffer(element.data, fields, element.count)
    columns = [rows[str(k)].astype(np.float64) / _FIXED_POINT.get(kind, 1.0) for k, kind in enumerate(kinds)]
    return np.stack(columns, -1) if columns else np.zeros((element.count, 0))


def text(element: Element) -> str:
    """The characters of an element."""
    return element.data.decode("latin-1").rstrip("\0 ")


def texts(element: Element) -> tuple[str, ...]:
    """The words of an element that has one for each sample, as units of channels."""
    size = max(element.size, 1)
    words = (element.data[k : k + size] for k in range(0, len(element.data), size))
    return tuple(word.decode("latin-1").rstrip("\0 ") for word in words)


def _letters(types: str) -> str:
    return "".join(kind * int(count or 1) for kind, count in _COUNTED.findall(types))
