"""Masks of moving objects in the training frames, and a reconstruction without what moves."""

from dataclasses import replace
from pathlib import Path

import torch
from jaxtyping import Bool
from torch import Tensor

from swimm3r.io import images
from swimm3r.io.files.atomic import atomic_folder
from swimm3r.progress import Progress, silent
from swimm3r.scene.frame_changes import MovingMasks
from swimm3r.scene.frames import Frames
from swimm3r.scene.reconstruction import DepthMap, QualityWarning, Reconstruction, Tracks
from swimm3r.sfm.moving.still_scene import enlarged, still_scene

_NOTABLE = 0.01  # of the pixels of all frames, from which a user should look at the masks


def with_moving(rec: Reconstruction, frames: Frames, folder: Path, progress: Progress = silent) -> Reconstruction:
    """The reconstruction with the masks of `find_moving`, and a warning where objects cover much of the frames.

    Depth on the objects is removed from the maps on disk.
    """
    masks = find_moving(rec, frames, folder, progress)
    covered = sum(share for _, share in masks.shares(frames)) / len(rec.names)
    rec = replace(rec, moving=masks)
    mask_depth(rec, frames)
    if covered < _NOTABLE:
        return rec
    warning = QualityWarning(
        f"Moving objects cover {covered:.1%} of the frames; they are left out of depth, water and static maps.",
        f"Check the masks in sfm/{folder.name}. A map that shows the objects: --recipe uwbs-dynamic.",
    )
    return rec if warning in rec.warnings else replace(rec, warnings=(*rec.warnings, warning))


def find_moving(rec: Reconstruction, frames: Frames, folder: Path, progress: Progress = silent) -> MovingMasks:
    """Masks of moving objects in the registered frames, in a new folder; those of an earlier call are kept."""
    if folder.is_dir():
        return MovingMasks(folder)
    found = still_scene(rec, frames).moving_in_frames(progress)
    with atomic_folder(folder) as draft:
        for name, moving in zip(rec.names, found, strict=True):
            if moving.any():
                still = ~enlarged(moving, frames.height, frames.width)
                images.write_mask(draft / f"{name}.png", (still & frames.mask(frames.index(name))).numpy())
    return MovingMasks(folder)


def mask_depth(rec: Reconstruction, frames: Frames) -> None:
    """Remove depth on moving objects from the maps on disk."""
    still = rec.still(frames)
    for name in rec.names:
        if rec.moving is not None and name in rec.moving:
            usable, depth = still.mask(frames.index(name)), rec.depth[name]
            kept = (torch.where(usable, values, 0.0) for values in (depth.z_depth, depth.confidence))
            rec.depth.write(name, DepthMap(*kept))


def without_moving_observations(rec: Reconstruction, frames: Frames) -> Reconstruction:
    """The reconstruction without observations on moving objects, and without points that fewer than two are left of."""
    still, kept = rec.still(frames), torch.ones(len(rec.tracks.point), dtype=torch.bool)
    for i, name in enumerate(rec.names):
        if rec.moving is not None and name in rec.moving:
            mine = (rec.tracks.frame == i).nonzero()[:, 0]
            column, row = rec.tracks.xy[mine].long().unbind(-1)
            usable = still.mask(frames.index(name))
            kept[mine] = usable[row.clamp(0, frames.height - 1), column.clamp(0, frames.width - 1)]
    return rec if bool(kept.all()) else _with_observations(rec, kept)


def _with_observations(rec: Reconstruction, kept: Bool[Tensor, " o"]) -> Reconstruction:
    """The reconstruction with some of its observations, and the points that two or more of them see."""
    tracks = rec.tracks
    seen = torch.bincount(tracks.point[kept], minlength=len(rec.points.xyz)) >= 2
    number, kept = seen.cumsum(0) - 1, kept & seen[tracks.point]
    points = type(rec.points)(**{name: values[seen] for name, values in vars(rec.points).items()})
    return replace(rec, points=points, tracks=Tracks(number[tracks.point[kept]], tracks.frame[kept], tracks.xy[kept]))
