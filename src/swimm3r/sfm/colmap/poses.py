"""Poses and sparse points without weights: SIFT, verified matches, incremental or global mapping, one lens per clip.

`database.db` in the working folder keeps features and matches, so a killed run goes on from it; seeds are fixed, so it
ends where an undisturbed one does. Poses are free in scale and place: nothing here is metric.
"""

import logging
import shutil
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING

from swimm3r.cameras import Cameras, resized
from swimm3r.errors import InputError, UsageError
from swimm3r.imaging.rectification import rectification_of
from swimm3r.io.colmap.cameras import to_pycolmap_camera
from swimm3r.io.colmap.model import silence_log
from swimm3r.io.files.atomic import atomic_path
from swimm3r.progress import Progress, silent
from swimm3r.refraction.central import CameraInWater
from swimm3r.scene.frames import Frames
from swimm3r.scene.placement import Navigator
from swimm3r.scene.reconstruction import (
    QualityWarning,
    Reconstruction,
)
from swimm3r.sfm.colmap import mapping
from swimm3r.sfm.colmap.adjustment import adjust_through_port
from swimm3r.sfm.colmap.calibration.polynomial import bent_lens
from swimm3r.sfm.colmap.calibration.refinement import Calibrated, adjust_lens, adjust_poses, refine, refine_again
from swimm3r.sfm.colmap.calibration.start import first_camera
from swimm3r.sfm.colmap.chunks.long_clip import is_long, map_long_clip
from swimm3r.sfm.colmap.chunks.parts import coherent_models
from swimm3r.sfm.colmap.keypoint_adjustment import adjust_keypoints
from swimm3r.sfm.colmap.messages import (
    LOST_SCALE,
    assumed_lens,
    lens_not_told,
    registration_warnings,
    scale_lost,
    too_few,
    unknown_port,
)
from swimm3r.sfm.colmap.navigated import with_navigation
from swimm3r.sfm.colmap.pairs import check_pairs, match_frames
from swimm3r.sfm.colmap.plausibility import depth_change, implausible
from swimm3r.sfm.colmap.record import PARTS, record_of, write_parts
from swimm3r.sfm.colmap.rig.lenses import RigLenses, lenses_of_rig
from swimm3r.sfm.colmap.shutter.readout import adjust_rolling
from swimm3r.sfm.colmap.shutter.turning import turned_rows
from swimm3r.sfm.features.database import (
    FeatureDatabase,
    fill_features,
    full_disk_said_plainly,
    match_pairs,
    remove_database,
    start_database,
    with_overlap,
)
from swimm3r.sfm.lens import at_scale, behind_port, gives_lens, with_calibration
from swimm3r.sfm.rectified.frames import BentImagesError, TurnedRowsError
from swimm3r.sfm.settings import ColmapSettings
from swimm3r.tasks.settings import EngineSettings
from swimm3r.tasks.threads import thread_count

if TYPE_CHECKING:
    import pycolmap

log = logging.getLogger(__name__)


@dataclass(frozen=True)
class _Mapped:
    """The model that is used, those that did not join it, and warnings."""

    model: "pycolmap.Reconstruction"
    others: "list[pycolmap.Reconstruction]"  # some of their frames may be in larger ones, too
    lens_refined: bool  # from the images; else assumed, or held for the user
    distortion_refined: bool  # as well
    warnings: list[QualityWarning]


@dataclass(frozen=True)
class _Known:
    """Settings with the numbers of the clip's lens, the camera that mapping begins with, and its port or rig."""

    settings: ColmapSettings
    camera: "pycolmap.Camera"
    housed: CameraInWater | None  # behind a port that is known
    lenses: RigLenses | None  # of a calibrated rig whose lenses differ

    def told_by_frames(self, mapped: _Mapped) -> bool:
        """Return whether the lens is the one that the frames tell."""
        return mapped.lens_refined and self.settings.intrinsics != "fixed"


