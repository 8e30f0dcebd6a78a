"""Gaussians as 3DGS stores them in PLY: logits, log scales, quaternions wxyz, harmonics channel by channel.

There are always the 45 harmonics of degree 1 to 3 that its loader insists on; those the map has not are 0.
"""

from pathlib import Path

import numpy as np

from swimm3r.export.result import Exported, check_replaceable
from swimm3r.export.settings import SplatPlySettings
from swimm3r.export.splats import SplatArrays, open_map
from swimm3r.io.ply import is_ply, write_vertices

_HARMONICS = 15


def export_run(folder: Path, path: Path, settings: SplatPlySettings) -> Exported:
    """Write a finished run's map, and measure how far its Gaussians are from it in views along the dive."""
    check_replaceable(path, is_ply, "PLY file")
    found = open_map(folder, settings)
    arrays = found.arrays()
    write_ply(path, arrays)
    return found.result(path, arrays)


def write_ply(path: Path, arrays: SplatArrays) -> None:
    """Write the properties that 3DGS's loader reads, in its order."""
    n, known = len(arrays.xyz), arrays.harmonics.shape[1]
    harmonics = np.zeros((n, 3, _HARMONICS), np.float32)
    harmonics[:, :, :known] = arrays.harmonics.transpose(0, 2, 1)
    columns = {
        **{name: arrays.xyz[:, k] for k, name in enumerate("xyz")},
        **{f"n{name}": np.zeros(n, np.float32) for name in "xyz"},
        **{f"f_dc_{k}": arrays.color[:, k] for k in range(3)},
        **{f"f_rest_{k}": values for k, values in enumerate(harmonics.reshape(n, -1).T)},
        "opacity": arrays.logit,
        **{f"scale_{k}": arrays.log_scale[:, k] for k in range(3)},
        **{f"rot_{k}": arrays.quaternion[:, k] for k in range(4)},
    }
    vertices = np.empty(n, [(name, "<f4") for name in columns])
    for name, values in columns.items():
        vertices[name] = values
    write_vertices(path, vertices)
