"""From verified matches to cameras and points, when nobody knows the lens.

On small hazy pictures a self-calibrating mapper drifts to any focal length and then loses frames. So the lens is held
first: a short ladder of focal lengths is mapped until all frames are placed; then frames left over are tried again with
looser limits; only then, with every frame in place, are the intrinsics refined, and what comes out is kept only if it
is a lens. OPENCV's further parameters must earn their keep by a clearly lower reprojection error.
"""

import tempfile
import threading
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
import torch

from swimm3r.cameras import DISTORTION_PARAMETERS, distort
from swimm3r.errors import UsageError
from swimm3r.progress import Progress
from swimm3r.sfm.feature_database import MIN_INLIERS, FeatureDatabase
from swimm3r.sfm.pair_agreement import contradicting_frames
from swimm3r.sfm.resection import misplaced_frames
from swimm3r.sfm.settings import ColmapSettings

if TYPE_CHECKING:
    import pycolmap

WATER = 1.333  # refractive index; a flat port multiplies the focal length by it (to first order)
_SEED = 0
_THREADS = 1  # sums in a changing order end in poses 0.01 degrees apart, on weak clips more; a resumed run must not
_CLEARLY = 1.1
_GLOBAL_ENOUGH = 0.9  # share of the frames below which the incremental method has its turn, too
_MAX_ERROR = 4.0  # pixels, where COLMAP drops observations
_MAX_TANGENTIAL = 0.05  # a lens some 5 degrees askew behind its port; what short clips fit beyond bends their poses
_ROUNDS = 3
_PASSES, _STILL = 6, 0.99  # adjustments of the lens at most, and the share of the last error that ends them
_LOOSE_INLIERS, _LOOSE_SHARE = 15, 0.15  # to place a frame that COLMAP's 30 and 0.25 left over


@dataclass(frozen=True)
class Mapped:
    """The largest model, and how many frames each model holds, largest first."""

    model: "pycolmap.Reconstruction"
    sizes: tuple[int, ...]
    refined: bool  # intrinsics as refined; False where refinement gave no lens and the assumed ones stand


def first_camera(width: int, height: int, settings: ColmapSettings) -> "pycolmap.Camera":
    """The lens to begin with: what the user knows, else the first rung of the ladder.

    Raises UsageError where the settings contradict themselves.
    """
    name = _model_name(settings)
    known = {k for k in ("k1", "k2", "k3", "k4", "p1", "p2") if getattr(settings, k) is not None}
    foreign = sorted(known - set(DISTORTION_PARAMETERS[name]))
    if foreign:
        raise UsageError(
            f"{name} has no {', '.join(foreign)}",
            cause=f"its parameters are {', '.join(DISTORTION_PARAMETERS[name])}",
            hint="choose the camera model that the numbers were calibrated with (--camera)",
        )
    if settings.focal is not None and not 0.1 * width < settings.focal < 20 * width:
        raise UsageError(
            f"a focal length of {settings.focal:g} px does not fit pictures {width} px wide",
            cause="it may be in millimetres, or belong to another picture size",
            hint="give it in pixels of the prepared frames: millimetres / sensor width in millimetres * picture width",
        )
    if settings.intrinsics == "fixed" and settings.focal is None:
        raise UsageError(
            "fixed intrinsics need a focal length",
            cause="--intrinsics fixed was given without --focal",
            hint="add --focal (and --k1), or leave --intrinsics at prior",
        )
    return _ladder(width, height, settings)[0]


def map_frames(
    store: FeatureDatabase, settings: ColmapSettings, method: str, progress: Progress
) -> list["pycolmap.Reconstruction"]:
    """The best models, largest first; empty where no two frames could be joined. `method`: incremental or global."""
    if method == "incremental":
        return _climb(store, settings, None, progress)
    # the global method averages relative poses, which are wrong under a wrong lens: find that on a part of the clip
    part = _climb(store, settings, _best_connected(store, settings.mapping.lens_frames), progress)
    if not part:
        return []
    set_camera(store, refine(store, part[0], settings, progress).model.cameras[1])
    models = _map_globally(store, settings, progress)
    if models and models[0].num_reg_images() >= _GLOBAL_ENOUGH * store.frames:
        return models
    return max(models, _map_in_turn(store, settings, "placing frames", progress), key=_merit)


