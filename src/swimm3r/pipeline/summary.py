"""The sections of summary.json: records in, plain numbers out (layout: docs/conventions.md)."""

from collections.abc import Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path

import torch
from jaxtyping import Bool, Float
from torch import Tensor
from torch.nn.functional import normalize

from swimm3r.cameras import image_directions, ray_depth_from_z
from swimm3r.evaluate import NotComputed, summary_entries
from swimm3r.evaluate.depth import depth_scores
from swimm3r.evaluate.images import as_8_bit, psnr
from swimm3r.evaluate.matches import epipolar_errors, match_scores
from swimm3r.evaluate.poses import absolute_pose_errors, pose_scores
from swimm3r.evaluate.underwater import clear_psnr, lit_enough, strength_gain, water_scores_from_views
from swimm3r.geometry import DegenerateAlignmentError, align_poses, align_similarity
from swimm3r.imaging.undistortion import nearest_pixels, undistorted, undistorted_matches
from swimm3r.io.files.metrics_log import read_rows
from swimm3r.lamp import lamp_document
from swimm3r.medium import Medium, MediumFit, remove_water, rescale
from swimm3r.pipeline.held_out import HeldOutView, cut, mean_part, mean_scores, protocol
from swimm3r.progress import Progress, silent
from swimm3r.scene.frames import Frames
from swimm3r.scene.ground_truth import GroundTruth
from swimm3r.scene.reconstruction import Matches, Reconstruction
from swimm3r.splat.appearance import read_decision
from swimm3r.splat.rendering import SplatMap, mean_water
from swimm3r.splat.settings import PoseRefinementSettings
from swimm3r.splat.training_poses import RefinedPoses

_ASKED = 16  # training views that the map's mean water is taken over


def sfm_sections(
    rec: Reconstruction, frames: Frames, matches: Matches | None = None, placed_between: int = 0
) -> dict[str, object]:
    """ "sfm", "rig", "moving", "medium" and "warnings": what structure from motion found.

    Epipolar scores are of `matches`, by default those that the reconstruction keeps. `placed_between` is the number of
    frames between keyframes that have a pose.
    """
    epipolar = match_scores(match_errors(rec, matches or rec.matches))
    observations = torch.bincount(rec.tracks.point, minlength=len(rec.points.xyz)).double()
    sfm = {
        "backend": rec.backend,
        "frames": len(frames.train),
        "registered": len(rec.names),
        "between": len(frames.between),
        "between_placed": placed_between,
        "points": len(rec.points.xyz),
        "dense_points": 0 if rec.cloud is None else len(rec.cloud.xyz),
        "reprojection_px": ((rec.points.error.double() * observations).sum() / observations.sum()).item()
        if len(rec.tracks.point)
        else NotComputed("no observations of points are known"),
        "epipolar_px": epipolar.epipolar_px,
        "inlier_1px": epipolar.inlier_1px,
        "epipolar_variant": epipolar.variant,
        "metric": rec.metric,
    }
    sections: dict[str, object] = {"sfm": summary_entries(sfm)}
    if rec.rig is not None:
        sections["rig"] = asdict(rec.rig)
    if rec.moving is not None:
        shares = [share for _, share in rec.moving.shares(frames)]
        covered = {"share": sum(shares) / len(rec.names), "largest_share": max(shares, default=0.0)}
        sections["moving"] = {"frames": len(shares), **covered}
    if rec.medium is not None:
        sections["medium"] = {"sfm": _medium_section(rec.medium, rec.metric)}
        if rec.medium_linear is not None:
            sections["medium"] = {**sections["medium"], "sfm_linear": _medium_section(rec.medium_linear, rec.metric)}
    sections["warnings"] = [
        *({"what": what, "advice": ""} for what in frames.warnings),
        *(vars(warning) for warning in rec.warnings),
    ]
    return sections


def match_errors(rec: Reconstruction, matches: Matches) -> Float[Tensor, " m"]:
    """Symmetric epipolar error of matches under the reconstruction's own cameras; pixels of the frames."""
    return epipolar_errors(
        matches.i,
        matches.j,
        undistorted_matches(rec.cameras, matches.i, matches.xy_i),
        undistorted_matches(rec.cameras, matches.j, matches.xy_j),
        rec.cameras.K,
        rec.cameras.cam2world,
    )


