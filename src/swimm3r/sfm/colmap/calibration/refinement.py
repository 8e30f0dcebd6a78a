"""The lens of a clip refined with its frames in place.

A lens with more parameters always fits its own frames better. Where OPENCV's explain them clearly better, `hypotheses`
asks which lens also holds on frames that it was not fitted to.
"""

from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

from swimm3r.progress import Progress
from swimm3r.sfm.colmap.adjustment import typical_error
from swimm3r.sfm.colmap.calibration.adjust import adjusted, settled
from swimm3r.sfm.colmap.calibration.hypotheses import (
    LensFamily,
    ModelAdjustment,
    family_of,
    fitted,
    likeliest,
    squeezed_like,
    within_family,
)
from swimm3r.sfm.colmap.calibration.start import is_lens, set_camera
from swimm3r.sfm.features.database import FeatureDatabase
from swimm3r.sfm.settings import ColmapSettings

if TYPE_CHECKING:
    import pycolmap

_STEP = "refining the lens"


@dataclass(frozen=True)
class Calibrated:
    """A model after bundle adjustment."""

    model: "pycolmap.Reconstruction"
    refined: bool  # intrinsics as refined; False where refinement gave no lens and the assumed ones stand
    distortion: bool  # refined, too; False where the assumed one stands, as refinement with it gave no lens


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
    progress(_STEP, 0, 1)
    family = family_of(model.cameras[1])

    def adjust(store: FeatureDatabase, model: "pycolmap.Reconstruction") -> "pycolmap.Reconstruction":
        return adjusted(store, model, family.model, focal=True, distortion=True, is_large=is_large)

    found = fitted(store, model, family, adjust)
    progress(_STEP, 1, 1)
    if _is_sound(found, model):
        return found
    set_camera(store, model.cameras[1])
    return model


def adjust_poses(store: FeatureDatabase, model: "pycolmap.Reconstruction") -> "pycolmap.Reconstruction":
    """A large model after bundle adjustment of poses and points, its lens held; see `adjust_lens`."""
    return adjusted(store, model, model.cameras[1].model.name, is_large=True, points_of_two=True)


def refine(
    store: FeatureDatabase, model: "pycolmap.Reconstruction", settings: ColmapSettings, progress: Progress
) -> Calibrated:
    """The model after bundle adjustment of everything, its lens included unless the user holds it fixed."""
    own = family_of(model.cameras[1])
    if settings.intrinsics == "fixed":
        return Calibrated(_poses_alone(store, model), refined=False, distortion=False)
    progress(_STEP, 0, 3)
    kept = _refined(store, model, own)
    family = own
    if settings.camera == "auto" and own == LensFamily("SIMPLE_RADIAL"):
        progress(_STEP, 1, 3)
        family, kept = _with_more_parameters(store, model, kept, own, settings, progress)
    distortion = kept is not None
    if kept is None:  # distortion ran away
        progress(_STEP, 2, 3)
        kept = _refined(store, model, family, distortion=False)
    progress(_STEP, 3, 3)
    if kept is None:
        return Calibrated(_poses_alone(store, model), refined=False, distortion=False)
    sharp = _sharpened(store, kept, family, distortion=distortion)
    kept = sharp if _is_sound(sharp, kept) else kept
    set_camera(store, kept.cameras[1])
    return Calibrated(kept, refined=True, distortion=distortion)


def refine_again(store: FeatureDatabase, calibrated: Calibrated, progress: Progress) -> Calibrated:
    """A refined model whose observations were moved after another adjustment of what was refined of its lens."""
    model = calibrated.model
    if not calibrated.refined:
        return Calibrated(_poses_alone(store, model), refined=False, distortion=False)
    progress(_STEP, 0, 1)
    family = family_of(model.cameras[1])
    kept = model
    for _ in range(2):  # errors are smaller after the first, and the loss of the second is as wide as they are
        found = _sharpened(store, kept, family, distortion=calibrated.distortion)
        kept = found if _is_sound(found, kept) else kept
    progress(_STEP, 1, 1)
    set_camera(store, kept.cameras[1])
    return replace(calibrated, model=kept)


def adjust_within_family(
    model: "pycolmap.Reconstruction", free: ModelAdjustment, held: ModelAdjustment
) -> "pycolmap.Reconstruction":
    """A model after an adjustment with its lens `free` within its family; where that gives no lens, with it `held`."""
    found = within_family(model, family_of(model.cameras[1]), free)
    return found if is_lens(found.cameras[1]) else held(model)


def _with_more_parameters(
    store: FeatureDatabase,
    model: "pycolmap.Reconstruction",
    kept: "pycolmap.Reconstruction | None",
    own: LensFamily,
    settings: ColmapSettings,
    progress: Progress,
) -> "tuple[LensFamily, pycolmap.Reconstruction | None]":
    """The family of the clip's lens and its model, None as `kept`: another than `own` where OPENCV leaves a doubt.

    `kept` is the model refined under `own`, None where that gave no lens.
    """
    start, gain = kept or model, settings.mapping.opencv_gain
    free = LensFamily("OPENCV")
    general = _settled(store, start, free)
    before = start.compute_mean_reprojection_error()  # 0 where bundle adjustment dropped every point
    if kept is not None and (not before or 1 - general.compute_mean_reprojection_error() / before < gain):
        return own, kept
    families = [own, *squeezed_like(general.cameras[1], own.model)] + [free] * _is_sound(general, model)
    chosen = likeliest(store, start, families, gain, progress) if len(families) > 1 else own
    if chosen == own:
        return own, kept
    return chosen, general if chosen == free else _refined(store, start, chosen)


def _refined(
    store: FeatureDatabase, model: "pycolmap.Reconstruction", family: LensFamily, *, distortion: bool = True
) -> "pycolmap.Reconstruction | None":
    """The model with a lens of a family; None where what comes out is none, or loses frames."""
    found = _settled(store, model, family, distortion=distortion)
    return found if _is_sound(found, model) else None


def _settled(
    store: FeatureDatabase, model: "pycolmap.Reconstruction", family: LensFamily, *, distortion: bool = True
) -> "pycolmap.Reconstruction":
    def adjust(store: FeatureDatabase, model: "pycolmap.Reconstruction") -> "pycolmap.Reconstruction":
        return settled(lambda m: adjusted(store, m, family.model, focal=True, distortion=distortion), model)

    return fitted(store, model, family, adjust)


def _sharpened(
    store: FeatureDatabase, model: "pycolmap.Reconstruction", family: LensFamily, *, distortion: bool
) -> "pycolmap.Reconstruction":
    """An adjusted model after a last adjustment, under a loss as wide as its typical error."""

    def adjust(store: FeatureDatabase, model: "pycolmap.Reconstruction") -> "pycolmap.Reconstruction":
        width = typical_error(model)
        return adjusted(store, model, family.model, focal=True, distortion=distortion, width=width)

    return fitted(store, model, family, adjust)


def _poses_alone(store: FeatureDatabase, model: "pycolmap.Reconstruction") -> "pycolmap.Reconstruction":
    name = model.cameras[1].model.name
    found = adjusted(store, model, name, points_of_two=True)
    return adjusted(store, found, name, points_of_two=True, width=typical_error(found))


def _is_sound(found: "pycolmap.Reconstruction", before: "pycolmap.Reconstruction") -> bool:
    """Return whether an adjusted model has a lens, and all frames of the one before."""
    return is_lens(found.cameras[1]) and found.num_reg_images() >= before.num_reg_images()