def _climb(
    store: FeatureDatabase, settings: ColmapSettings, names: list[str] | None, progress: Progress
) -> list["pycolmap.Reconstruction"]:
    """The models of the ladder's best rung; the lens of that rung is left in the database."""
    with store.open() as database:
        camera = database.read_camera(1)
    best: list[pycolmap.Reconstruction] = []
    rungs = [camera] if settings.intrinsics == "fixed" else _ladder(camera.width, camera.height, settings)
    for k, rung in enumerate(rungs):
        set_camera(store, rung)
        what = "placing frames" if k == 0 else f"placing frames, lens {k + 1} of {len(rungs)}"
        models = _map_in_turn(store, settings, what, progress, names=names)
        frames, score = _merit(models)
        best_frames, best_score = _merit(best)
        # earlier rungs are likelier lenses: a later one must place more frames, or explain clearly more
        if frames > best_frames or (frames == best_frames and score > _CLEARLY * best_score):
            best = models
        total = store.frames if names is None else len(names)
        if best and best[0].num_reg_images() >= settings.mapping.enough * total:
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
        models = _map_in_turn(store, settings, "placing the frames left over", progress, goes_on_from=Path(folder))
    return max([model, *models], key=lambda m: _merit([m]))


def replace_misplaced(
    store: FeatureDatabase, model: "pycolmap.Reconstruction", settings: ColmapSettings, progress: Progress
) -> "pycolmap.Reconstruction":
    """The model with frames that stood in the wrong place taken out and placed again, where that explains more.

    First those that contradict their pairs, which may be a whole part of the clip; then single ones, by resection.
    """
    import pycolmap

    for ask in (contradicting_frames, misplaced_frames):
        for _ in range(_ROUNDS):
            misplaced = ask(store, model)
            if not misplaced:
                break
            rest = pycolmap.Reconstruction(model)
            for image_id in misplaced:
                rest.deregister_frame(rest.images[image_id].frame_id)
            again = place_leftovers(store, rest, settings, progress)
            if _merit([again]) <= _merit([model]):
                break
            model = again
    return model


def refine(
    store: FeatureDatabase, model: "pycolmap.Reconstruction", settings: ColmapSettings, progress: Progress
) -> Mapped:
    """The model after bundle adjustment of everything, its lens included unless the user holds it fixed."""
    sizes = (model.num_reg_images(),)
    camera = model.cameras[1]
    if settings.intrinsics == "fixed":
        return Mapped(_adjust(store, model, camera.model.name), sizes, refined=False)
    candidates = [(camera.model.name, True)]
    if settings.camera == "auto" and camera.model.name != "OPENCV":
        candidates.append(("OPENCV", True))
    candidates.append((camera.model.name, False))  # the focal length alone, where distortion runs away
    kept = None
    for done, (name, distortion) in enumerate(candidates):
        progress("refining the lens", done, len(candidates))
        if kept is not None and not distortion:
            break
        start = model if kept is None else kept
        refined = _settled(store, start, name, distortion=distortion)
        gain = 1 - refined.compute_mean_reprojection_error() / start.compute_mean_reprojection_error()
        whole = refined.num_reg_images() >= model.num_reg_images()
        if is_lens(refined.cameras[1]) and whole and (kept is None or gain >= settings.mapping.opencv_gain):
            kept = refined
    progress("refining the lens", len(candidates), len(candidates))
    if kept is None:
        return Mapped(_adjust(store, model, camera.model.name), sizes, refined=False)
    set_camera(store, kept.cameras[1])
    return Mapped(kept, sizes, refined=True)


