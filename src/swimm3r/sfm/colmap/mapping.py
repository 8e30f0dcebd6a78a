"""From verified matches to poses and points under a lens that is held (`calibration` says which).

A short ladder of focal lengths is mapped until all frames are placed; then frames left over are tried again with looser
limits, and frames that stand against their matches are placed anew. Flat or small hazy scenes allow more than one
motion, and a mapper that begins with the wrong one ends with every frame in place, many of them tens of degrees off, or
with the whole scene squeezed in depth. So clips that leave a doubt are placed twice, frame by frame and all at once,
and what explains more observations is kept.
Long clips are placed in chunks (`chunks.long_clip`).
"""

import tempfile
import threading
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

from swimm3r.progress import Progress
from swimm3r.sfm.colmap.calibration.adjust import SEED, STILL, THREADS
from swimm3r.sfm.colmap.calibration.refinement import adjust_lens
from swimm3r.sfm.colmap.calibration.start import lenses_of_pairs, lenses_to_try, set_camera
from swimm3r.sfm.colmap.epipolar_outliers import contradicting_frames
from swimm3r.sfm.colmap.resection_outliers import misplaced_frames
from swimm3r.sfm.features.database import MIN_INLIERS, FeatureDatabase, flat_share
from swimm3r.sfm.settings import ColmapSettings

if TYPE_CHECKING:
    import pycolmap

_CLEARLY = 1.1
_ROUGH = 0.0025  # of an image's width: a mean reprojection error beyond that of most lenses that are yet to be refined
_FLAT = 0.25  # share of pairs that see a plane, from which the lens and the motion of a pair are ambiguous
_MAX_ERROR = 4.0  # pixels, where COLMAP drops observations
_ROUNDS = 3
_LOOSE_INLIERS, _LOOSE_SHARE = 15, 0.15  # to place a frame that COLMAP's 30 and 0.25 left over


def map_frames(store: FeatureDatabase, settings: ColmapSettings, progress: Progress) -> list["pycolmap.Reconstruction"]:
    """The models found, the best one first, its frames where they explain most; empty where no two could be joined."""
    method = settings.mapping.method
    if method == "global":
        return _checked(store, _place_at_once(store, settings, progress), settings, progress).models
    lenses = lenses_to_try(store, settings)
    one_by_one = _checked(store, _try_focal_lengths(store, lenses, settings, progress), settings, progress)
    if method == "incremental" or not one_by_one.models or not _leaves_doubt(store, one_by_one, settings):
        return one_by_one.models
    at_once = _checked(store, _map_globally(store, settings, progress), settings, progress).models
    if _is_thin(at_once, settings):
        return one_by_one.models  # GLOMAP gives every frame a pose, however little it sees (dolphin_dynamic: 61 points)
    return max(one_by_one.models, at_once, key=_explained)


def _place_at_once(
    store: FeatureDatabase, settings: ColmapSettings, progress: Progress
) -> "list[pycolmap.Reconstruction]":
    """Models of all frames at once under the lens that their pairs agree on, adjusted once the frames are in place.

    Under a lens that is far off, frames bend the scene, stand against their own pairs and would be taken out for it.
    """
    set_camera(store, lenses_of_pairs(store, settings)[0])
    models = _map_globally(store, settings, progress)
    return [adjust_lens(store, model, settings, progress) for model in models[:1]] + models[1:]


@dataclass(frozen=True)
class _Checked:
    """Models whose largest one was checked for misplaced frames."""

    models: "list[pycolmap.Reconstruction]"
    clean: bool  # no frame of the largest one stands against the others


def _checked(
    store: FeatureDatabase, models: "list[pycolmap.Reconstruction]", settings: ColmapSettings, progress: Progress
) -> _Checked:
    """Models with the misplaced frames of the largest one placed again."""
    if not models:
        return _Checked([], clean=False)
    model, clean = _replaced(store, models[0], settings, progress)
    return _Checked([model, *models[1:]], clean)


