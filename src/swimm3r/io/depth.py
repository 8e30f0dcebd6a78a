"""Depth maps on disk -> metres: float TIFF, 16-bit PNG or TIFF, and .npz; 0 where nothing is known.

Whole numbers are millimetres unless the caller knows better. 8 bits are refused: such files hold gray images of
depth, without a unit.
"""

import zipfile
import zlib
from pathlib import Path

import numpy as np
import tifffile
from jaxtyping import Float32

from swimm3r.errors import InputError
from swimm3r.io.files.array_file import read_npy, read_npz
from swimm3r.io.files.atomic import atomic_path

SUFFIXES = (".tif", ".tiff", ".png", ".npz", ".npy")


def read_depth(path: Path, per_metre: float = 1000.0) -> Float32[np.ndarray, "h w"]:
    """The depth map of a file; NaN, infinite and negative values become 0. `per_metre` scales whole numbers only.

    Of an .npz the array z_depth is read. Raises InputError on a file that is damaged, has no depth or is of 8 bits.
    """
    stored = _decode(path)
    if stored.ndim == 3 and (stored.shape[2] == 1 or bool((stored == stored[..., :1]).all())):
        stored = stored[..., 0]
    if stored.ndim != 2:
        raise _unreadable(path, f"its array is {stored.shape}, not one value per pixel")
    if stored.dtype.kind in "iu":
        if stored.dtype.itemsize == 1:
            raise _unreadable(path, "it has 8 bits: an image of depth, not depth")
        return (stored.astype(np.float64) / per_metre).clip(min=0).astype(np.float32)
    if stored.dtype.kind != "f":
        raise _unreadable(path, f"its values are {stored.dtype}")
    depth = stored.astype(np.float32)
    return np.where(np.isfinite(depth) & (depth > 0), depth, np.float32(0))


def write_depth(path: Path, depth: Float32[np.ndarray, "h w"]) -> None:
    """Write depth as a TIFF of 32-bit floats, whole or not at all; 0 where nothing is known."""
    with atomic_path(path) as draft:
        tifffile.imwrite(draft, depth, compression="zlib")


def _decode(path: Path) -> np.ndarray:
    try:
        if path.suffix.lower() == ".npz":
            return read_npz(path, "z_depth")["z_depth"]
        if path.suffix.lower() == ".npy":
            return read_npy(path)
        data = path.read_bytes()
    except (OSError, ValueError, EOFError, zipfile.BadZipFile, zlib.error) as error:
        raise _unreadable(path, error) from error
    import cv2

    stored = cv2.imdecode(np.frombuffer(data, np.uint8), cv2.IMREAD_UNCHANGED) if data else None
    if stored is None:
        raise _unreadable(path, "its contents do not decode")
    return stored


def _unreadable(path: Path, why: object) -> InputError:
    return InputError(
        f"{path} cannot be read as a depth map: {why}",
        cause="the file is missing, damaged, or holds something else",
        hint="depth is a float TIFF in metres, a 16-bit PNG or TIFF in millimetres, or an .npz with the array z_depth",
    )