def is_lens(camera: "pycolmap.Camera") -> bool:
    """Whether the intrinsics can belong to a lens: field of view, pixel shape, distortion that grows to the corners."""
    name, width, height = camera.model.name, camera.width, camera.height
    fx, fy = camera.focal_length_x, camera.focal_length_y
    if not (0.3 < fx / width < 4 and 0.5 < fx / fy < 2):
        return False
    k = torch.from_numpy(np.asarray(camera.params)[-len(DISTORTION_PARAMETERS[name]) :].copy())
    corner = torch.tensor([width / 2 / fx, height / 2 / fy], dtype=torch.float64)
    # along every half diagonal the picture radius must grow with the ray's angle, by a share a lens can have
    reach = torch.linspace(0, 1, 50, dtype=torch.float64)[1:, None, None]
    signs = torch.tensor([[1.0, 1], [1, -1], [-1, 1], [-1, -1]], dtype=torch.float64)
    rays = reach * corner * signs
    radius = distort(rays, k, name).norm(dim=-1)
    ratio = radius / rays.norm(dim=-1)
    if name == "OPENCV" and k[2:].abs().max() > _MAX_TANGENTIAL:
        return False
    return bool((radius.diff(dim=0) > 0).all() and (ratio > 0.4).all() and (ratio < 2.5).all())


def set_camera(store: FeatureDatabase, camera: "pycolmap.Camera") -> None:
    """Make a lens the one that the mapper reads from the database."""
    import pycolmap

    known = pycolmap.Camera(
        model=camera.model.name, width=camera.width, height=camera.height, params=camera.params, camera_id=1
    )
    known.has_prior_focal_length = True  # else the mapper guesses its own from the first pair
    with store.open() as database:
        database.update_camera(known)


def _merit(models: "list[pycolmap.Reconstruction]") -> tuple[int, float]:
    if not models:
        return 0, 0.0
    # observations that agree with the model, each worth less the more it misses (MSAC)
    error = models[0].compute_mean_reprojection_error() / _MAX_ERROR
    return models[0].num_reg_images(), models[0].compute_num_observations() * (1 - error * error)


def _model_name(settings: ColmapSettings) -> str:
    if settings.camera != "auto":
        return settings.camera
    return "SIMPLE_RADIAL" if settings.k2 is settings.p1 is settings.p2 is None else "OPENCV"


def _ladder(width: int, height: int, settings: ColmapSettings) -> "list[pycolmap.Camera]":
    import pycolmap

    name = _model_name(settings)
    port = WATER if settings.housing == "flat" else 1.0
    if settings.focal is not None:
        focals = [settings.focal * port]
    elif name == "OPENCV_FISHEYE":
        focals = [f * width * port for f in (0.45, 0.33, 0.6)]  # 110, 170 and 90 degrees across
    else:
        focals = [f * width for f in settings.mapping.focal_ladder]
        if settings.housing == "flat":
            focals.sort(key=lambda f: abs(f / width - 1.0))  # 0.75 in air is a common lens
    assumed = settings.mapping.k1 if name != "OPENCV_FISHEYE" and settings.focal is None else 0.0
    k = []
    for parameter in DISTORTION_PARAMETERS[name]:
        given = getattr(settings, parameter)
        k.append(given if given is not None else (assumed if parameter == "k1" else 0.0))
    out = []
    for f in focals:
        focal = [f] if name == "SIMPLE_RADIAL" else [f, f]
        params = np.array([*focal, width / 2, height / 2, *k])
        camera = pycolmap.Camera(model=name, width=width, height=height, params=params, camera_id=1)
        camera.has_prior_focal_length = settings.focal is not None or name == "OPENCV_FISHEYE"
        out.append(camera)
    return out


def _map_in_turn(
    store: FeatureDatabase,
    settings: ColmapSettings,
    what: str,
    progress: Progress,
    *,
    goes_on_from: Path | None = None,
    names: list[str] | None = None,
) -> "list[pycolmap.Reconstruction]":
    import pycolmap

    options = pycolmap.IncrementalPipelineOptions()
    options.extract_colors = False
    options.num_threads = _THREADS
    options.random_seed = _SEED
    options.min_model_size = 2
    options.image_names = names or []
    total = len(names) if names else store.frames
    options.min_num_matches = MIN_INLIERS
    options.ba_refine_focal_length = options.ba_refine_extra_params = False
    options.mapper.abs_pose_refine_focal_length = options.mapper.abs_pose_refine_extra_params = False
    if goes_on_from is not None:
        options.multiple_models = False
        options.mapper.abs_pose_min_num_inliers = _LOOSE_INLIERS
        options.mapper.abs_pose_min_inlier_ratio = _LOOSE_SHARE
    placed = 0

    def count(step: int) -> Callable[[], None]:
        def tell() -> None:
            nonlocal placed
            placed = min(placed + step, total) if step == 1 else step
            progress(what, placed, total)

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
    return sorted(models.values(), key=lambda m: _merit([m]), reverse=True)