def splat_sections(scene: SplatMap, rec: Reconstruction, frames: Frames, folder: Path) -> dict[str, object]:
    """ "splat" and the map's own water in "medium": the field's mean over the training views."""
    rows = read_rows(folder / "metrics.jsonl")
    lost = NotComputed("the record of the training, metrics.jsonl, is lost")
    section = {
        "recipe": scene.settings.recipe,
        "primitives": scene.count,
        "iterations": scene.settings.iterations,
        "seconds_per_iteration": rows[-1].get("seconds_per_step", lost) if rows else lost,
        "cpu_seconds_per_iteration": rows[-1].get("cpu_seconds_per_step", lost) if rows else lost,
        "device": scene.device.type,
    }
    decision = read_decision(folder)
    if decision is not None:
        section["appearance"] = asdict(decision)
    water = mean_medium(scene, rec, frames)
    medium = {
        **{name: value.tolist() for name, value in vars(water).items()},
        "identifiable": {name: flags.tolist() for name, flags in _identifiable(rec).items()},
        "unit": "1/m" if scene.metric else "per scene unit",
        "encoding": "srgb",
    }
    return {"splat": summary_entries(section), "medium": {"splat": medium}}


def test_section(views: Sequence[HeldOutView], settings: PoseRefinementSettings, recolored: bool) -> dict[str, object]:
    """Mean scores of the frames that training did not see, and how they were placed and compared."""
    means = {
        **vars(mean_scores(views)),
        **mean_part([view.observed for view in views]).summary(),
        **mean_part([view.covered for view in views]).summary(),
        **mean_part([view.still for view in views]).summary(),
        "protocol": protocol(views, settings, recolored),
    }
    return summary_entries(means) | {"frames": [frame_entry(view) for view in views]}


def frame_entry(view: HeldOutView) -> dict[str, object]:
    """The scores of one test frame."""
    of_frame = {name: getattr(view.scores, name) for name in ("psnr", "ssim", "lpips", "blur4_psnr", "sharpness")}
    return {"name": view.name} | summary_entries(
        {**of_frame, **view.observed.summary(), **view.covered.summary(), **view.still.summary()}
    )


