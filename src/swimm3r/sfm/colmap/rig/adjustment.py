"""A reconstruction whose cameras stand as those of a rigid rig: bundle adjustment with one pose per instant.

Frames are placed one by one before. Their relative poses give the rig (`sfm.rig_poses`), each instant begins at that of
its frames' poses which explains its observations best, and rig, poses, points and lens are adjusted together. Where the
images contradict a rigid rig, for they were not taken together, poses stay as they were.
"""

import logging
from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from swimm3r.cameras import cameras_of, project
from swimm3r.geometry import invert_poses, rotation_angle
from swimm3r.io.colmap.model import from_pycolmap, silence_log
from swimm3r.io.colmap.rigs import RigLayout, rigged, sensor_poses
from swimm3r.progress import Progress, silent
from swimm3r.scene.frames import Frames
from swimm3r.scene.reconstruction import Points, QualityWarning, Reconstruction, Tracks
from swimm3r.scene.rig import PlacedCamera, Rig, RigFit, pose_of
from swimm3r.sfm.colmap.adjustment import WIDEST, robust_adjustment, typical_error
from swimm3r.sfm.colmap.calibration.adjust import STILL, THREADS
from swimm3r.sfm.colmap.calibration.start import is_lens
from swimm3r.sfm.rig_poses import LEAST, RigRows, delay_of, relative_scatter, relative_to_first, rig_rows, robust_mean
from swimm3r.sfm.settings import ColmapSettings

if TYPE_CHECKING:
    import pycolmap

log = logging.getLogger(__name__)

_MAX_ERROR = 4.0  # pixels, as in mapping
_MIN_ANGLE = 1.5  # degrees between rays, as in mapping
_WORSE, _WORSE_PX = 1.3, 0.15  # median reprojection error of a rig by that of free poses, and beyond it in pixels
_CALIBRATED = np.radians(3.0)  # between the calibrated pose of a camera and the one found
_STEP = "adjusting the rig"


def as_rig(
    rec: Reconstruction, frames: Frames, settings: ColmapSettings, progress: Progress = silent
) -> Reconstruction:
    """The reconstruction with the poses of a rig, and what is known of it; unchanged poses where there is no rigid one.

    Lengths stay in the unit of the reconstruction; a calibrated or given baseline is a source of scale.
    """
    rig = frames.rig
    assert rig is not None
    silence_log()
    rows = rig_rows(rec.names, frames)
    seen = [len(relative_to_first(rec.cameras.cam2world, rows, k)) for k in range(len(rig.cameras))]
    if min(seen) < LEAST:
        name = rig.names[int(np.argmin(seen))]
        warning = QualityWarning(
            f"The rig is not used: {name} and {rig.names[0]} have poses together at {min(seen)} instants only.",
            "Check that both see the same ground, and that the names under --rig are those of one rig.",
        )
        return replace(rec, warnings=(*rec.warnings, warning))
    progress(_STEP, 0, 3)
    camera2rig = torch.stack([robust_mean(relative_to_first(rec.cameras.cam2world, rows, k)) for k in range(len(seen))])
    model = rigged(_on_rig(rec, rows, camera2rig).colmap_model(), _layout(rec, rows, camera2rig))
    progress(_STEP, 1, 3)
    model = _adjusted(model, WIDEST)
    free_px, rig_px = float(_errors(rec).median()), float(_errors(_record(rec, model)).median())
    rigid = rig_px <= max(_WORSE * free_px, free_px + _WORSE_PX)
    if rigid:
        progress(_STEP, 2, 3)
        model = _settled(model, settings, parted=_lenses_differ(rec))
    progress(_STEP, 3, 3)
    sensors = sensor_poses(model) if rigid else invert_poses(camera2rig).numpy()
    fit = RigFit(_placed(rig, rec, rows, sensors), rigid, free_px, rig_px)
    log.info("rig: %s", said(fit))
    if rigid:
        return replace(_record(rec, model), rig=fit, warnings=(*rec.warnings, *_miscalibrated(rig, fit)))
    return replace(rec, rig=fit, warnings=(*rec.warnings, _not_rigid(rows, fit)))


def said(fit: RigFit) -> str:
    """A rig in a line: cameras, reprojection errors, and the baselines in the unit of the reconstruction."""
    first, *others = fit.cameras
    where = ", ".join(
        f"{camera.name} {camera.baseline:.5g} \u00b1 {100 * camera.baseline_std:.2g}% from {first.name}"
        for camera in others
    )
    kind = "rigid" if fit.rigid else "not rigid"
    return f"{kind}, {where}; {fit.rig_px:.3f} px with one pose per instant, {fit.free_px:.3f} px with one per frame"


