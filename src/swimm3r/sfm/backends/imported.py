"""Poses and points that another program found, completed here: its files -> depth -> water -> restored cloud.

`swimm3r.io.imports.read` lists the files that are read. Scale, intrinsics and points stay as they are; matches are the
pairs of observations of one point; where a file has neither observations nor depth, points are triangulated at its
poses (`swimm3r.sfm.colmap.triangulation`). Depth that comes with the file is used, else it is swept.

Frames that the model places but the split holds back take no part; their poses serve as reference
(`imported.model_poses`).
"""

from dataclasses import replace
from pathlib import Path

import numpy as np
import torch

from swimm3r.cameras import Cameras, cameras_of
from swimm3r.errors import InputError
from swimm3r.imaging.gray import LUMA
from swimm3r.io.colmap.model import ColmapModel
from swimm3r.io.imports.read import read_foreign
from swimm3r.io.imports.record import ForeignModel
from swimm3r.progress import Progress, silent
from swimm3r.scene.frames import MASKS, Frames
from swimm3r.scene.gravity import with_measured_up
from swimm3r.scene.placement import Navigator
from swimm3r.scene.reconstruction import DepthMap, DepthMaps, Matches, Points, QualityWarning, Reconstruction, Tracks
from swimm3r.sfm.colmap.triangulation import triangulate
from swimm3r.sfm.imported.match_frames import at_frame_size, named_frames
from swimm3r.sfm.medium.apply import with_water
from swimm3r.sfm.moving.find import with_moving
from swimm3r.sfm.plane_sweep.estimate import estimate_depth
from swimm3r.sfm.plane_sweep.views import on_frame_grid
from swimm3r.sfm.rig_poses import with_loose_rig
from swimm3r.sfm.settings import ColmapModelSettings
from swimm3r.sfm.tracks import MatchTracks, as_points
from swimm3r.tasks.settings import EngineSettings


def check_files(settings: ColmapModelSettings) -> None:
    """Raise InputError for a model that cannot be read; it is read whole."""
    read_foreign(settings.model)


def reconstruct(
    frames: Frames,
    settings: ColmapModelSettings,
    folder: Path,
    progress: Progress = silent,
    engine: EngineSettings = EngineSettings(),  # noqa: B008 - records are frozen
    navigator: Navigator | None = None,
) -> Reconstruction:
    """The reconstruction of the frames that the model names. Raises InputError where fewer than 2 of them are in it."""
    foreign = read_foreign(settings.model)
    rec = with_measured_up(from_foreign(frames, foreign, folder), frames)
    rec = rec if frames.rig is None else with_loose_rig(rec)
    if len(rec.tracks.point) == 0 and foreign.depth is None:
        rec = _with_points(rec, frames, foreign, settings, folder, progress)
    rec.save(folder, frames)
    if foreign.depth is None:
        estimate_depth(rec, frames, settings.depth, progress, engine)
    else:
        write_depth(rec, frames, foreign, progress)
    if settings.moving == "auto":
        rec = with_moving(rec, frames, folder / MASKS, progress)
    rec = with_water(rec, frames, settings, folder, progress)
    rec.save(folder, frames)
    return rec


def from_model(frames: Frames, model: ColmapModel, folder: Path) -> Reconstruction:
    """Cameras, points and tracks of the frames; depth maps are for others to fill."""
    names, rows = named_frames(frames, model)
    if len(names) < 2:
        raise InputError(
            f"{len(names)} of {len(frames)} training frames are in the COLMAP model, at least 2 are needed",
            cause=f"the model is of other images; it names {', '.join(model.names[:3])}, ...",
            hint="give with --images the folder that the model's names are relative to",
        )
    row_of = {row: i for i, row in enumerate(rows)}
    kept = np.isin(model.track_frame, rows)
    point, new_point = np.unique(model.track_point[kept], return_inverse=True)
    if len(model.track_point) == 0:  # a cloud that nobody says who saw
        point = np.arange(len(model.xyz))
    cameras = at_frame_size(cameras_of(model)[rows], frames)
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


def from_foreign(frames: Frames, foreign: ForeignModel, folder: Path) -> Reconstruction:
    """`from_model` with what the program knows besides: its name, whether lengths are metres, colors, matches."""
    rec = from_model(frames, foreign.model, folder)
    if not foreign.colored:
        order = [frames.index(name) for name in rec.names]
        points, _ = as_points(_as_match_tracks(rec), rec.tracks.xy, rec.cameras, frames, order)
        rec = replace(rec, points=points)
    return replace(rec, backend=foreign.program, metric=foreign.metric, matches=matches_of(rec.tracks))


def matches_of(tracks: Tracks, reach: int = 3) -> Matches:
    """Pairs of observations of one point, each with the next few frames that see it; confidence 1."""
    order = torch.from_numpy(np.lexsort((tracks.frame.numpy(), tracks.point.numpy())))
    point, frame, xy = tracks.point[order], tracks.frame[order], tracks.xy[order].float()
    pairs = []
    for step in range(1, reach + 1):
        first = torch.nonzero(point[step:] == point[:-step])[:, 0]
        pairs.append(torch.stack([first, first + step], -1))
    a, b = torch.cat(pairs).T
    return Matches(frame[a], frame[b], xy[a], xy[b], torch.ones(len(a)))


def write_depth(rec: Reconstruction, frames: Frames, foreign: ForeignModel, progress: Progress = silent) -> None:
    """The program's own depth maps on the grid of the prepared frames."""
    dense = foreign.depth
    assert dense is not None
    height, width = dense.z_depth.shape[1:]
    names, rows = named_frames(frames, foreign.model)
    canvas = Cameras(
        torch.from_numpy(dense.K[rows]), torch.zeros(len(rows), 0).double(), rec.cameras.cam2world, width, height
    )
    for k, (name, row) in enumerate(zip(names, rows, strict=True)):
        progress("depth", k, len(rows))
        z_depth, share, gray = (torch.from_numpy(a[row]).float() for a in (dense.z_depth, dense.confidence, dense.gray))
        inverse = torch.where(z_depth > 0, 1 / z_depth.clamp(min=1e-12), 0.0)
        wanted = frames.image(frames.index(name)) @ LUMA
        q, share = on_frame_grid(inverse, share, gray, wanted, rec.cameras[k], canvas[k])
        known = (q > 0) & frames.mask(frames.index(name))
        z = torch.where(known, 1 / q.clamp(min=1e-12), 0.0)
        rec.depth.write(name, DepthMap(z, torch.where(known, share, 0.0)))
    progress("depth", len(rows), len(rows))


def _with_points(
    rec: Reconstruction,
    frames: Frames,
    foreign: ForeignModel,
    settings: ColmapModelSettings,
    folder: Path,
    progress: Progress,
) -> Reconstruction:
    """The same cameras with points of our own, for a file that says nobody saw anything."""
    rec = triangulate(rec, frames, settings.features, folder, progress)
    if len(rec.tracks.point):
        return rec
    warning = QualityWarning(
        f"{foreign.program}'s file has no observations of points, and the images' own matches do not agree with its"
        " poses: depth and water cannot be found.",
        "Check that the images are those of the file, or let swimm3r estimate the poses.",
    )
    return replace(rec, warnings=(*rec.warnings, warning))


def _as_match_tracks(rec: Reconstruction) -> MatchTracks:
    whole = rec.tracks.xy.floor().long()
    return MatchTracks(rec.points.xyz, rec.tracks.point, rec.tracks.frame, whole)
