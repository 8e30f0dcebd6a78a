"""Depth maps as images: PNG of 16 bits with one unit for all frames, or TIFF of 32-bit floats; 0 where unknown.

depth.json beside them has the unit, z depth or ray depth, and the level of a PNG: z = level * value.
"""

import json
from pathlib import Path

import numpy as np
from jaxtyping import Float32

from swimm3r.errors import InputError
from swimm3r.export.result import Exported
from swimm3r.export.settings import DepthSettings
from swimm3r.io import images
from swimm3r.io.depth import write_depth
from swimm3r.io.files.atomic import atomic_folder, write_text
from swimm3r.io.files.outputs import check_empty
from swimm3r.io.view_names import view_stems
from swimm3r.scene.reconstruction import Reconstruction
from swimm3r.scene.reconstruction_io import load_reconstruction
from swimm3r.scene.run_folder import open_run

_MILLIMETRE = 0.001
_LEVELS = 65_535


def export_run(folder: Path, path: Path, settings: DepthSettings) -> Exported:
    """Write the depth maps of a run with finished structure from motion into a folder that is new or empty."""
    check_empty(path)
    open_run(folder, "sfm")
    rec = load_reconstruction(folder / "sfm")
    names = [name for name in rec.names if name in rec.depth]
    if not names:
        raise InputError(
            f"the run in {folder} has no depth maps",
            cause="the reconstruction found no dense depth",
            hint="--format colmap, which has the sparse points",
        )
    stems, unit = view_stems(rec.names), "metres" if rec.metric else "scene units"
    level = level_of(rec, names) if settings.type == "png" else 1.0
    with atomic_folder(path) as draft:
        for name in names:
            z = rec.depth[name].z_depth.numpy()
            place = draft / f"{stems[name]}.{'png' if settings.type == 'png' else 'tif'}"
            if settings.type == "png":
                images.write_levels(place, as_levels(z, level))
            else:
                write_depth(place, z)
        write_text(
            draft / "depth.json",
            json.dumps(
                {
                    "kind": "z_depth",
                    "unit": unit,
                    "level": level,
                    "unknown": 0,
                    "files": {name: f"{stems[name]}.{'png' if settings.type == 'png' else 'tif'}" for name in names},
                },
                indent=1,
            )
            + "\n",
        )
    lost = f"A level is {level:.3g} {unit}: depth is rounded by half of it at most." if settings.type == "png" else ""
    return Exported(path, f"{len(names)} depth maps in {unit}", lost)


def level_of(rec: Reconstruction, names: list[str]) -> float:
    """The depth of one level: a millimetre where the scale is metric and that reaches far enough, else the farthest
    depth by the number of levels, rounded up to two digits.
    """
    farthest = max(float(rec.depth[name].z_depth.max()) for name in names)
    if rec.metric and farthest <= _MILLIMETRE * _LEVELS:
        return _MILLIMETRE
    least = max(farthest, 1e-9) / _LEVELS
    digit = 10.0 ** (np.floor(np.log10(least)) - 1)
    return float(np.ceil(least / digit) * digit)


def as_levels(z: Float32[np.ndarray, "h w"], level: float) -> np.ndarray:
    """Depth in whole levels; known depth is never 0."""
    return np.where(z > 0, np.clip(np.round(z / level), 1, _LEVELS), 0).astype(np.uint16)