def _leaves_doubt(store: FeatureDatabase, checked: _Checked, settings: ColmapSettings) -> bool:
    """Return whether another mapper may do better: frames left over or misplaced, few points, large errors, or ground
    so flat that two frames allow two motions while the lens is open, too.
    """
    model = checked.models[0]
    if not checked.clean or model.num_reg_images() < store.frames or _is_thin(checked.models, settings):
        return True
    if model.compute_mean_reprojection_error() > _ROUGH * model.cameras[1].width:
        return True
    return settings.intrinsics != "fixed" and flat_share(store) > _FLAT


def _is_thin(models: "list[pycolmap.Reconstruction]", settings: ColmapSettings) -> bool:
    return not models or models[0].compute_mean_observations_per_reg_image() < settings.mapping.thin_points


def _try_focal_lengths(
    store: FeatureDatabase, lenses: list["pycolmap.Camera"], settings: ColmapSettings, progress: Progress
) -> list["pycolmap.Reconstruction"]:
    """The models under the best of some lenses, which is left in the database."""
    best: list[pycolmap.Reconstruction] = []
    for k, lens in enumerate(lenses):
        set_camera(store, lens)
        what = "placing frames" if k == 0 else f"placing frames, lens {k + 1} of {len(lenses)}"
        models = _map_in_turn(store, settings, what, progress)
        frames, score = _quality(models)
        best_frames, best_score = _quality(best)
        # earlier ones are likelier lenses: a later one must place more frames, or explain clearly more
        if frames > best_frames or (frames == best_frames and score > _CLEARLY * best_score):
            best = models
        if best and best[0].num_reg_images() >= settings.mapping.enough * store.frames:
            break
    if best:
        set_camera(store, best[0].cameras[1])
    return best


def place_leftovers(
    store: FeatureDatabase, model: "pycolmap.Reconstruction", settings: ColmapSettings, progress: Progress
) -> "pycolmap.Reconstruction":
    """The model with those of its missing frames that looser limits can place; the lens is held."""
    set_camera(store, model.cameras[1])
    with tempfile.TemporaryDirectory(dir=store.path.parent, prefix=".mapping.") as folder:
        model.write_binary(folder)
        what, missing = "placing the frames left over", store.frames - model.num_reg_images()
        models = _map_in_turn(store, settings, what, progress, goes_on_from=Path(folder), total=missing)
    return max([model, *models], key=lambda m: _quality([m]))


def replace_misplaced(
    store: FeatureDatabase, model: "pycolmap.Reconstruction", settings: ColmapSettings, progress: Progress
) -> "pycolmap.Reconstruction":
    """The model with frames that stood in the wrong place taken out and placed again, where that explains more.

    First those that contradict their pairs, which may be a whole part of the clip; then single ones, by resection.
    """
    return _replaced(store, model, settings, progress)[0]


def _replaced(
    store: FeatureDatabase, model: "pycolmap.Reconstruction", settings: ColmapSettings, progress: Progress
) -> "tuple[pycolmap.Reconstruction, bool]":
    """`replace_misplaced`, and whether no frame is left that stands against the others."""
    import pycolmap

    clean = True
    for ask in (contradicting_frames, misplaced_frames):
        misplaced = ask(store, model)
        for _ in range(_ROUNDS):
            if not misplaced:
                break
            rest = pycolmap.Reconstruction(model)
            for image_id in misplaced:
                rest.deregister_frame(rest.images[image_id].frame_id)
            again = place_leftovers(store, rest, settings, progress)
            if _quality([again]) <= _quality([model]):
                break
            model = again
            misplaced = ask(store, model)
        clean = clean and not misplaced
    return model, clean


def _quality(models: "list[pycolmap.Reconstruction]") -> tuple[int, float]:
    """Of the best of some models: how many frames it holds, and how much it explains."""
    return (models[0].num_reg_images(), _explained(models)) if models else (0, 0.0)