def _on_rig(rec: Reconstruction, rows: RigRows, camera2rig: Float[Tensor, "s 4 4"]) -> Reconstruction:
    """The reconstruction with every frame where its instant's best pose of the rig puts it."""
    own_rig = rec.cameras.cam2world @ invert_poses(camera2rig)[rows.camera]  # rig2world by each frame alone
    frames = len(rows.time)
    best = np.full(frames, -1)
    least = np.full(frames, np.inf)
    for guess in range(len(rec.names)):
        mates = np.flatnonzero(rows.instant == rows.instant[guess])
        poses = own_rig[guess] @ camera2rig[rows.camera[mates]]
        error = float(_errors(_moved(rec, mates, poses), mates).clamp(max=_MAX_ERROR).mean())
        if error < least[rows.instant[guess]]:
            best[rows.instant[guess]], least[rows.instant[guess]] = guess, error
    return _moved(rec, np.arange(len(rec.names)), own_rig[best[rows.instant]] @ camera2rig[rows.camera])


def _layout(rec: Reconstruction, rows: RigRows, camera2rig: Float[Tensor, "s 4 4"]) -> RigLayout:
    """Sensors and frames of the reconstruction `_on_rig`."""
    placed = _on_rig(rec, rows, camera2rig).cameras.cam2world
    rig2world = placed @ invert_poses(camera2rig)[rows.camera]
    _, first = np.unique(rows.instant, return_index=True)
    world2rig = invert_poses(rig2world[first])
    return RigLayout(rows.camera, rows.instant, invert_poses(camera2rig).numpy(), world2rig.numpy())


def _moved(rec: Reconstruction, rows: np.ndarray, poses: Float[Tensor, "n 4 4"]) -> Reconstruction:
    cam2world = rec.cameras.cam2world.clone()
    cam2world[rows] = poses
    return replace(rec, cameras=replace(rec.cameras, cam2world=cam2world))


def _errors(rec: Reconstruction, rows: np.ndarray | None = None) -> Float[Tensor, " n"]:
    """Reprojection errors of the observations in some frames in pixels; infinite behind a camera."""
    found = [torch.zeros(0, dtype=torch.float64)]
    for row in range(len(rec.names)) if rows is None else rows.tolist():
        seen = rec.tracks.frame == row
        xy, z = project(rec.cameras[row], rec.points.xyz[rec.tracks.point[seen]][None].double())
        error = torch.linalg.vector_norm(xy[0] - rec.tracks.xy[seen].double(), dim=1)
        found.append(torch.where(z[0] > 0, error, torch.inf))
    return torch.cat(found)


def _adjusted(model: "pycolmap.Reconstruction", width: float, *, lens: bool = False) -> "pycolmap.Reconstruction":
    """A copy of a model after bundle adjustment of rig, poses and points, and of each camera's lens where asked.

    The robust loss is quadratic up to errors of `width` pixels.
    """
    import pycolmap

    out = pycolmap.Reconstruction(model)
    options = robust_adjustment(width)
    options.refine_focal_length = options.refine_extra_params = lens
    options.refine_sensor_from_rig = True
    options.ceres.solver_options.num_threads = THREADS
    options.ceres.solver_options.function_tolerance = STILL
    images = pycolmap.BundleAdjustmentConfig()  # `pycolmap.bundle_adjustment` is the same, and prints
    for image_id in out.reg_image_ids():
        images.add_image(image_id)
    images.fix_gauge(pycolmap.BundleAdjustmentGauge.TWO_CAMS_FROM_WORLD)
    pycolmap.create_default_bundle_adjuster(options, images, out).solve()
    out.update_point_3d_errors()
    return out


def _lenses_differ(rec: Reconstruction) -> bool:
    K, distortion = rec.cameras.K, rec.cameras.distortion
    return not (torch.equal(K, K[:1].expand_as(K)) and torch.equal(distortion, distortion[:1].expand_as(distortion)))


