"""NumPy archives read back into arrays of the shapes and kinds they were written with, finite and never pickled."""

import math
import zipfile
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from threading import RLock
from typing import Literal

import numpy as np

from swimm3r.io.files.damage import Remedy, first_line, guard

# NumPy parses the header of an array by `ast`. Its count of nested calls is one for all threads before CPython 3.11.8
# and 3.12.2, and a thread that comes in between has it raise SystemError (python/cpython#106905).
_one_parses = RLock()


@dataclass(frozen=True)
class Layout:
    """The shape of an array, its axes by name or length as in "pairs 2", and the kind of its numbers."""

    axes: str  # an axis of one name has one length in all arrays of a file
    kind: Literal["float", "int"] = "float"
    finite: bool = True


def read_arrays(path: Path, layouts: Mapping[str, Layout], remedy: Remedy) -> dict[str, np.ndarray]:
    """The arrays of an .npz by name, others left out. Raises the remedy's error, which names the file and the fault."""
    with guard(path, remedy), zipfile.ZipFile(path) as archive:
        lengths: dict[str, int] = {}
        return {name: _array(archive, name, layout, lengths) for name, layout in layouts.items()}


def read_npz(path: Path, *names: str) -> dict[str, np.ndarray]:
    """Arrays of an .npz by name, of any shape; all where none is named. Raises what `guard` turns into one error."""
    with zipfile.ZipFile(path) as archive:
        wanted = names or [entry.removesuffix(".npy") for entry in archive.namelist()]
        return {name: _decoded(archive, name) for name in wanted}


def read_npy(path: Path) -> np.ndarray:
    """The array of an .npy. Raises what `guard` turns into one error."""
    with _one_parses:
        return np.load(path, allow_pickle=False)


def write_arrays(path: Path, **arrays: np.ndarray) -> None:
    """An .npz like `savez_compressed` writes it, in a third of its time: measured depth hardly packs any smaller."""
    with zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED, compresslevel=1) as archive:
        for name, array in arrays.items():
            with archive.open(f"{name}.npy", "w", force_zip64=True) as file:
                np.lib.format.write_array(file, np.ascontiguousarray(array), version=(1, 0), allow_pickle=False)


def _array(archive: zipfile.ZipFile, name: str, layout: Layout, lengths: dict[str, int]) -> np.ndarray:
    values = _decoded(archive, name)
    if values.dtype.kind not in {"float": "f", "int": "iu"}[layout.kind]:
        raise ValueError(f"{name} holds {values.dtype}, and {layout.kind} is expected")
    axes = layout.axes.split()
    if values.ndim != len(axes):
        raise ValueError(f"{name} has {values.ndim} axes, and {len(axes)} ({layout.axes}) are expected")
    for axis, length in zip(axes, values.shape, strict=True):
        expected = int(axis) if axis.isdigit() else lengths.setdefault(axis, length)
        if length != expected:
            raise ValueError(f"{name} has the shape {values.shape}, and {expected} is expected for {axis}")
    if layout.finite and layout.kind == "float" and not np.isfinite(values).all():
        raise ValueError(f"{name} has values that are not finite")
    return values


def _decoded(archive: zipfile.ZipFile, name: str) -> np.ndarray:
    """An array of the archive, which must not claim more memory than its bytes can fill."""
    member = f"{name}.npy"
    if member not in archive.namelist():
        raise ValueError(f"it has no array {name}")
    try:
        with archive.open(member) as file:
            if np.lib.format.read_magic(file) != (1, 0):
                raise ValueError(f"{name} is not what savez writes")
            with _one_parses:
                shape, by_column, dtype = np.lib.format.read_array_header_1_0(file)
            if dtype.hasobject:
                raise ValueError(f"{name} holds pickled objects")
            count = math.prod(shape)
            if count * dtype.itemsize > archive.getinfo(member).file_size:
                raise ValueError(f"{name} is cut off")
            values = np.frombuffer(bytearray(file.read()), dtype, count)
        return values.reshape(shape, order="F" if by_column else "C")
    except RuntimeError as error:  # an entry that is encrypted or compressed in a way that zipfile does not know
        raise ValueError(first_line(error)) from error
