"""One record for what other programs say about a set of pictures, and which reader takes which file."""

import json
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from swimm3r.errors import InputError
from swimm3r.io import colmap
from swimm3r.io.cameras_json import read_cameras
from swimm3r.io.colmap import ColmapModel


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
    from swimm3r.io.foreign import metashape, nerfstudio, openmvg, vggt

    found = _file(path)
    if found is None:
        return ForeignModel("COLMAP model", colmap.read_model(path))
    try:
        match found.suffix.lower():
            case ".xml":
                return metashape.read(found)
            case ".npz":
                return vggt.read(found)
            case _:
                document = json.loads(found.read_text(encoding="utf-8"))
                if not isinstance(document, dict):
                    raise ValueError("a JSON object was expected")
                if "sfm_data_version" in document:
                    return openmvg.read(found, document)
                if any("c2w" in frame for frame in document.get("frames", [])):
                    return _own(found)
                return nerfstudio.read(found, document)
    except (KeyError, ValueError, TypeError, IndexError, SyntaxError) as error:  # SyntaxError: XML's ParseError
        what = f"it has no {error}" if isinstance(error, KeyError) else str(error).splitlines()[0]
        raise InputError(
            f"{found} cannot be read as a reconstruction: {what[:200]}",
            cause="the file is damaged, or of another program or version",
            hint="a COLMAP model, transforms.json, Metashape cameras.xml, OpenMVG sfm_data.json, VGGT predictions.npz,"
            " cameras.json",
        ) from error


def without_points(
    names: tuple[str, ...],
    lens: str,
    size: tuple[int, int],
    K: np.ndarray,
    distortion: np.ndarray,
    cam2world: np.ndarray,
) -> ColmapModel:
    """A model of poses alone. Raises InputError for names that lead out of their folder."""
    colmap.check_names(names)
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
