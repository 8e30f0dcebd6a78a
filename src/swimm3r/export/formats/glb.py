"""The dense cloud as binary glTF 2.0: one mesh of points.

glTF's y axis points up, so a node turns the cloud by half a turn about x, as the first camera holds it; the positions
themselves are the run's. Vertex colors are in linear light, as glTF asks, and floats: 8 bits would
band what is dark.
"""

import json
import struct
from pathlib import Path

import numpy as np
import torch
from jaxtyping import Float

from swimm3r.errors import InputError
from swimm3r.export.result import Exported, begins_with, check_replaceable
from swimm3r.export.settings import GlbSettings
from swimm3r.io.files.atomic import atomic_path
from swimm3r.medium import linear_from_srgb
from swimm3r.scene.reconstruction import DenseCloud, Reconstruction
from swimm3r.scene.reconstruction_io import load_reconstruction
from swimm3r.scene.run_folder import open_run

_MAGIC, _VERSION = b"glTF", 2
_FLOAT, _POINTS, _ARRAY_BUFFER = 5126, 0, 34962
_TURN = [1, 0, 0, 0, 0, -1, 0, 0, 0, 0, -1, 0, 0, 0, 0, 1]


def export_run(folder: Path, path: Path, settings: GlbSettings) -> Exported:
    """Write the dense cloud of a run with finished structure from motion."""
    check_replaceable(path, begins_with(_MAGIC), "GLB file")
    open_run(folder, "sfm")
    rec = load_reconstruction(folder / "sfm")
    if rec.cloud is None:
        raise InputError(
            f"the run in {folder} has no dense cloud",
            cause="depth was too scarce to estimate the water (see the report's warnings)",
            hint="--format colmap or nerfstudio, which have the sparse points",
        )
    n = len(rec.cloud.xyz)
    kept = torch.arange(n) if n <= settings.point_limit else torch.linspace(0, n - 1, settings.point_limit).long()
    write_glb(path, rec.cloud.xyz[kept].numpy(), _colors(rec, rec.cloud, settings)[kept].numpy())
    return Exported(path, f"{len(kept):,} of {n:,} points" if len(kept) < n else f"{n:,} points")


def write_glb(path: Path, xyz: Float[np.ndarray, "n 3"], rgb: Float[np.ndarray, "n 3"]) -> None:
    """Write points with colors 0..1 as stored (sRGB-encoded), whole or not at all."""
    positions = np.ascontiguousarray(xyz, "<f4")
    colors = linear_from_srgb(torch.from_numpy(rgb).clamp(0, 1)).numpy().astype("<f4")
    body = positions.tobytes() + colors.tobytes()
    described = _document(positions, len(body))
    text = json.dumps(described, separators=(",", ":")).encode()
    text += b" " * (-len(text) % 4)
    chunks = b"".join(struct.pack("<I4s", len(data), kind) + data for kind, data in ((b"JSON", text), (b"BIN\0", body)))
    with atomic_path(path) as draft:
        draft.write_bytes(struct.pack("<4sII", _MAGIC, _VERSION, 12 + len(chunks)) + chunks)


def _document(positions: Float[np.ndarray, "n 3"], size: int) -> dict:
    n, split = len(positions), positions.nbytes
    return {
        "asset": {"version": "2.0", "generator": "swimm3r"},
        "scene": 0,
        "scenes": [{"nodes": [0]}],
        "nodes": [{"mesh": 0, "name": "cloud", "matrix": _TURN}],
        "meshes": [{"primitives": [{"attributes": {"POSITION": 0, "COLOR_0": 1}, "mode": _POINTS}]}],
        "accessors": [
            {
                "bufferView": 0, "componentType": _FLOAT, "count": n, "type": "VEC3",
                "min": positions.min(0).tolist(), "max": positions.max(0).tolist(),
            },
            {"bufferView": 1, "componentType": _FLOAT, "count": n, "type": "VEC3"},
        ],
        "bufferViews": [
            {"buffer": 0, "byteOffset": 0, "byteLength": split, "target": _ARRAY_BUFFER},
            {"buffer": 0, "byteOffset": split, "byteLength": size - split, "target": _ARRAY_BUFFER},
        ],
        "buffers": [{"byteLength": size}],
    }  # fmt: skip


def _colors(rec: Reconstruction, cloud: DenseCloud, settings: GlbSettings) -> torch.Tensor:
    match settings.colors:
        case "shown":
            return cloud.shown(rec.white_balance)
        case "physical":
            return cloud.restored.clamp(max=1)
        case "raw":
            return cloud.raw
