"""COLMAP's models of a clip as records: cameras, colored points, tracks, verified matches; models left over on disk."""

import shutil
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from swimm3r.cameras import cameras_of, rows_of_frames
from swimm3r.io.colmap.model import ColmapModel, from_pycolmap, write_model
from swimm3r.scene.frames import Frames
from swimm3r.scene.reconstruction import DepthMaps, Matches, Points, Reconstruction, Tracks
from swimm3r.sfm.colmap.chunks.parts import LEAST_FRAMES
from swimm3r.sfm.features.database import FeatureDatabase

if TYPE_CHECKING:
    import pycolmap

PARTS = "parts"  # folder of the models that did not join the largest
_NONE, _NOWHERE = np.zeros(0), np.zeros((0, 2))  # what is joined where no pair matches


def record_of(model: "pycolmap.Reconstruction", store: FeatureDatabase, frames: Frames, folder: Path) -> Reconstruction:
    """The record of a model whose images are named by their number in the clip; `folder` is the run's sfm."""
    table = from_pycolmap(model)
    index = [int(name) for name in table.names]
    table = replace(table, names=tuple(frames.names[i] for i in index))
    return Reconstruction(
        names=table.names,
        cameras=cameras_of(table),
        points=Points(torch.from_numpy(table.xyz), _colors(table, frames, index), torch.from_numpy(table.error)),
        tracks=Tracks(*(torch.from_numpy(a) for a in (table.track_point, table.track_frame, table.track_xy))),
        matches=verified_matches(store, index),
        depth=DepthMaps(folder / "z_depth"),
        backend="colmap",
    )


def _colors(table: ColmapModel, frames: Frames, index: list[int]) -> Float[Tensor, "p 3"]:
    total = torch.zeros(len(table.xyz), 3)
    point, frame = torch.from_numpy(table.track_point), torch.from_numpy(table.track_frame)
    x = torch.from_numpy(table.track_xy[:, 0]).long().clamp(0, frames.width - 1)
    y = torch.from_numpy(table.track_xy[:, 1]).long().clamp(0, frames.height - 1)
    for seen, i in zip(rows_of_frames(frame, len(index)), index, strict=True):
        total.index_add_(0, point[seen], frames.image(i)[y[seen], x[seen]])
    return total / torch.bincount(point, minlength=len(total)).clamp(min=1)[:, None]


def verified_matches(store: FeatureDatabase, index: list[int]) -> Matches:
    """The verified matches among the database's frames of these numbers; `index[k]` is frame k of the result."""
    import pycolmap

    row_of = {i: row for row, i in enumerate(index)}
    i, j, xy_i, xy_j = [], [], [], []
    with store.open() as database:
        xy = {k: database.read_keypoints(k + 1)[:, :2].astype(np.float64) for k in index}
        pairs, counts = database.read_two_view_geometry_num_inliers()
        for pair in sorted(pair for pair, count in zip(pairs, counts, strict=True) if count):
            a, b = (k - 1 for k in pycolmap.pair_id_to_image_pair(pair))
            if a not in row_of or b not in row_of:
                continue
            rows = np.asarray(database.read_two_view_geometry(a + 1, b + 1).inlier_matches, np.int64).reshape(-1, 2)
            i.append(np.full(len(rows), row_of[a]))
            j.append(np.full(len(rows), row_of[b]))
            xy_i.append(xy[a][rows[:, 0]])
            xy_j.append(xy[b][rows[:, 1]])
    first, second = (torch.from_numpy(np.concatenate([_NONE, *side]).astype(np.int64)) for side in (i, j))
    return Matches(
        i=first,
        j=second,
        xy_i=torch.from_numpy(np.concatenate([_NOWHERE, *xy_i])).float(),
        xy_j=torch.from_numpy(np.concatenate([_NOWHERE, *xy_j])).float(),
        confidence=torch.ones(len(first)),
    )


def write_parts(
    model: "pycolmap.Reconstruction", others: "list[pycolmap.Reconstruction]", frames: Frames, folder: Path
) -> list[int]:
    """Write models that did not join the largest as `folder`/1, 2, ... and return how many frames each has.

    Kept are those with at least three frames that no larger one has.
    """
    shutil.rmtree(folder, ignore_errors=True)
    known = {model.images[i].name for i in model.reg_image_ids()}
    sizes = []
    for other in sorted(others, key=lambda m: m.num_reg_images(), reverse=True):
        own = {other.images[i].name for i in other.reg_image_ids()}
        if len(own - known) < LEAST_FRAMES:
            continue
        known |= own
        sizes.append(len(own))
        table = from_pycolmap(other)
        write_model(folder / f"{len(sizes)}", replace(table, names=tuple(frames.names[int(n)] for n in table.names)))
    return sizes
