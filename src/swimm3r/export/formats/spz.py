"""Niantic's SPZ, version 3 (gzip): positions of 24 bits, everything else of 8 and rotations of 32.

Written by gsply. The format's axes are x right, y up, z back: Gaussians are turned by half a turn about x. Positions
have as many bits behind the point as the scene's extent leaves.
"""

import gzip
import math
import zlib
from pathlib import Path

import numpy as np

from swimm3r.devices import torch_threads
from swimm3r.export.result import Exported, check_replaceable
from swimm3r.export.settings import SpzSettings
from swimm3r.export.splats import SplatArrays, along_curve, for_gsply, from_gsply, gsply_or_refuse, open_map
from swimm3r.io.files.atomic import atomic_path

_MAGIC = b"NGSP"
_MOST_BITS = 20  # behind the point; of 23
# of real harmonics from degree 1 on, by the parity in y and z of each: y z x, xy yz zz xz xx-yy, ...
_TURNED = np.array([-1, -1, 1, -1, 1, 1, -1, 1, -1, 1, -1, -1, 1, -1, 1], np.float32)


def export_run(folder: Path, path: Path, settings: SpzSettings) -> Exported:
    """Write a finished run's map, and measure how far the Gaussians of the file are from it in views along the dive."""
    check_replaceable(path, _is_spz, "SPZ file")
    gsply = gsply_or_refuse()
    found = open_map(folder, settings)
    arrays = turned(found.arrays())
    with torch_threads():
        with atomic_path(path) as draft:
            ordered = for_gsply(gsply, arrays[along_curve(arrays.xyz)])
            gsply.write_spz(draft, ordered, fractional_bits=_fraction(arrays.xyz))
        written = turned(from_gsply(gsply.read_spz(path)))
    return found.result(path, written)


def turned(arrays: SplatArrays) -> SplatArrays:
    """The Gaussians in axes with y and z the other way; twice is none."""
    known = arrays.harmonics.shape[1]
    return SplatArrays(
        arrays.xyz * np.array([1, -1, -1], np.float32),
        arrays.log_scale,
        arrays.quaternion * np.array([1, 1, -1, -1], np.float32),
        arrays.logit,
        arrays.color,
        arrays.harmonics * _TURNED[:known, None],
    )


def _fraction(xyz: np.ndarray) -> int:
    """Bits behind the point."""
    extent = float(np.abs(xyz).max(initial=1e-3))
    return max(1, min(_MOST_BITS, 23 - math.ceil(math.log2(extent * 1.001))))


def _is_spz(path: Path) -> bool:
    try:
        with gzip.open(path) as file:
            return file.read(4) == _MAGIC
    except (OSError, EOFError, zlib.error):
        return path.open("rb").read(4) == _MAGIC  # version 4 is not compressed as a whole
