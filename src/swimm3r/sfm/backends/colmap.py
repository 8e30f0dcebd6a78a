"""Structure from motion without weights: COLMAP poses -> plane-sweep depth -> Sea-Thru water -> restored cloud.

Moving objects, which depth makes known, are masked before the water. Where they hold a notable share of the
observations, poses and depth are found anew without them.
"""

from pathlib import Path

from swimm3r.memory import return_freed
from swimm3r.progress import Progress, silent
from swimm3r.scene.frames import MASKS, Frames
from swimm3r.scene.gravity import with_measured_up
from swimm3r.scene.placement import Navigator
from swimm3r.scene.reconstruction import Reconstruction
from swimm3r.scene.reconstruction_io import load_reconstruction
from swimm3r.sfm.colmap import poses
from swimm3r.sfm.colmap.adjustment import bundle_adjust
from swimm3r.sfm.colmap.rig.adjustment import as_rig
from swimm3r.sfm.lens import check_calibration
from swimm3r.sfm.medium.apply import with_water
from swimm3r.sfm.moving.find import mask_depth, with_moving, without_moving_observations
from swimm3r.sfm.plane_sweep.estimate import estimate_depth
from swimm3r.sfm.rig_poses import with_loose_rig
from swimm3r.sfm.settings import ColmapSettings
from swimm3r.tasks.settings import EngineSettings

_NOTABLE = 0.02  # share of the observations on moving objects from which they pull on the poses


def check_files(settings: ColmapSettings) -> None:
    """Raise InputError or UsageError where the calibration file cannot be used."""
    check_calibration(settings)


def reconstruct(
    frames: Frames,
    settings: ColmapSettings,
    folder: Path,
    progress: Progress = silent,
    engine: EngineSettings = EngineSettings(),  # noqa: B008 - records are frozen
    navigator: Navigator | None = None,
) -> Reconstruction:
    """Poses first, and saved at once: what comes after reads them from there when an interrupted run goes on."""
    if not (folder / "reconstruction.json").is_file():
        rec = poses.reconstruct(frames, settings, folder, progress, engine=engine, navigator=navigator)
        if frames.rig is not None:
            under_port = settings.housing != "none"
            rec = with_loose_rig(rec) if under_port else as_rig(rec, frames, settings, progress)
        with_measured_up(rec, frames).save(folder, frames)
    rec = load_reconstruction(folder, frames)  # also where it was just made: the same bits as after an interruption
    return_freed()
    estimate_depth(rec, frames, settings.depth, progress, engine)
    if settings.moving == "auto":
        rec = with_moving(rec, frames, folder / MASKS, progress)
        if rec.rig is None and navigator is None and settings.housing == "none":  # which hold poses in their own ways
            rec = _of_still_scene(rec, frames, settings, folder, progress, engine)
    return_freed()
    rec = with_water(rec, frames, settings, folder, progress)
    rec.save(folder, frames)
    return rec


def _of_still_scene(
    rec: Reconstruction,
    frames: Frames,
    settings: ColmapSettings,
    folder: Path,
    progress: Progress,
    engine: EngineSettings,
) -> Reconstruction:
    """The reconstruction adjusted and with new depth without moving objects, if these have a share in its poses."""
    still = without_moving_observations(rec, frames)
    dropped = len(rec.tracks.point) - len(still.tracks.point)
    if dropped <= _NOTABLE * len(rec.tracks.point):
        return rec
    still = bundle_adjust(still)
    still.save(folder, frames)  # tasks and interrupted runs go on from there
    estimate_depth(still, frames, settings.depth, progress, engine)
    mask_depth(still, frames)
    return still