def _explained(models: "list[pycolmap.Reconstruction]") -> float:
    """Observations that agree with the best of some models, each worth less the more it misses (MSAC)."""
    if not models:
        return 0.0
    error = models[0].compute_mean_reprojection_error() / _MAX_ERROR
    return models[0].compute_num_observations() * (1 - error * error)


def _map_in_turn(
    store: FeatureDatabase,
    settings: ColmapSettings,
    what: str,
    progress: Progress,
    *,
    goes_on_from: Path | None = None,
    total: int | None = None,
) -> "list[pycolmap.Reconstruction]":
    """The models found. Progress counts to `total`, by default all frames, and ends there though some stay out."""
    import pycolmap

    options = pycolmap.IncrementalPipelineOptions()
    options.extract_colors = False
    options.num_threads = THREADS
    options.random_seed = SEED
    options.min_model_size = 2
    most = total or store.frames
    options.min_num_matches = MIN_INLIERS
    options.triangulation.ignore_two_view_tracks = not _counts_points_of_two(store, settings)
    options.ba_refine_focal_length = options.ba_refine_extra_params = False
    options.ba_global_function_tolerance = STILL
    options.mapper.abs_pose_refine_focal_length = options.mapper.abs_pose_refine_extra_params = False
    if goes_on_from is not None:
        options.multiple_models = False
        options.mapper.abs_pose_min_num_inliers = _LOOSE_INLIERS
        options.mapper.abs_pose_min_inlier_ratio = _LOOSE_SHARE
    placed = 0

    def count(step: int) -> Callable[[], None]:
        def tell() -> None:
            nonlocal placed
            placed = min(placed + step, most)
            progress(what, placed, most)

        return tell

    with tempfile.TemporaryDirectory(dir=store.path.parent, prefix=".mapping.") as folder:
        models = pycolmap.incremental_mapping(
            str(store.path),
            str(store.path.parent),
            folder,
            options,
            input_path=str(goes_on_from or ""),
            initial_image_pair_callback=count(2),
            next_image_callback=count(1),
        )
    progress(what, most, most)
    return sorted(models.values(), key=lambda m: _quality([m]), reverse=True)


def _counts_points_of_two(store: FeatureDatabase, settings: ColmapSettings) -> bool:
    """Return whether points that two frames alone see count: where frames overlap little, under a lens that is known.

    While it is open they follow any: ruie_murky's frames all fit one of more than twice the focal length.
    """
    return settings.intrinsics == "fixed" and store.little_overlap


def _map_globally(
    store: FeatureDatabase, settings: ColmapSettings, progress: Progress
) -> "list[pycolmap.Reconstruction]":
    import pycolmap

    options = pycolmap.GlobalPipelineOptions()
    options.num_threads = THREADS
    options.random_seed = SEED
    options.min_num_matches = MIN_INLIERS
    options.mapper.retriangulation.ignore_two_view_tracks = not _counts_points_of_two(store, settings)
    options.mapper.bundle_adjustment.refine_focal_length = False
    options.mapper.bundle_adjustment.refine_extra_params = False
    models: list[pycolmap.Reconstruction] = []
    failures: list[Exception] = []

    def work() -> None:
        try:
            found = pycolmap.global_mapping(str(store.path), str(store.path.parent), folder, options)
            models.extend(found.values())
        except Exception as failure:  # noqa: BLE001 - raised again by the caller's thread
            failures.append(failure)

    with tempfile.TemporaryDirectory(dir=store.path.parent, prefix=".mapping.") as folder:
        # it has no callback: beside it, this thread can still be interrupted
        worker = threading.Thread(target=work, daemon=True)
        worker.start()
        while worker.is_alive():
            progress("placing all frames at once", 0, store.frames)
            worker.join(0.5)
    if failures:
        raise failures[0]
    progress("placing all frames at once", store.frames, store.frames)
    return sorted(models, key=lambda m: _quality([m]), reverse=True)