def _map_globally(
    store: FeatureDatabase, settings: ColmapSettings, progress: Progress
) -> "list[pycolmap.Reconstruction]":
    import pycolmap

    options = pycolmap.GlobalPipelineOptions()
    options.num_threads = settings.threads or -1
    options.random_seed = _SEED
    options.min_num_matches = MIN_INLIERS
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
    return sorted(models, key=lambda m: _merit([m]), reverse=True)


def _best_connected(store: FeatureDatabase, count: int) -> list[str]:
    """Names of the frames that hang together by the most matches, grown from the richest one."""
    import pycolmap

    inliers = np.zeros((store.frames, store.frames))
    with store.open() as database:
        for pair, number in zip(*database.read_two_view_geometry_num_inliers(), strict=True):
            a, b = pycolmap.pair_id_to_image_pair(pair)
            inliers[a - 1, b - 1] = inliers[b - 1, a - 1] = number
    chosen = [int(inliers.sum(1).argmax())]
    while len(chosen) < min(count, store.frames):
        reach = inliers[chosen].sum(0)
        reach[chosen] = -1
        chosen.append(int(reach.argmax()))
    return [f"{i:06d}" for i in sorted(chosen)]


def _settled(
    store: FeatureDatabase, model: "pycolmap.Reconstruction", name: str, distortion: bool
) -> "pycolmap.Reconstruction":
    """The model and its lens adjusted until the reprojection error stands still.

    A lens with many parameters leaves its start slowly, and half way it may still look like one: on ruie_green_rock
    OPENCV stopped at 0.71 px with tangential terms of 0.05 and 0.08, and went on to 0.56 px with 0.06 and 0.08.
    """
    error = np.inf
    for _ in range(_PASSES):
        model = _adjust(store, model, name, focal=True, distortion=distortion)
        before, error = error, model.compute_mean_reprojection_error()
        if error > _STILL * before:
            break
    return model


def _adjust(
    store: FeatureDatabase, model: "pycolmap.Reconstruction", name: str, focal: bool = False, distortion: bool = False
) -> "pycolmap.Reconstruction":
    import pycolmap

    camera = model.cameras[1]
    params = list(camera.params)
    if name == "OPENCV" and camera.model.name == "SIMPLE_RADIAL":
        f, cx, cy, k1 = params
        params = [f, f, cx, cy, k1, 0.0, 0.0, 0.0]
    changed = pycolmap.Camera(
        model=name, width=camera.width, height=camera.height, params=np.array(params), camera_id=1
    )
    set_camera(store, changed)  # the cache below and the model must agree on the lens
    options = pycolmap.DatabaseCacheOptions()
    options.min_num_matches = MIN_INLIERS
    with store.open() as database:
        cache = pycolmap.DatabaseCache.create(database, options)
    out = pycolmap.Reconstruction(model)
    out.cameras[1].model = changed.model
    out.cameras[1].params = list(map(float, changed.params))
    mapper = pycolmap.IncrementalMapper(cache)
    mapper.begin_reconstruction(out)
    mapping = pycolmap.IncrementalMapperOptions()
    mapping.random_seed = _SEED
    mapping.num_threads = _THREADS
    triangulation = pycolmap.IncrementalTriangulatorOptions()
    triangulation.random_seed = _SEED
    adjustment = pycolmap.BundleAdjustmentOptions()
    adjustment.print_summary = False
    adjustment.refine_focal_length, adjustment.refine_extra_params = focal, distortion
    adjustment.ceres.solver_options.num_threads = _THREADS
    adjustment.ceres.loss_function_type = pycolmap.LossFunctionType.SOFT_L1
    mapper.iterative_global_refinement(5, 0.0005, mapping, adjustment, triangulation)
    mapper.end_reconstruction(False)
    out.update_point_3d_errors()
    return out
