"""The section "truth" of summary.json: errors against reference poses, and a synthetic dive's depth, colors and water.

Frames are read, and views rendered, one at a time: the memory does not depend on their number.
"""

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from functools import partial
from itertools import chain

import torch
from jaxtyping import Bool, Float
from torch import Tensor
from torch.nn.functional import normalize

from swimm3r.cameras import image_directions, ray_depth_from_z
from swimm3r.evaluate import NotComputed, summary_entries
from swimm3r.evaluate.depth import depth_scores
from swimm3r.evaluate.poses import absolute_pose_errors, pose_scores
from swimm3r.evaluate.underwater import (
    clear_psnr,
    lit_enough,
    strength_gain,
    view_water_errors,
    water_scores_from_errors,
)
from swimm3r.geometry import DegenerateAlignmentError, align_poses, align_similarity
from swimm3r.imaging.undistortion import nearest_pixels, undistorted
from swimm3r.medium import Medium, MediumFit, remove_water, rescale
from swimm3r.pipeline.scores.held_out import HeldOutView, cut
from swimm3r.pipeline.scores.part_scores import mean_part
from swimm3r.pipeline.summary import identifiable_coefficients, mean_medium
from swimm3r.progress import Progress, silent
from swimm3r.scene.frames import Frames
from swimm3r.scene.ground_truth import GroundTruth, LampImages
from swimm3r.scene.reconstruction import Reconstruction
from swimm3r.splat.rendering import SplatMap
from swimm3r.splat.training_poses import RefinedPoses, axes_of_map


def truth_section(
    rec: Reconstruction,
    frames: Frames,
    truth: GroundTruth,
    scene: SplatMap | None = None,
    views: Sequence[HeldOutView] = (),
    progress: Progress = silent,
) -> dict[str, object]:
    """Errors against reference poses and, where the truth has them, depth, clear colors and water of sfm and map."""
    reference = {name: i for i, name in enumerate(truth.names)}
    wanted = [name for name in frames.train.names if name in reference]
    if len(wanted) < 2:
        reason = NotComputed(f"{len(wanted)} frames of this run are named in the reference, at least 2 are needed")
        return summary_entries(dict.fromkeys(("rotation_deg", "translation_deg", "ate", "depth_absrel"), reason))
    placed = {name: i for i, name in enumerate(rec.names)}
    registered = torch.tensor([name in placed for name in wanted])
    estimated = torch.eye(4, dtype=torch.float64).repeat(len(wanted), 1, 1)
    estimated[registered] = rec.cameras.cam2world[[placed[name] for name in wanted if name in placed]]
    true = truth.cameras.cam2world[[reference[name] for name in wanted]]
    poses = pose_scores(estimated, true, registered)
    section: dict[str, object] = {
        "rotation_deg": poses.rotation_deg,
        "translation_deg": poses.translation_deg,
        "ate": poses.ate,
        "pose_variant": poses.variant,
    }
    if registered.sum() >= 2:
        section["rotation_median_deg"] = absolute_pose_errors(
            estimated[registered], true[registered]
        ).rotation_median_deg
    scale = _scale_to_truth(estimated[registered], true[registered])
    if isinstance(scale, NotComputed):
        section["depth_absrel"] = scale
        return summary_entries(section)
    section |= _depth_section(rec, truth, scale)
    entries = summary_entries(section)
    if scene is not None and scene.poses is not None:
        entries["refined_poses"] = _refined_section(scene.poses, truth)
    if truth.medium is not None and rec.medium is not None:
        fit = rescale(rec.medium, scale)
        of_fit = partial(_views_of_fit, fit, frames.test, truth, progress)
        entries["sfm"] = _against_water(of_fit, truth.lit, fit.constant(), fit.identifiable, truth.medium)
    if truth.medium is not None and scene is not None:
        to_map = axes_of_map(rec, scene.poses)
        unit = scale if to_map is None else scale / to_map.scale.item()  # the map's, which training may have changed
        of_map = partial(_views_of_map, scene, views, truth, unit)
        water = mean_medium(scene, rec, frames)
        coefficients = Medium(water.Binf, water.beta_D / unit, water.beta_B / unit)
        entries["splat"] = _against_water(of_map, truth.lit, coefficients, identifiable_coefficients(rec), truth.medium)
        if truth.moving(views[0].name if views else "") is not None:
            entries["splat"] |= summary_entries(mean_part([view.motion for view in views]).summary())
    return entries


def _refined_section(poses: RefinedPoses, truth: GroundTruth) -> dict[str, object]:
    """The errors of the training frames' poses as the map's training left them."""
    reference = {name: i for i, name in enumerate(truth.names)}
    rows = [k for k, name in enumerate(poses.names) if name in reference]
    if len(rows) < 2:
        reason = NotComputed("fewer than 2 training frames are named in the reference")
        return summary_entries(dict.fromkeys(("rotation_deg", "translation_deg", "ate"), reason))
    true = truth.cameras.cam2world[[reference[poses.names[k]] for k in rows]]
    scores = pose_scores(poses.cam2world[rows], true)
    return summary_entries(
        {"rotation_deg": scores.rotation_deg, "translation_deg": scores.translation_deg, "ate": scores.ate}
    )


def _scale_to_truth(estimated: Float[Tensor, "n 4 4"], true: Float[Tensor, "n 4 4"]) -> float | NotComputed:
    """Length in the truth's unit per length of the reconstruction."""
    try:
        return align_similarity(estimated[:, :3, 3], true[:, :3, 3]).scale.item()
    except DegenerateAlignmentError:
        try:
            return align_poses(estimated, true).scale.item()
        except DegenerateAlignmentError as failure:
            return NotComputed(str(failure))


