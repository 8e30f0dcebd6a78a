"""The .splat of antimatter15's viewer, which other web viewers read, too: records of 32 bytes, large opaque ones first.

float32 x, y, z   float32 scale x, y, z   uint8 red, green, blue, opacity   uint8 128 (1 + w, x, y, z)
"""

from pathlib import Path

import numpy as np

from swimm3r.export.result import Exported, check_replaceable
from swimm3r.export.settings import SplatFileSettings
from swimm3r.export.splats import SplatArrays, open_map
from swimm3r.io.files.atomic import atomic_path
from swimm3r.splat.primitives.spherical_harmonics import Y_00

_RECORD = np.dtype([("xyz", "<f4", 3), ("scale", "<f4", 3), ("rgba", "u1", 4), ("quaternion", "u1", 4)])
_LEAST, _MOST = 0.5 / 255, 254.5 / 255  # opacities that have a logit


def export_run(folder: Path, path: Path, settings: SplatFileSettings) -> Exported:
    """Write a finished run's map, and measure how far the Gaussians of the file are from it in views along the dive."""
    check_replaceable(path, _is_splat, ".splat file")
    found = open_map(folder, settings)
    records = packed(found.arrays())
    with atomic_path(path) as draft:
        draft.write_bytes(records.tobytes())
    return found.result(path, unpacked(records))


def packed(arrays: SplatArrays) -> np.ndarray:
    """The records of a file; colors beyond 0..1 are clipped, and harmonics left out."""
    opacity = 1 / (1 + np.exp(-arrays.logit.astype(np.float64)))
    scale = np.exp(arrays.log_scale)
    order = np.argsort(-scale.prod(-1) * opacity, kind="stable")
    records = np.empty(len(order), _RECORD)
    records["xyz"], records["scale"] = arrays.xyz[order], scale[order]
    rgba = np.concatenate([0.5 + Y_00 * arrays.color, opacity[:, None]], -1)[order]
    records["rgba"] = np.clip(rgba, 0, 1) * 255 + 0.5
    quaternion = arrays.quaternion / np.linalg.norm(arrays.quaternion, axis=-1, keepdims=True)
    records["quaternion"] = np.clip(np.round(quaternion[order] * 128 + 128), 0, 255)
    return records


def unpacked(records: np.ndarray) -> SplatArrays:
    """The Gaussians that records say."""
    opacity = np.clip(records["rgba"][:, 3] / np.float32(255), _LEAST, _MOST)
    return SplatArrays(
        records["xyz"],
        np.log(records["scale"]),
        records["quaternion"].astype(np.float32) / 128 - 1,
        np.log(opacity / (1 - opacity)).astype(np.float32),
        ((records["rgba"][:, :3] / np.float32(255) - 0.5) / np.float32(Y_00)).astype(np.float32),
        np.zeros((len(records), 0, 3), np.float32),
    )


def _is_splat(path: Path) -> bool:
    """Return whether a file consists of records with finite numbers; the format has no mark of its own."""
    size = path.stat().st_size
    if size == 0 or size % _RECORD.itemsize:
        return False
    record = np.fromfile(path, _RECORD, 1)
    numbers = np.concatenate([record["xyz"][0], record["scale"][0]])
    return bool(np.isfinite(numbers).all() and (record["scale"] > 0).all())
