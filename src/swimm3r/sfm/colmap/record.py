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
from swimm3r.sfm.colmap.rig.lenses import RigLenses
from swimm3r.sfm.features.database import FeatureDatabase

if TYPE_CHECKING:
    import pycolmap

PARTS = "parts"  # folder of the models that did not join the largest


def record_of(
    model: "pycolmap.Reconstruction",
    store: FeatureDatabase,
    frames: Frames,
    folder: Path,
    lenses: RigLenses | None = None,
) -> Reconstruction:
    """The record of a model whose images are named by their number in the clip; `folder` is the run's sfm.

    It is in pixels of the frames. With `lenses` keypoints of the database and the model are as a rig's first lens has
    them.
    """
    table = table_of(model, store, frames, lenses)
    index = frame_numbers(model)
    matches = verified_matches(store, index)
    if lenses is not None:
        matches = lenses.own_matches(matches, index)
    return Reconstruction(
        names=table.names,
        cameras=cameras_of(table),
        points=Points(torch.from_numpy(table.xyz), _colors(table, frames, index), torch.from_numpy(table.error)),
        tracks=Tracks(*(torch.from_numpy(a) for a in (table.track_point, table.track_frame, table.track_xy))),
        matches=matches,
        depth=DepthMaps(folder / "z_depth"),
        backend="colmap",
    )


def frame_numbers(model: "pycolmap.Reconstruction") -> list[int]:
    """The number in the clip of each registered image of a model, in the order of its records."""
    return [int(model.image(i).name) for i in sorted(model.reg_image_ids())]


def table_of(
    model: "pycolmap.Reconstruction", store: FeatureDatabase, frames: Frames, lenses: RigLenses | None = None
) -> ColmapModel:
    """The arrays of a model in pixels of the frames, under their names; with `lenses` under each camera's own lens."""
    table, index = _in_pixels_of(frames, from_pycolmap(model), store.scale), frame_numbers(model)
    if lenses is not None:
        table = lenses.own_model(table, index)
    return replace(table, names=tuple(frames.names[i] for i in index))


def _in_pixels_of(frames: Frames, table: ColmapModel, scale: float) -> ColmapModel:
    """The model of a database of so many pixels per pixel of the frames in pixels of the frames."""
    if scale == 1:
        return table
    K = table.K.copy()
    K[:, :2] /= scale
    return replace(
        table,
        width=frames.width,
        height=frames.height,
        K=K,
        error=table.error / scale,
        track_xy=table.track_xy / scale,
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
    """The verified matches among the database's frames of these numbers, in pixels of the frames.

    `index[k]` is frame k of the result.
    """
    import pycolmap

    row_of = {i: row for row, i in enumerate(index)}
    with store.open() as database:
        pixels = {i: torch.from_numpy(database.read_keypoints(i + 1)[:, :2] / np.float32(store.scale)) for i in index}
        found = [
            (*(image - 1 for image in pycolmap.pair_id_to_image_pair(pair)), count)
            for pair, count in sorted(zip(*database.read_two_view_geometry_num_inliers(), strict=True))
        ]
        pairs = [(a, b, count) for a, b, count in found if count and a in row_of and b in row_of]
        total = sum(count for *_, count in pairs)  # millions: each array is allocated once
        matches = Matches(
            i=torch.empty(total, dtype=torch.int64),
            j=torch.empty(total, dtype=torch.int64),
            xy_i=torch.empty(total, 2),
            xy_j=torch.empty(total, 2),
            confidence=torch.ones(total),
        )
        end = 0
        for a, b, count in pairs:
            inliers = database.read_two_view_geometry(a + 1, b + 1).inlier_matches.astype(np.int64)
            rows, end = slice(end, end + count), end + count
            matches.i[rows], matches.j[rows] = row_of[a], row_of[b]
            matches.xy_i[rows] = pixels[a][inliers[:, 0]]
            matches.xy_j[rows] = pixels[b][inliers[:, 1]]
    return matches


def write_parts(
    model: "pycolmap.Reconstruction",
    others: "list[pycolmap.Reconstruction]",
    store: FeatureDatabase,
    frames: Frames,
    folder: Path,
    lenses: RigLenses | None = None,
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
        write_model(folder / f"{len(sizes)}", table_of(other, store, frames, lenses))
    return sizes
