"""Poses and points that another program found, completed here: COLMAP model -> depth -> water -> restored cloud.

Frames that the model places but the split holds back take no part; their poses serve as reference (`model_cameras`).
"""

from pathlib import Path, PurePosixPath

import numpy as np
import torch

from swimm3r import reconstruction
from swimm3r.cameras import Cameras, resized
from swimm3r.errors import InputError
from swimm3r.frames import Frames
from swimm3r.io.colmap import ColmapModel, read_model
from swimm3r.progress import Progress, silent
from swimm3r.reconstruction import DepthMaps, Matches, Points, Reconstruction, Tracks, cameras_of
from swimm3r.sfm.plane_sweep import estimate_depth
from swimm3r.sfm.settings import ColmapModelSettings
from swimm3r.sfm.water import with_water

_ASPECT = 0.01  # relative difference of aspect ratios beyond which pictures are not those of the model


def reconstruct(
    frames: Frames, settings: ColmapModelSettings, folder: Path, progress: Progress = silent
) -> Reconstruction:
    """The reconstruction of the frames that the model names. Raises InputError where fewer than 2 of them are in it."""
    rec = from_model(frames, read_model(settings.model), folder)
    reconstruction.save(rec, folder)
    estimate_depth(rec, frames, settings.depth, progress)
    rec = with_water(rec, frames, settings, folder, progress)
    reconstruction.save(rec, folder)
    return rec


def from_model(frames: Frames, model: ColmapModel, folder: Path) -> Reconstruction:
    """Cameras, points and tracks of the frames; depth maps are for others to fill."""
    names, rows = _named(frames, model)
    if len(names) < 2:
        raise InputError(
            f"{len(names)} of {len(frames)} training frames are in the COLMAP model, at least 2 are needed",
            cause=f"the model is of other pictures; it names {', '.join(model.names[:3])}, ...",
            hint="give with --images the folder that the model's names are relative to",
        )
    row_of = {row: i for i, row in enumerate(rows)}
    kept = np.isin(model.track_frame, rows)
    point, new_point = np.unique(model.track_point[kept], return_inverse=True)
    cameras = _at_frame_size(cameras_of(model)[rows], frames)
    scale = np.array([frames.width / model.width, frames.height / model.height])
    none = torch.zeros(0, dtype=torch.int64)
    return Reconstruction(
        names=names,
        cameras=cameras,
        points=Points(
            torch.from_numpy(model.xyz[point]),
            torch.from_numpy(model.rgb[point].astype(np.float32)) / 255,
            torch.from_numpy(model.error[point]) * float(scale.mean()),
        ),
        tracks=Tracks(
            torch.from_numpy(new_point.astype(np.int64)),
            torch.tensor([row_of[row] for row in model.track_frame[kept].tolist()], dtype=torch.int64),
            torch.from_numpy(model.track_xy[kept] * scale),
        ),
        matches=Matches(none, none, torch.zeros(0, 2), torch.zeros(0, 2), torch.zeros(0)),
        depth=DepthMaps(folder / "z_depth"),
        backend="COLMAP model",
    )


def model_cameras(frames: Frames, model: ColmapModel) -> tuple[tuple[str, ...], Cameras]:
    """The frames that the model places, and their cameras at the size of the frames."""
    names, rows = _named(frames, model)
    return names, _at_frame_size(cameras_of(model)[rows], frames)


def _named(frames: Frames, model: ColmapModel) -> tuple[tuple[str, ...], list[int]]:
    """Frames that the model places and their rows in it; preparation may have changed a suffix."""
    by_stem = {str(PurePosixPath(name).with_suffix("")): row for row, name in enumerate(model.names)}
    by_name = {name: row for row, name in enumerate(model.names)}
    rows = {name: by_name.get(name, by_stem.get(str(PurePosixPath(name).with_suffix("")))) for name in frames.names}
    placed = {name: row for name, row in rows.items() if row is not None}
    return tuple(placed), list(placed.values())


def _at_frame_size(cameras: Cameras, frames: Frames) -> Cameras:
    width, height = frames.width, frames.height
    if abs(width * cameras.height / (height * cameras.width) - 1) > _ASPECT:
        raise InputError(
            f"the frames are {width}x{height}, the COLMAP model's pictures {cameras.width}x{cameras.height}",
            cause="the pictures were cropped or turned after the model was made",
            hint="give the pictures that the model was made of",
        )
    if (width, height) == (cameras.width, cameras.height):
        return cameras
    return resized(cameras, width, height)
