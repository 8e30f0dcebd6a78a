"""The one lens of a clip: what to begin with when nobody knows it, what can be a lens at all, and its refinement.

On small hazy images a self-calibrating mapper drifts to any focal length and then loses frames. So a lens is held
while frames are placed (`mapping`), and only with every frame in place are the intrinsics refined: what comes out is
kept only if it is a lens. OPENCV's further parameters must earn their keep by a clearly lower reprojection error.
"""

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
import torch

from swimm3r.cameras import distort
from swimm3r.errors import UsageError
from swimm3r.io.colmap.cameras import from_pycolmap_camera, to_pycolmap_camera, under_model
from swimm3r.progress import Progress
from swimm3r.sfm.colmap.adjustment import WIDEST, robust_adjustment, typical_error
from swimm3r.sfm.colmap.pair_focal import focal_of_pairs
from swimm3r.sfm.features.database import MIN_INLIERS, FeatureDatabase
from swimm3r.sfm.lens import check_lens_settings, lens_of, model_of
from swimm3r.sfm.settings import ColmapSettings

if TYPE_CHECKING:
    import pycolmap

SEED = 0
THREADS = 1  # sums in a changing order end in poses 0.01 degrees apart, on weak clips more; a resumed run must not
_MAX_TANGENTIAL = 0.1  # a lens some 10 degrees askew behind its port, or an image cut off-center by a tenth
_PASSES, _ENOUGH = 6, 0.99  # adjustments of the lens at most, and the share of the last error that ends them
STILL = 1e-6  # relative change of the cost that ends a bundle adjustment; COLMAP's 0 always takes 50 or 100 iterations


@dataclass(frozen=True)
class Calibrated:
    """A model after bundle adjustment."""

    model: "pycolmap.Reconstruction"
    refined: bool  # intrinsics as refined; False where refinement gave no lens and the assumed ones stand


def first_camera(width: int, height: int, settings: ColmapSettings) -> "pycolmap.Camera":
    """The lens to begin with: what the user knows, else the first rung of the ladder.

    Raises UsageError where the settings contradict themselves.
    """
    name = model_of(settings)
    check_lens_settings(settings, name, width, height)
    if settings.intrinsics == "fixed" and settings.focal is None:
        raise UsageError(
            "fixed intrinsics need a focal length",
            cause="--intrinsics fixed was given without --focal or --calibration",
            hint="add --calibration, or --focal (and --k1), or leave --intrinsics at prior",
        )
    return ladder(width, height, settings)[0]


def ladder(width: int, height: int, settings: ColmapSettings) -> "list[pycolmap.Camera]":
    """The lenses to try in turn, likelier ones first."""
    name = model_of(settings)
    if settings.focal is not None:
        focals = [settings.focal]
    elif name == "OPENCV_FISHEYE":
        port = settings.port.water if settings.housing == "flat" else 1.0
        focals = [f * width * port for f in (0.45, 0.33, 0.6)]  # 110, 170 and 90 degrees across
    else:
        focals = [f * width for f in settings.mapping.focal_ladder]
        if settings.housing == "flat":
            focals.sort(key=lambda f: abs(f / width - 1.0))  # 0.75 in air is a common lens
    assumed = settings.mapping.k1 if name != "OPENCV_FISHEYE" and settings.focal is None else 0.0
    out = []
    for f in focals:
        camera = to_pycolmap_camera(lens_of(settings, name, width, height, f, assumed))
        camera.has_prior_focal_length = settings.focal is not None or name == "OPENCV_FISHEYE"
        out.append(camera)
    return out


def lenses(store: FeatureDatabase, settings: ColmapSettings) -> "list[pycolmap.Camera]":
    """The lenses to try in turn, likelier ones first: the database's where that is held, else the ladder."""
    with store.open() as database:
        camera = database.read_camera(1)
    return [camera] if settings.intrinsics == "fixed" else ladder(camera.width, camera.height, settings)


def lenses_of_pairs(store: FeatureDatabase, settings: ColmapSettings) -> "list[pycolmap.Camera]":
    """The likeliest lens with the focal length that the pairs agree on; where they do not, or it is known, `lenses`."""
    likely = lenses(store, settings)
    focal = None if likely[0].has_prior_focal_length else focal_of_pairs(store)
    if focal is None:
        return likely
    lens = likely[0]
    lens.params = [focal if i in lens.focal_length_idxs() else value for i, value in enumerate(lens.params)]
    return [lens]


def adjust_lens(
    store: FeatureDatabase,
    model: "pycolmap.Reconstruction",
    settings: ColmapSettings,
    progress: Progress,
    *,
    is_large: bool = False,
) -> "pycolmap.Reconstruction":
    """The model after one bundle adjustment with its lens; as it was where that gives no lens or loses frames.

    Poses and lens of a large model are adjusted without its redundant points, which follow afterwards.
    """
    if settings.intrinsics == "fixed":
        return model
    progress("refining the lens", 0, 1)
    adjusted = _adjust(store, model, model.cameras[1].model.name, focal=True, distortion=True, is_large=is_large)
    progress("refining the lens", 1, 1)
    if is_lens(adjusted.cameras[1]) and adjusted.num_reg_images() >= model.num_reg_images():
        return adjusted
    set_camera(store, model.cameras[1])
    return model