def reconstruct(
    frames: Frames,
    settings: ColmapSettings,
    folder: Path,
    progress: Progress = silent,
    lens: Cameras | None = None,
    engine: EngineSettings = EngineSettings(),  # noqa: B008 - records are frozen
    navigator: Navigator | None = None,
) -> Reconstruction:
    """Cameras, points, tracks and matches of the frames that can be placed; depth maps are for others to fill.

    `lens` (one camera, its pose unused) is held where it is given; else the settings say what is known of it, or the
    frames' source, which may know another one of each camera of a rig. A `navigator` joins what shares no ground, and
    holds long paths straight. Raises InputError for fewer than 2 frames or navigation that contradicts them,
    BentImagesError where no lens model explains the images, TurnedRowsError where their rows show that the camera
    turned, and RegistrationError where too few can be placed.
    """
    _check_input(frames, settings, navigator)
    silence_log()
    known, threads = _known(frames, settings, lens), settings.threads or thread_count()
    with full_disk_said_plainly(folder):
        numbers, shared = ((), None) if known.lenses is None else (known.lenses.numbers, known.lenses.under_first)
        store = start_database(folder, frames, known.camera, settings.features, numbers)
        fill_features(store, frames, settings.features, threads, progress, shared)
        pairs = match_frames(store, frames, known.settings, threads, progress)
        store = with_overlap(store)
        with _working_copy(store) as working:

            def recorded(model: "pycolmap.Reconstruction") -> Reconstruction:
                return record_of(model, working, frames, folder, known.lenses)

            mapped = _map(working, frames, pairs, known, progress, engine)
            if not frames.rows_rectified:
                _check_rectifiable(mapped, known, frames, recorded, progress)
            if navigator is not None:
                mapped = _navigated(mapped, working, frames, navigator, recorded, progress)
            _check_placed(mapped.model, frames, known.settings)
            rec, warnings = _adjusted(recorded(mapped.model), mapped, known, frames, progress)
            parts = write_parts(mapped.model, mapped.others, working, frames, folder / PARTS, known.lenses)
            if depth_change(rec) > LOST_SCALE:
                raise scale_lost(len(rec.names), len(frames))
            found = implausible(rec, working, frames)
    registered = registration_warnings(len(rec.names), [mapped.model.num_reg_images(), *parts], frames)
    return replace(rec, warnings=(*found, *mapped.warnings, *registered, *warnings))


def _check_input(frames: Frames, settings: ColmapSettings, navigator: Navigator | None) -> None:
    """Raise InputError for fewer than 2 frames, and UsageError for settings that its frames do not allow."""
    if len(frames) < 2:
        raise InputError(
            f"structure from motion needs at least 2 frames, got {len(frames)}",
            cause="the clip is too short or the sampling too coarse",
            hint="a longer clip or a higher --fps",
        )
    other = "a rig's cameras" if frames.rig is not None else "--nav" if navigator is not None else None
    if settings.shutter == "rolling" and other is not None:
        raise UsageError(
            f"--shutter rolling and {other} exclude each other",
            cause="the adjustment with rows exposed one after another knows a single camera and its images alone",
            hint="leave out one of them",
        )
    check_pairs(frames, settings)


def _known(frames: Frames, settings: ColmapSettings, lens: Cameras | None) -> _Known:
    """The lens to hold where one is given, else as the settings or the frames' source tell."""
    if lens is not None:
        camera = to_pycolmap_camera(lens)
        camera.has_prior_focal_length = True
        return _Known(replace(settings, intrinsics="fixed"), camera, None, None)
    own = with_calibration(settings, frames.width, frames.height, frames.calibration)
    own, housed = behind_port(own, frames.width, frames.height)
    camera = first_camera(frames.width, frames.height, own)
    return _Known(own, camera, housed, lenses_of_rig(frames, settings, camera))


def _check_rectifiable(
    mapped: _Mapped,
    known: _Known,
    frames: Frames,
    recorded: "Callable[[pycolmap.Reconstruction], Reconstruction]",
    progress: Progress,
) -> None:
    """Raise a RectifiableError where a lens beyond models, or turns of the camera within frames, explain the images."""
    settings = known.settings
    given = settings.intrinsics == "fixed" or settings.housing != "none" or gives_lens(settings)
    if settings.rectify == "auto" and settings.camera == "auto" and not given and known.lenses is None:
        _check_lens(mapped.model, frames, progress)
    alone = known.housed is None and frames.rig is None
    if settings.shutter == "auto" and alone and known.told_by_frames(mapped):  # turns would take up a wrong lens
        progress("rows of the frames", 0, 1)
        turns = turned_rows(recorded(mapped.model))
        progress("rows of the frames", 1, 1)
        if turns is not None:
            raise TurnedRowsError(turns)


def _adjusted(
    rec: Reconstruction, mapped: _Mapped, known: _Known, frames: Frames, progress: Progress
) -> tuple[Reconstruction, list[QualityWarning]]:
    """The reconstruction with rows exposed along its path, and behind its port; and warnings of what is not known."""
    settings, warnings = known.settings, []
    if settings.housing == "flat" and known.housed is None:
        warnings.append(unknown_port())
    if settings.shutter == "rolling":
        times = frames.times_of(rec.names)
        rolled = adjust_rolling(rec, times, settings.readout, lens=known.told_by_frames(mapped), progress=progress)
        rec = rolled.reconstruction
        if rolled.warning is not None:
            warnings.append(rolled.warning)
    if known.housed is not None:
        free = settings.intrinsics != "fixed"
        rec = adjust_through_port(rec, known.housed, settings.port.range, lens=free, progress=progress)
    return rec, warnings


def _check_lens(model: "pycolmap.Reconstruction", frames: Frames, progress: Progress) -> None:
    """Raise BentImagesError where a polynomial explains the images, and no lens of COLMAP's does."""
    lens = bent_lens(model, progress)
    if lens is None:
        return
    try:
        rectification = rectification_of(resized(lens, frames.width, frames.height))
    except ValueError as error:
        log.info("the polynomial is no lens, and the one that there is stays: %s", error)
        return
    raise BentImagesError(rectification)


