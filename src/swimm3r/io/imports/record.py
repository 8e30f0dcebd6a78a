"""One record for what other programs say about a set of pictures, and which reader takes which file."""

from dataclasses import dataclass
from pathlib import Path

import numpy as np

from swimm3r.cameras import cameras_of, check_lens
from swimm3r.errors import InputError
from swimm3r.io.cameras_json import read_cameras
from swimm3r.io.colmap import model as colmap
from swimm3r.io.colmap.model import ColmapModel
from swimm3r.io.files import json_file
from swimm3r.io.files.damage import Remedy, guard

REMEDY = Remedy(
    "a COLMAP model, transforms.json, Metashape cameras.xml, OpenMVG sfm_data.json, VGGT predictions.npz, cameras.json",
    cause="the file is damaged, or of another program or version",
    fault="cannot be read as a reconstruction",
)


@dataclass(frozen=True)
class ForeignDepth:
    """Dense depth of the pictures in the order of the model's names, on a grid of their own."""

    K: np.ndarray  # [c, 3, 3] of the grid
    z_depth: np.ndarray  # [c, h, w], 0 = unknown
    confidence: np.ndarray  # [c, h, w], 0..1
    grey: np.ndarray  # [c, h, w] the pictures on the grid, 0..1


@dataclass(frozen=True)
class ForeignModel:
    """A reconstruction as its file has it; lengths are in the file's unit."""

    program: str
    model: ColmapModel
    metric: bool = False
    coloured: bool = True  # whether the points' colours are known
    depth: ForeignDepth | None = None


def read_foreign(path: Path) -> ForeignModel:
    """Read a COLMAP (GLOMAP, GLUEMAP, VGGT's demo_colmap) model, a nerfstudio or Spann3R transforms.json, a Metashape
    cameras.xml, an OpenMVG sfm_data.json or a VGGT predictions.npz; or the folder that holds one of them; or a
    cameras.json of ours, which lies beside models that say more and so must be named itself.

    Raises InputError for anything else and for a damaged file.
    """
    found = _file(path)
    with guard(found or path, REMEDY):
        foreign = _read(found) if found else ForeignModel("COLMAP model", colmap.read_model(path))
        check_lens(cameras_of(foreign.model))
        return foreign


def _read(path: Path) -> ForeignModel:
    from swimm3r.io.imports import metashape, nerfstudio, openmvg, vggt

    match path.suffix.lower():
        case ".xml":
            return metashape.read(path)
        case ".npz":
            return vggt.read(path)
    document = json_file.decode(path.read_bytes())
    if not isinstance(document, dict):
        raise ValueError("a JSON object is expected")
    if "sfm_data_version" in document:
        return openmvg.read(document)
    frames = document.get("frames")
    if isinstance(frames, list) and any(isinstance(frame, dict) and "c2w" in frame for frame in frames):
        return _own(path)
    return nerfstudio.read(path, document)


def without_points(
    names: tuple[str, ...],
    lens: str,
    size: tuple[int, int],
    K: np.ndarray,
    distortion: np.ndarray,
    cam2world: np.ndarray,
) -> ColmapModel:
    """A model of poses alone."""
    none = np.zeros(0, np.int64)
    return ColmapModel(
        names=names,
        model=lens,
        width=size[0],
        height=size[1],
        K=K,
        distortion=distortion,
        cam2world=cam2world,
        xyz=np.zeros((0, 3)),
        rgb=np.zeros((0, 3), np.uint8),
        error=np.zeros(0),
        track_point=none,
        track_frame=none,
        track_xy=np.zeros((0, 2)),
    )


def one_size(sizes: set[tuple[int, int]]) -> tuple[int, int]:
    """The common picture size. Raises InputError where there are several."""
    if len(sizes) != 1:
        raise InputError(
            f"the reconstruction mixes picture sizes: {', '.join(f'{w}x{h}' for w, h in sorted(sizes))}",
            cause="pictures of several cameras or crops were reconstructed together",
            hint="reconstruct the pictures of one size, or resize them first",
        )
    return next(iter(sizes))


def _own(path: Path) -> ForeignModel:
    """A cameras.json, as docs/conventions.md has it."""
    table = read_cameras(path)
    size = (table.width, table.height)
    model = without_points(table.names, table.model, size, table.K, table.distortion, table.cam2world)
    return ForeignModel("cameras.json", model, metric=table.units == "metres")


def _file(path: Path) -> Path | None:
    """The file to read, None for a COLMAP model's folder."""
    if path.is_file():
        return path
    for name in ("transforms.json", "sfm_data.json", "cameras.xml", "predictions.npz"):
        if (path / name).is_file():
            return path / name
    return None
