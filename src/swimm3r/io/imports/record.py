"""The record of a reconstruction made by another program."""

from dataclasses import dataclass

import numpy as np

from swimm3r.errors import InputError
from swimm3r.io.colmap.model import ColmapModel
from swimm3r.io.files.damage import Remedy

REMEDY = Remedy(
    "a COLMAP model, transforms.json, Metashape cameras.xml, OpenMVG sfm_data.json, VGGT predictions.npz, cameras.json",
    cause="the file is damaged, or of another program or version",
    fault="cannot be read as a reconstruction",
)


@dataclass(frozen=True)
class ForeignDepth:
    """Dense depth of the images in the order of the model's names, on a grid of their own."""

    K: np.ndarray  # [c, 3, 3] of the grid
    z_depth: np.ndarray  # [c, h, w], 0 = unknown
    confidence: np.ndarray  # [c, h, w], 0..1
    gray: np.ndarray  # [c, h, w] the images on the grid, 0..1


@dataclass(frozen=True)
class ForeignModel:
    """A reconstruction as its file has it; lengths are in the file's unit."""

    program: str
    model: ColmapModel
    metric: bool = False
    colored: bool = True  # whether the points' colors are known
    depth: ForeignDepth | None = None


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
    """The common image size. Raises InputError where there are several."""
    if len(sizes) != 1:
        raise InputError(
            f"the reconstruction mixes image sizes: {', '.join(f'{w}x{h}' for w, h in sorted(sizes))}",
            cause="images of several cameras or crops were reconstructed together",
            hint="reconstruct the images of one size, or resize them first",
        )
    return next(iter(sizes))