@contextmanager
def _working_copy(store: FeatureDatabase) -> Iterator[FeatureDatabase]:
    """A copy for mapping, which writes lenses and matches of frames left over: the database holds what all runs agree
    on.
    """
    for leftover in store.path.parent.glob(".mapping.*"):  # of a killed run
        shutil.rmtree(leftover)
    working = replace(store, path=store.path.with_name("mapping.db"))
    remove_database(working.path)
    try:
        with atomic_path(working.path) as draft:
            shutil.copyfile(store.path, draft)
        yield working
    finally:
        remove_database(working.path)


def _map(
    store: FeatureDatabase,
    frames: Frames,
    pairs: list[tuple[int, int]],
    known: _Known,
    progress: Progress,
    engine: EngineSettings,
) -> _Mapped:
    """The largest model, its keypoints aligned and its lens refined.

    Raises RegistrationError where no two frames can be placed.
    """
    settings = at_scale(known.settings, frames.width, frames.height, store.scale)
    n, threads, long = len(frames), settings.threads or thread_count(), is_long(len(frames), settings.mapping)
    models, determined = _models(store, frames, settings, progress, engine)
    if not models:
        untold = store.little_overlap and settings.intrinsics != "fixed"
        raise lens_not_told(frames) if untold else too_few(0, frames, known.settings)
    model, *cut_off = coherent_models(models[0])
    # points of two frames hold the poses of those that overlap little, under the lens that the others determined
    further = replace(settings, intrinsics="fixed") if store.little_overlap else settings
    if model.num_reg_images() < n:
        placed = {i - 1 for i in model.reg_image_ids()}
        again = [(i, j) for i, j in pairs if i not in placed or j not in placed]
        looser = replace(settings.features, max_ratio=settings.mapping.retry_ratio)
        match_pairs(store, again, looser, threads, progress, again=True)
        if not long:
            model = refine(store, model, further, progress).model  # a better lens places more
        more = mapping.place_leftovers(store, model, further, progress)
        more = mapping.replace_misplaced(store, more, further, progress)
        more, *again_cut_off = coherent_models(more)
        if more.num_reg_images() >= model.num_reg_images():
            model, cut_off = more, [*cut_off, *again_cut_off]
    if long:
        calibrated = Calibrated(model, refined=determined, distortion=determined)
    else:
        calibrated = refine(store, model, further, progress)
    if settings.mapping.align_keypoints:
        model = adjust_keypoints(store, calibrated.model, frames, threads, progress, known.lenses)
        calibrated = replace(calibrated, model=model)
        if not long:
            calibrated = refine_again(store, calibrated, progress)
        elif determined and not store.little_overlap:
            calibrated = replace(calibrated, model=adjust_lens(store, model, settings, progress, is_large=True))
        else:
            calibrated = replace(calibrated, model=adjust_poses(store, model))
    model, refined = calibrated.model, calibrated.refined or determined
    assumed = not refined and settings.intrinsics != "fixed"
    warnings = [assumed_lens(model.cameras[1].focal_length_x / store.scale)] if assumed else []
    return _Mapped(model, [*models[1:], *cut_off], refined, calibrated.distortion, warnings)


def _models(
    store: FeatureDatabase, frames: Frames, settings: ColmapSettings, progress: Progress, engine: EngineSettings
) -> "tuple[list[pycolmap.Reconstruction], bool]":
    """The models found, the largest first, and whether the images have determined the lens that they are under."""
    if is_long(len(frames), settings.mapping):
        in_chunks = map_long_clip(store, settings, ordered=frames.ordered, progress=progress, engine=engine)
        return in_chunks.models, in_chunks.lens_determined
    models = mapping.map_frames(store, settings, progress)
    if not models or not store.little_overlap:
        return models, False
    first = refine(store, models[0], settings, progress)
    return [first.model, *models[1:]], first.refined


def _navigated(
    mapped: _Mapped,
    store: FeatureDatabase,
    frames: Frames,
    navigator: Navigator,
    recorded: "Callable[[pycolmap.Reconstruction], Reconstruction]",
    progress: Progress,
) -> _Mapped:
    is_open = mapped.lens_refined and not store.little_overlap
    found = with_navigation(
        store,
        mapped.model,
        mapped.others,
        frames,
        navigator,
        recorded,
        progress,
        focal=is_open,
        distortion=is_open and mapped.distortion_refined,
    )
    return replace(mapped, model=found.model, others=found.others, warnings=[*mapped.warnings, *found.warnings])


def _check_placed(model: "pycolmap.Reconstruction", frames: Frames, settings: ColmapSettings) -> None:
    """Raise RegistrationError where a model holds too small a share of the frames."""
    placed = model.num_reg_images()
    thin = model.compute_mean_observations_per_reg_image() < settings.mapping.thin_points
    share = settings.mapping.thin_share if thin else settings.mapping.min_share
    if placed < max(min(settings.mapping.min_frames, len(frames)), share * len(frames)):
        raise too_few(placed, frames, settings)
