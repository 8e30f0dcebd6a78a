"""The sections of summary.json: records in, plain numbers out (layout: docs/conventions.md)."""

from collections.abc import Sequence
from dataclasses import asdict
from pathlib import Path

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from swimm3r.appearance import FrameColors
from swimm3r.evaluate import NotComputed, summary_entries
from swimm3r.evaluate.matches import epipolar_errors, match_scores
from swimm3r.imaging.undistortion import undistorted_matches
from swimm3r.io.files.metrics_log import read_rows
from swimm3r.lamp import lamp_document
from swimm3r.medium import Medium, MediumFit
from swimm3r.pipeline.scores.held_out import HeldOutView, mean_scores, protocol
from swimm3r.scene.frames import Frames
from swimm3r.scene.reconstruction import Matches, Reconstruction
from swimm3r.splat.appearance import read_decision
from swimm3r.splat.rendering import SplatMap, mean_water
from swimm3r.splat.settings import PoseRefinementSettings
from swimm3r.splat.training_poses import as_mapped

_ASKED = 16  # training views that the map's mean water is taken over


def frames_section(frames: Frames) -> dict[str, object]:
    """Of "input": the prepared frames."""
    return {
        "frames": len(frames),
        "train": len(frames.train),
        "test": len(frames.test),
        "between": len(frames.between),
        "width": frames.width,
        "height": frames.height,
        "gray": frames.gray,
        "development": frames.development,
        "masks": {"used": sum(frame.mask is not None for frame in frames), "unused": frames.unused_masks},
    }


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
    if rec.steady is not None:
        sections["flicker"] = {"evened_frames": rec.steady.count(frames)}
    if rec.own_colors is not None:
        sections["appearance"] = {"evened_frames": len(rec.own_colors.names)}
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
        "identifiable": {name: flags.tolist() for name, flags in identifiable_coefficients(rec).items()},
        "unit": "1/m" if scene.metric else "per scene unit",
        "encoding": "srgb",
    }
    return {"splat": summary_entries(section), "medium": {"splat": medium}}


def test_section(
    views: Sequence[HeldOutView],
    settings: PoseRefinementSettings,
    colors: FrameColors | None,
    unplaced: Sequence[str],
) -> dict[str, object]:
    """Mean scores of the frames that training did not see, and how they were placed and compared."""
    means = {**mean_scores(views), "protocol": protocol(views, settings, colors)}
    if views:
        means["variant"] = views[0].scores.variant
    left_out = {"unplaced": list(unplaced)} if unplaced else {}
    return summary_entries(means) | left_out | {"frames": [frame_entry(view) for view in views]}


def frame_entry(view: HeldOutView) -> dict[str, object]:
    """The scores of one test frame."""
    of_frame = {name: getattr(view.scores, name) for name in ("psnr", "ssim", "lpips", "blur4_psnr", "sharpness")}
    return {"name": view.name} | summary_entries(
        {**of_frame, **view.observed.summary(), **view.covered.summary(), **view.still.summary()}
    )


def mean_medium(scene: SplatMap, rec: Reconstruction, frames: Frames) -> Medium:
    """The map's water averaged over the directions and times of the training frames, per scene unit of ray depth."""
    times, cameras = frames.times_of(rec.names), as_mapped(rec, scene.poses).cameras
    every = max(1, len(rec.names) // _ASKED)
    with torch.no_grad():
        views = [mean_water(scene, cameras[i].pinhole(64), times[i]) for i in range(0, len(rec.names), every)]
    return Medium(**{name: torch.stack([getattr(view, name) for view in views]).mean(0) for name in vars(views[0])})


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


def identifiable_coefficients(rec: Reconstruction) -> dict[str, Bool[Tensor, "3"]]:
    """The coefficients that the frames determine, by the fit of structure from motion."""
    if rec.medium is not None:
        return rec.medium.identifiable
    return {name: torch.zeros(3, dtype=torch.bool) for name in ("Binf", "beta_D", "beta_B")}