def mean_medium(scene: SplatMap, rec: Reconstruction, frames: Frames) -> Medium:
    """The map's water averaged over the directions and times of the training frames, per scene unit of ray depth."""
    times = frames.times_of(rec.names)
    every = max(1, len(rec.names) // _ASKED)
    with torch.no_grad():
        views = [mean_water(scene, rec.cameras[i].pinhole(64), times[i]) for i in range(0, len(rec.names), every)]
    return Medium(**{name: torch.stack([getattr(view, name) for view in views]).mean(0) for name in vars(views[0])})


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
        entries["sfm"] = _water_section(rescale(rec.medium, scale), frames.test, truth, progress)
    if truth.medium is not None and scene is not None:
        entries["splat"] = _map_water_section(scene, rec, frames, views, truth, scale)
        if truth.moving(views[0].name if views else "") is not None:
            entries["splat"] |= summary_entries(_moving_section(scene, frames, views, truth))
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


def _medium_section(fit: MediumFit, metric: bool) -> dict[str, object]:
    return {
        **{name: value.tolist() for name, value in vars(fit.constant()).items()},
        "identifiable": {name: flags.tolist() for name, flags in fit.identifiable.items()},
        "unit": "1/m" if metric else "per scene unit",
        "encoding": fit.encoding,
        "estimator": fit.estimator,
        "light": "sun" if fit.lamp is None else "lamp",
        **({} if fit.light is None else {"light_evidence": asdict(fit.light)}),
        **({} if fit.lamp is None else {"lamp": lamp_document(fit.lamp)}),
    }


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
    pairs = [
        (rec.depth[name].z_depth * scale, true)
        for name in rec.names
        if name in rec.depth and name in truth.names and (true := truth.z_depth(name)) is not None
    ]
    if not pairs:
        return {"depth_absrel": NotComputed("the reference has no depth")}
    scores = depth_scores([p for p, _ in pairs], [t for _, t in pairs], align="none")
    return {"depth_absrel": scores.absrel, "depth_coverage": scores.coverage, "depth_variant": "scaled by the poses"}


def _water_section(fit: MediumFit, held_out: Frames, truth: GroundTruth, progress: Progress) -> dict[str, object]:
    """The water's errors, and the clear colors it gives at true depth, over the frames nothing was fitted to."""
    assert truth.medium is not None
    media, compared = [], []
    for done, frame in enumerate(held_out):
        progress("scoring against the truth", done, len(held_out))
        z_depth, clear = truth.z_depth(frame.name), truth.clear(frame.name)
        if z_depth is None or clear is None:
            continue
        rays = image_directions(truth.cameras[truth.names.index(frame.name)]).float()
        ray_depth, direction = ray_depth_from_z(z_depth, rays), normalize(rays, dim=-1)
        lit, lamp = fit.at(ray_depth, direction), truth.lamp(frame.name)
        restored = remove_water(held_out.image(done), ray_depth, lit)
        medium = replace(fit.at(ray_depth), Binf=lit.Binf)
        media.append((ray_depth, medium) if lamp is None else (ray_depth, medium, lamp.backscatter))
        compared.append(_Compared(restored, clear, ray_depth, None if lamp is None else lamp.light))
    if not media:
        return summary_entries({"clear_psnr": NotComputed("the truth has no depth of a held-out frame")})
    scores = water_scores_from_views(media, fit.constant(), fit.identifiable, truth.medium)
    return summary_entries(_clear_section(compared, truth.medium)) | scores.summary()


@dataclass(frozen=True)
class _Compared:
    """Clear colors of one view, found and true."""

    restored: Float[Tensor, "h w 3"]
    clear: Float[Tensor, "h w 3"]
    ray_depth: Float[Tensor, "h w"]
    light: Float[Tensor, "h w 3"] | None  # of a lamp on the surfaces; None in daylight


def _clear_section(compared: Sequence[_Compared], medium: Medium) -> dict[str, object]:
    """Mean PSNR of clear colors; under a lamp after the one gain that images do not tell, which is kept beside it."""
    lit = any(view.light is not None for view in compared)
    gain = 1.0
    if lit:
        counted = (lit_enough(view.ray_depth, medium, light=view.light) for view in compared)
        gain = strength_gain((v.restored, v.clear, each) for v, each in zip(compared, counted, strict=True))
    psnrs = [clear_psnr(gain * v.restored, v.clear, v.ray_depth, medium, light=v.light) for v in compared]
    known = [value for value in psnrs if not isinstance(value, NotComputed)]
    mean = sum(known) / len(known) if known else psnrs[0]
    return {"clear_psnr": mean, "clear_gain": gain} if lit else {"clear_psnr": mean}


def _map_water_section(
    scene: SplatMap, rec: Reconstruction, frames: Frames, views: Sequence[HeldOutView], truth: GroundTruth, scale: float
) -> dict[str, object]:
    """The same of a map: its water field at true ray depth, and its own clear rendering, on the held-out views."""
    assert truth.medium is not None
    media, compared = [], []
    for view in views:
        z_depth, clear = truth.z_depth(view.name), truth.clear(view.name)
        if z_depth is None or clear is None:
            continue
        rows, columns = view.window.rows, view.window.columns
        everything = torch.ones(clear.shape[:2], dtype=torch.bool)
        true_clear, shown = undistorted(clear, everything, view.lens, view.canvas)
        true_z = torch.where(shown, z_depth[nearest_pixels(view.lens, view.canvas)], 0.0)
        ray_depth = ray_depth_from_z(true_z, image_directions(view.canvas).float())[rows, columns]
        out = scene.render(cut(view.canvas, view.window), view.time)
        medium = Medium(out.medium.Binf, out.medium.beta_D / scale, out.medium.beta_B / scale)
        light, lamp = None, truth.lamp(view.name)
        if lamp is not None:
            light, glow = (undistorted(values, everything, view.lens, view.canvas)[0] for values in vars(lamp).values())
            light, glow = light[rows, columns], glow[rows, columns]
            media.append((ray_depth, medium, glow))
        else:
            media.append((ray_depth, medium))
        compared.append(_Compared(out.clear, true_clear[rows, columns], ray_depth, light))
    if not media:
        return summary_entries({"clear_psnr": NotComputed("the truth has no depth of a held-out frame")})
    water = mean_medium(scene, rec, frames)
    coefficients = Medium(water.Binf, water.beta_D / scale, water.beta_B / scale)
    scores = water_scores_from_views(media, coefficients, _identifiable(rec), truth.medium)
    return summary_entries(_clear_section(compared, truth.medium)) | scores.summary()


def _moving_section(
    scene: SplatMap, frames: Frames, views: Sequence[HeldOutView], truth: GroundTruth
) -> dict[str, object]:
    """PSNR of the held-out views where something moves and where nothing does, means over the views that show it."""
    moved, still = [], []
    for view in views:
        f, moving = frames.index(view.name), truth.moving(view.name)
        if moving is None:
            continue
        window = (view.window.rows, view.window.columns)
        target, seen = undistorted(frames.image(f), frames.mask(f), view.lens, view.canvas)
        _, quiet = undistorted(frames.image(f), frames.mask(f) & ~moving, view.lens, view.canvas)
        render = as_8_bit(scene.render(cut(view.canvas, view.window), view.time).rgb)
        target, seen, quiet = as_8_bit(target)[window], seen[window], quiet[window]
        for where, found in ((seen & ~quiet, moved), (quiet, still)):
            if bool(where.any()):
                found.append(psnr(render[where], target[where]))

    def mean(values: list[float]) -> float | NotComputed:
        return sum(values) / len(values) if values else NotComputed("no held-out frame shows any of it")

    return {"psnr_moving": mean(moved), "psnr_still": mean(still)}


def _identifiable(rec: Reconstruction) -> dict[str, Bool[Tensor, "3"]]:
    """The coefficients that the frames determine, by the fit of structure from motion."""
    if rec.medium is not None:
        return rec.medium.identifiable
    return {name: torch.zeros(3, dtype=torch.bool) for name in ("Binf", "beta_D", "beta_B")}
