"""Navigation in mapping: parts of a clip that share no ground joined by it, and positions as COLMAP's pose priors.

    sum rho(e / w) + sum_i rho'(Sigma_i^-1/2 (c_i - p_i))

over poses, points and, where the images determine it, the lens; e are reprojection errors and w the typical one
(`adjustment`), at first 1 px, c_i camera centers, p_i positions by navigation in the axes and the unit of the largest
part, Sigma_i their covariances. rho is quadratic up to 1 and so is rho', up to its own width. COLMAP counts errors in
pixels: its sum is w^2 times this one, with covariances divided by w^2.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial
from typing import TYPE_CHECKING

import numpy as np
from jaxtyping import Float

from swimm3r.progress import Progress
from swimm3r.scene.frames import Frames
from swimm3r.scene.placement import Navigator, Placement
from swimm3r.scene.reconstruction import QualityWarning, Reconstruction
from swimm3r.sfm.colmap.adjustment import WIDEST, robust_adjustment, typical_error
from swimm3r.sfm.colmap.calibration.adjust import SEED, STILL, THREADS
from swimm3r.sfm.colmap.calibration.refinement import adjust_within_family
from swimm3r.sfm.colmap.chunks.assemble import assemble
from swimm3r.sfm.colmap.chunks.join import Joined
from swimm3r.sfm.colmap.chunks.parts import LEAST_FRAMES, part_of
from swimm3r.sfm.features.database import FeatureDatabase
from swimm3r.sim3 import IDENTITY

if TYPE_CHECKING:
    import pycolmap

_STEP = "adjusting to the navigation"
_MAX_ERROR, _MIN_ANGLE = 4.0, 1.5  # pixels and degrees of a point that stays, as in COLMAP's mapper
_UNKNOWN = 1e3  # extents of the path: the standard deviation of a coordinate that is not known
_ROUNDS = 2  # of adjustment, points that miss dropped between them


@dataclass(frozen=True)
class Prior:
    """Position of a camera in the axes and the unit of a model."""

    position: Float[np.ndarray, "3"]
    covariance: Float[np.ndarray, "3 3"]


@dataclass(frozen=True)
class Navigated:
    """A model adjusted to the navigation, the models that it could not join, and warnings."""

    model: "pycolmap.Reconstruction"
    others: "list[pycolmap.Reconstruction]"
    warnings: list[QualityWarning]


def with_navigation(
    store: FeatureDatabase,
    model: "pycolmap.Reconstruction",
    others: "Sequence[pycolmap.Reconstruction]",
    frames: Frames,
    navigator: Navigator,
    record: "Callable[[pycolmap.Reconstruction], Reconstruction]",
    progress: Progress,
    *,
    focal: bool,
    distortion: bool,
) -> Navigated:
    """The largest model with the parts that navigation places beside it, adjusted; what is asked of its lens, too.

    Raises InputError where the navigation contradicts the largest model.
    """
    placed = navigator.place(record(model), frames)
    known = {model.images[i].name for i in model.reg_image_ids()}
    parts: list[tuple[pycolmap.Reconstruction, Placement]] = []
    left = []
    for other in sorted(others, key=lambda m: m.num_reg_images(), reverse=True):
        own = {other.images[i].name for i in other.reg_image_ids()}
        is_new = len(own - known) >= LEAST_FRAMES
        found = navigator.place_part(record(other), frames, placed) if is_new else None
        if found is None:
            left.append(other)
            continue
        known |= own
        parts.append((other, found))
    if parts:
        model = _joined(store, model, parts, placed, progress)
    placements = [placed, *(found for _, found in parts)]
    model = adjust_to_positions(model, _priors(placements, frames), progress, focal=focal, distortion=distortion)
    warnings = [_joined_warning(placed, parts)] if parts else []
    return Navigated(model, left, warnings)


def adjust_to_positions(
    model: "pycolmap.Reconstruction", priors: dict[str, Prior], progress: Progress, *, focal: bool, distortion: bool
) -> "pycolmap.Reconstruction":
    """The model after bundle adjustment with priors of camera centers, by name of the image.

    Its lens is held but for what is asked, and stays in its family; all of it is held where that gives no lens.
    """
    held = partial(_adjusted, priors=priors, progress=progress)
    if not (focal or distortion):
        return held(model)
    return adjust_within_family(model, partial(held, focal=focal, distortion=distortion), held)


def _adjusted(
    model: "pycolmap.Reconstruction",
    *,
    priors: dict[str, Prior],
    progress: Progress,
    focal: bool = False,
    distortion: bool = False,
) -> "pycolmap.Reconstruction":
    import pycolmap

    out = pycolmap.Reconstruction(model)
    images = {out.images[i].name: out.images[i] for i in out.reg_image_ids()}
    stated = [(images[name], prior) for name, prior in sorted(priors.items()) if name in images]
    prior_options = pycolmap.PosePriorBundleAdjustmentOptions()
    prior_options.alignment_ransac.random_seed = SEED
    prior_options.ceres.prior_position_loss_function_type = pycolmap.LossFunctionType.CAUCHY
    prior_width = prior_options.ceres.prior_position_loss_scale
    for done in range(_ROUNDS):
        progress(_STEP, done, _ROUNDS)
        out.update_point_3d_errors()
        width = typical_error(out) if done else WIDEST  # the priors move poses at first
        options = robust_adjustment(width)
        options.refine_focal_length, options.refine_extra_params = focal, distortion
        options.ceres.solver_options.num_threads = THREADS
        options.ceres.solver_options.function_tolerance = STILL
        prior_options.ceres.prior_position_loss_scale = prior_width * width
        known = [_pose_prior(image, prior, width) for image, prior in stated]
        config = pycolmap.BundleAdjustmentConfig()
        for image in out.reg_image_ids():
            config.add_image(image)
        pycolmap.create_pose_prior_bundle_adjuster(options, prior_options, config, known, out).solve()
        pycolmap.ObservationManager(out).filter_all_points3D(_MAX_ERROR, _MIN_ANGLE)
    progress(_STEP, _ROUNDS, _ROUNDS)
    out.update_point_3d_errors()
    return out


def _joined(
    store: FeatureDatabase,
    model: "pycolmap.Reconstruction",
    parts: "list[tuple[pycolmap.Reconstruction, Placement]]",
    placed: Placement,
    progress: Progress,
) -> "pycolmap.Reconstruction":
    """One model of all parts, in the axes of the largest and under its lens, its points triangulated anew."""
    model_from_local = placed.local_from_model.inverse()
    from_part = {0: IDENTITY}
    for k, (_, found) in enumerate(parts, 1):
        from_part[k] = model_from_local.after(found.local_from_model)
    pieces = [part_of(model), *(part_of(part) for part, _ in parts)]
    return assemble(store, pieces, Joined(from_part, ()), model.cameras[1], progress)


def _priors(placements: Sequence[Placement], frames: Frames) -> dict[str, Prior]:
    """The positions of all parts in the model of the first, by the names of the database."""
    first = placements[0]
    model_from_local = first.local_from_model.inverse()
    number = {name: f"{i:06d}" for i, name in enumerate(frames.names)}
    priors: dict[str, Prior] = {}
    for placed in placements:
        std = np.where(np.isfinite(placed.std), placed.std, _UNKNOWN * np.ptp(placed.position, axis=0).max())
        for name, position, each in zip(
            placed.names, model_from_local(placed.position), std * model_from_local.scale, strict=True
        ):
            covariance = model_from_local.R @ np.diag(each**2) @ model_from_local.R.T
            priors.setdefault(number[name], Prior(position, covariance))
    return priors


def _pose_prior(image: "pycolmap.Image", prior: Prior, width: float) -> "pycolmap.PosePrior":
    import pycolmap

    return pycolmap.PosePrior(
        corr_data_id=image.data_id,
        position=prior.position,
        position_covariance=prior.covariance / width**2,
        coordinate_system=pycolmap.PosePriorCoordinateSystem.CARTESIAN,
    )


def _joined_warning(placed: Placement, parts: "list[tuple[pycolmap.Reconstruction, Placement]]") -> QualityWarning:
    sizes = " + ".join(str(part.num_reg_images()) for part, _ in parts)
    worst = max((found for _, found in parts), key=lambda found: found.scale_std)
    return QualityWarning(
        f"Navigation alone holds {sizes} frames beside the others: they share no ground with them. Their scale is known"
        f" to {100 * float(np.hypot(worst.scale_std, placed.scale_std)):.1f}% and their attitude to"
        f" {worst.rotation_std_deg:.1f} degrees.",
        "Measure lengths within a part rather than across; a line that crosses the others joins them by what is seen.",
    )