def adjust_poses(store: FeatureDatabase, model: "pycolmap.Reconstruction") -> "pycolmap.Reconstruction":
    """A large model after bundle adjustment of poses and points, its lens held; see `adjust_lens`."""
    return _adjust(store, model, model.cameras[1].model.name, is_large=True)


def refine(
    store: FeatureDatabase, model: "pycolmap.Reconstruction", settings: ColmapSettings, progress: Progress
) -> Calibrated:
    """The model after bundle adjustment of everything, its lens included unless the user holds it fixed."""
    camera = model.cameras[1]
    if settings.intrinsics == "fixed":
        return Calibrated(_sharpened(store, _adjust(store, model, camera.model.name)), refined=False)
    candidates = [(camera.model.name, True)]
    if settings.camera == "auto" and camera.model.name != "OPENCV":
        candidates.append(("OPENCV", True))
    candidates.append((camera.model.name, False))  # the focal length alone, where distortion runs away
    kept, bent = None, True  # the best so far, and whether its distortion was refined
    for done, (name, distortion) in enumerate(candidates):
        progress("refining the lens", done, len(candidates))
        if kept is not None and not distortion:
            break
        start = model if kept is None else kept
        refined = _settled(store, start, name, distortion=distortion)
        before = start.compute_mean_reprojection_error()  # 0 where bundle adjustment dropped every point
        gain = 1 - refined.compute_mean_reprojection_error() / before if before else 0.0
        whole = refined.num_reg_images() >= model.num_reg_images()
        if is_lens(refined.cameras[1]) and whole and (kept is None or gain >= settings.mapping.opencv_gain):
            kept, bent = refined, distortion
    progress("refining the lens", len(candidates), len(candidates))
    if kept is None:
        return Calibrated(_sharpened(store, _adjust(store, model, camera.model.name)), refined=False)
    sharp = _sharpened(store, kept, focal=True, distortion=bent)
    if is_lens(sharp.cameras[1]) and sharp.num_reg_images() >= kept.num_reg_images():
        kept = sharp
    set_camera(store, kept.cameras[1])
    return Calibrated(kept, refined=True)


def is_lens(camera: "pycolmap.Camera") -> bool:
    """Return whether the intrinsics can belong to a lens: field of view, pixel shape, distortion that grows to the
    corners."""
    name, width, height = camera.model.name, camera.width, camera.height
    fx, fy = camera.focal_length_x, camera.focal_length_y
    if not (0.3 < fx / width < 4 and 0.5 < fx / fy < 2):
        return False
    k = torch.from_numpy(from_pycolmap_camera(camera, name)[1])
    corner = torch.tensor([width / 2 / fx, height / 2 / fy], dtype=torch.float64)
    # along every half diagonal the image radius must grow with the ray's angle, by a share a lens can have
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
    known = under_model(camera, camera.model.name)
    known.has_prior_focal_length = True  # else the mapper guesses its own from the first pair
    with store.open() as database:
        database.update_camera(known)


def _settled(
    store: FeatureDatabase, model: "pycolmap.Reconstruction", name: str, distortion: bool
) -> "pycolmap.Reconstruction":
    """The model and its lens adjusted until the reprojection error stands still.

    A lens with many parameters leaves its start slowly: OPENCV on ruie_green_rock stopped at 0.71 px, and came to
    0.56 px when asked again.
    """
    error = np.inf
    for _ in range(_PASSES):
        model = _adjust(store, model, name, focal=True, distortion=distortion)
        before, error = error, model.compute_mean_reprojection_error()
        if error > _ENOUGH * before:
            break
    return model


def _sharpened(
    store: FeatureDatabase, model: "pycolmap.Reconstruction", *, focal: bool = False, distortion: bool = False
) -> "pycolmap.Reconstruction":
    """An adjusted model after a last adjustment, under a loss as wide as its typical error."""
    name = model.cameras[1].model.name
    return _adjust(store, model, name, focal=focal, distortion=distortion, width=typical_error(model))


def _adjust(
    store: FeatureDatabase,
    model: "pycolmap.Reconstruction",
    name: str,
    *,
    focal: bool = False,
    distortion: bool = False,
    is_large: bool = False,
    width: float = WIDEST,
) -> "pycolmap.Reconstruction":
    import pycolmap

    changed = under_model(model.cameras[1], name)
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
    mapping.random_seed = SEED
    mapping.num_threads = THREADS
    # half the time and memory of 262 frames; their path is off by 0.0029 % of its length instead of 0.0024 %
    mapping.ba_global_ignore_redundant_points3D = is_large
    triangulation = pycolmap.IncrementalTriangulatorOptions()
    triangulation.random_seed = SEED
    adjustment = robust_adjustment(width)
    adjustment.refine_focal_length, adjustment.refine_extra_params = focal, distortion
    adjustment.ceres.solver_options.num_threads = THREADS
    adjustment.ceres.solver_options.function_tolerance = STILL
    mapper.iterative_global_refinement(5, 0.0005, mapping, adjustment, triangulation)
    mapper.end_reconstruction(False)
    out.update_point_3d_errors()
    return out