def _depth_section(rec: Reconstruction, truth: GroundTruth, scale: float) -> dict[str, object]:
    """Depth of the pixels that have one, in the truth's unit through the poses' scale."""
    pairs = (
        (rec.depth[name].z_depth * scale, true)
        for name in rec.names
        if name in rec.depth and name in truth.names and (true := truth.z_depth(name)) is not None
    )
    first = next(pairs, None)
    if first is None:
        return {"depth_absrel": NotComputed("the reference has no depth")}
    scores = depth_scores(chain([first], pairs), align="none")
    return {"depth_absrel": scores.absrel, "depth_coverage": scores.coverage, "depth_variant": "scaled by the poses"}


@dataclass(frozen=True)
class _View:
    """Clear colors of one view, found and true, and the water found at its pixels, in the truth's unit of length."""

    restored: Float[Tensor, "h w 3"]
    clear: Float[Tensor, "h w 3"]
    ray_depth: Float[Tensor, "h w"]  # true
    medium: Medium
    lamp: LampImages | None  # true; None in daylight
    observed: Bool[Tensor, "h w"] | None = None  # some training frame saw what the map shows there; None of a fit

    @property
    def light(self) -> Float[Tensor, "h w 3"] | None:
        """The lamp's light on the surfaces."""
        return None if self.lamp is None else self.lamp.light

    @property
    def backscatter(self) -> Float[Tensor, "h w 3"] | None:
        """The lamp's backscatter."""
        return None if self.lamp is None else self.lamp.backscatter


def _views_of_fit(fit: MediumFit, held_out: Frames, truth: GroundTruth, progress: Progress) -> Iterator[_View]:
    """The frames that nothing was fitted to, restored by a fit at their true depth."""
    for done, frame in enumerate(held_out):
        progress("scoring against the truth", done, len(held_out))
        z_depth, clear = truth.z_depth(frame.name), truth.clear(frame.name)
        if z_depth is None or clear is None:
            continue
        rays = image_directions(truth.cameras[truth.names.index(frame.name)]).float()
        ray_depth, direction = ray_depth_from_z(z_depth, rays), normalize(rays, dim=-1)
        lit = fit.at(ray_depth, direction)
        restored = remove_water(held_out.image(done), ray_depth, lit)
        medium = replace(fit.at(ray_depth), Binf=lit.Binf)
        yield _View(restored, clear, ray_depth, medium, truth.lamp(frame.name))


def _views_of_map(scene: SplatMap, views: Sequence[HeldOutView], truth: GroundTruth, unit: float) -> Iterator[_View]:
    """The held-out views of a map of this unit of length: clear renderings, and its water field at true ray depth."""
    for view in views:
        z_depth, clear = truth.z_depth(view.name), truth.clear(view.name)
        if z_depth is None or clear is None:
            continue
        window = (view.window.rows, view.window.columns)
        everything = torch.ones(clear.shape[:2], dtype=torch.bool)
        true_clear, shown = undistorted(clear, everything, view.lens, view.canvas)
        true_z = torch.where(shown, z_depth[nearest_pixels(view.lens, view.canvas)], 0.0)
        ray_depth = ray_depth_from_z(true_z, image_directions(view.canvas).float())[window]
        out = scene.render(cut(view.canvas, view.window), view.time, backscatter=False)
        medium = Medium(out.medium.Binf, out.medium.beta_D / unit, out.medium.beta_B / unit)
        lamp = truth.lamp(view.name)
        if lamp is not None:
            parts = (undistorted(part, everything, view.lens, view.canvas)[0] for part in vars(lamp).values())
            lamp = LampImages(*(part[window] for part in parts))
        yield _View(out.clear, true_clear[window], ray_depth, medium, lamp, out.observed)


def _against_water(
    views: Callable[[], Iterator[_View]],
    lit: bool,
    coefficients: Medium,
    identifiable: dict[str, Bool[Tensor, "3"]],
    true: Medium,
) -> dict[str, object]:
    """Errors of the water, and the mean PSNR of clear colors, of a map also that of what training frames saw.

    Under a lamp the colors are compared after the one gain that images do not tell, for which all views are gone
    through a first time; it is kept beside the PSNR.
    """
    gain = 1.0
    if lit:
        counted = ((v.restored, v.clear, lit_enough(v.ray_depth, true, light=v.light)) for v in views())
        gain = strength_gain(counted)
    psnrs, observed, errors = [], [], []
    for v in views():
        psnrs.append(clear_psnr(gain * v.restored, v.clear, v.ray_depth, true, light=v.light))
        if v.observed is not None:
            asked = torch.where(v.observed, v.ray_depth, 0.0)
            observed.append(clear_psnr(gain * v.restored, v.clear, asked, true, light=v.light))
        errors.append(view_water_errors(v.ray_depth, v.medium, true, v.backscatter))
    if not psnrs:
        return summary_entries({"clear_psnr": NotComputed("the truth has no depth of a held-out frame")})
    colors: dict[str, object] = {"clear_psnr": _mean(psnrs)}
    if observed:
        colors["clear_psnr_observed"] = _mean(observed)
    if lit:
        colors["clear_gain"] = gain
    return summary_entries(colors) | water_scores_from_errors(errors, coefficients, identifiable, true).summary()


def _mean(values: Sequence[float | NotComputed]) -> float | NotComputed:
    """The mean of those that were computed; the first one's reason where none was."""
    known = [value for value in values if not isinstance(value, NotComputed)]
    return sum(known) / len(known) if known else values[0]