def _settled(model: "pycolmap.Reconstruction", settings: ColmapSettings, *, parted: bool) -> "pycolmap.Reconstruction":
    """The model without its outliers, adjusted again, each camera's lens by itself where that fits better.

    `parted`: the lenses differ by their calibration, and are refined by themselves in any case.
    """
    import pycolmap

    pycolmap.ObservationManager(model).filter_all_points3D(_MAX_ERROR, _MIN_ANGLE)
    width = typical_error(model)
    model = _adjusted(model, width)
    if settings.intrinsics == "fixed":
        return model
    own = _adjusted(model, width, lens=True)
    gain = 1 - own.compute_mean_reprojection_error() / model.compute_mean_reprojection_error()
    lenses = all(is_lens(camera) for camera in own.cameras.values())
    return own if lenses and (parted or gain >= settings.mapping.opencv_gain) else model


def _record(rec: Reconstruction, model: "pycolmap.Reconstruction") -> Reconstruction:
    """The reconstruction with the cameras, points and tracks of a model made from it."""
    kept = torch.tensor([i - 1 for i in sorted(model.point3D_ids())])
    table = from_pycolmap(model)
    points = Points(torch.from_numpy(table.xyz), rec.points.rgb[kept], torch.from_numpy(table.error))
    tracks = Tracks(*(torch.from_numpy(a) for a in (table.track_point, table.track_frame, table.track_xy)))
    return replace(rec, cameras=cameras_of(table), points=points, tracks=tracks)


def _placed(
    rig: Rig, rec: Reconstruction, rows: RigRows, sensors: Float[np.ndarray, "s 4 4"]
) -> tuple[PlacedCamera, ...]:
    """The cameras with their poses, and how the baselines of single instants scatter in the poses of before."""
    out = []
    for k, (camera, pose) in enumerate(zip(rig.cameras, sensors, strict=True)):
        single = relative_to_first(rec.cameras.cam2world, rows, k)
        lengths = torch.linalg.vector_norm(single[:, :3, 3], dim=1).numpy()
        std = relative_scatter(lengths) if k else 0.0
        baseline = float(np.linalg.norm(pose[:3, 3]))
        placed = PlacedCamera(camera.name, pose_of(pose), len(single), baseline, std, camera.baseline if k else None)
        delay = delay_of(rec.cameras.cam2world, rows, k) if k else None
        out.append(placed if delay is None else replace(placed, delay=delay.seconds, delay_std=delay.std))
    return tuple(out)


def _not_rigid(rows: RigRows, fit: RigFit) -> QualityWarning:
    step = float(np.median(np.diff(rows.time)))
    late = [
        f"{camera.name} seems to be later by {camera.delay / step:.2f} \u00b1 {camera.delay_std / step:.2f} of the time"
        " between two images"
        for camera in fit.cameras
        if camera.delay is not None and camera.delay_std is not None and abs(camera.delay) > 3 * camera.delay_std
    ]
    why = f": {', '.join(late)}" if late else ""
    return QualityWarning(
        f"The cameras of the rig were not at one place of it at each instant{why}. Reprojection errors are"
        f" {fit.rig_px:.2f} px with one pose per instant, {fit.free_px:.2f} px with one per frame. Poses are as without"
        " a rig, and no baseline gives their scale.",
        "The images are not synchronized, or pairs are off by some: pair them by time (--rig-pairs time), or shift one"
        " of the two; a rig that bends is none (--rig none).",
    )


def _miscalibrated(rig: Rig, fit: RigFit) -> list[QualityWarning]:
    """Doubts where the images turn a camera, or its place, another way than the calibration of the rig."""
    found = []
    for camera, placed in zip(rig.cameras[1:], fit.cameras[1:], strict=True):
        if camera.camera_from_rig is None:
            continue
        known, seen = np.array(camera.camera_from_rig), np.array(placed.camera_from_rig)
        turn = rotation_angle(torch.from_numpy(seen[:3, :3] @ known[:3, :3].T)).item()
        centers = [-pose[:3, :3].T @ pose[:3, 3] for pose in (known, seen)]
        cosine = float(centers[0] @ centers[1] / np.linalg.norm(centers[0]) / np.linalg.norm(centers[1]))
        away = float(np.arccos(np.clip(cosine, -1, 1)))
        if max(turn, away) > _CALIBRATED:
            found.append(
                QualityWarning(
                    f"The calibration of the rig does not fit the images: {camera.name} is turned by"
                    f" {np.degrees(turn):.1f} degrees, and its place seen from {rig.names[0]} by"
                    f" {np.degrees(away):.1f} degrees. The rig is as the images show it, its scale by the calibration.",
                    "Check the order of the cameras under --rig, and whether the calibration was made in water.",
                )
            )
    return found
