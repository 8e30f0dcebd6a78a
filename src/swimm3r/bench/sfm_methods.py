"""The ways of structure from motion as settings, or the reason why one cannot be run here; and their common scores."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import torch

from swimm3r import weights
from swimm3r.bench.settings import SfmMethod, SfmMethods
from swimm3r.evaluate import NotComputed
from swimm3r.evaluate.matches import match_scores
from swimm3r.evaluate.poses import pose_scores
from swimm3r.pipeline.run_settings import with_poses_of
from swimm3r.pipeline.summary import match_errors
from swimm3r.progress import Progress
from swimm3r.scene.frames import Frames
from swimm3r.scene.ground_truth import GroundTruth
from swimm3r.scene.reconstruction import Matches, Reconstruction
from swimm3r.scene.reconstruction_io import unfiltered_matches
from swimm3r.sfm.medium.dense_tracks import count_tracks
from swimm3r.sfm.medium.settings import TrackSettings
from swimm3r.sfm.settings import ColmapModelSettings, ColmapSettings, Mast3rSettings, SfmSettings


def settings_for(
    method: SfmMethod, scene: str, given: SfmMethods, colmap: ColmapSettings, mast3r: Mast3rSettings
) -> SfmSettings | NotComputed:
    """The settings that run a method on a scene; NotComputed where its weights, adapter or model are missing."""
    match method:
        case "colmap-incremental" | "colmap-global":
            kind = "global" if method == "colmap-global" else "incremental"
            return replace(colmap, mapping=replace(colmap.mapping, method=kind))
        case "gluemap" | "spann3r" | "vggt":
            return _imported(method, scene, given, colmap)
    if weights.find("mast3r", mast3r.weights) is None:
        return NotComputed("the weights 'mast3r' are not on this computer (swimm3r weights get mast3r)")
    if method == "mast3r":
        return replace(mast3r, adapter=None)
    if given.adapters is None:
        return NotComputed("no adapter was given (--adapters DIR, trained by swimm3r train-sfm)")
    adapter = given.adapters / method / "adapter.safetensors"
    if not adapter.is_file():
        return NotComputed(f"there is no {adapter} (swimm3r train-sfm DATA --recipe {method} --out {adapter.parent})")
    return replace(mast3r, adapter=adapter)


@dataclass(frozen=True)
class Uncapped:
    """The counts of a map before its points and matches are thinned for later stages."""

    matches: Matches
    dense_points: int

    @staticmethod
    def of(folder: Path, rec: Reconstruction, frames: Frames, tracks: TrackSettings, progress: Progress) -> "Uncapped":
        """Of a run's sfm folder; the dense points are counted over every pixel of known depth."""
        return Uncapped(unfiltered_matches(folder, rec), count_tracks(rec, frames, tracks, progress))


def model_scores(
    rec: Reconstruction | None, uncapped: Uncapped | None, frames: int, pixels: float
) -> dict[str, float | NotComputed]:
    """Scores of a reconstruction by its own data (the paper's SfM metrics); None without a reconstruction.

    `frames` were asked for; `pixels` is original pixels per pixel of the frames.
    """
    if rec is None or uncapped is None:
        nothing = NotComputed("too few frames could be placed")
        missing = dict.fromkeys(("epipolar_mean_px", "inlier_1px_pct"), nothing)
        return {"registered_pct": 0.0, **missing, "points": 0.0, "dense_points": 0.0}
    agreement = match_scores(match_errors(rec, uncapped.matches), pixels)
    inliers = agreement.inlier_1px
    return {
        "registered_pct": 100 * len(rec.names) / frames,
        "epipolar_mean_px": agreement.epipolar_px,
        "inlier_1px_pct": inliers if isinstance(inliers, NotComputed) else 100 * inliers,
        "points": float(len(rec.points.xyz) if rec.points_found is None else rec.points_found),
        "dense_points": float(uncapped.dense_points),
    }


def reference_scores(
    rec: Reconstruction | None, names: Sequence[str], truth: GroundTruth | NotComputed
) -> dict[str, float | NotComputed]:
    """RRA@15, RTA@15 and mAA(30) over the pairs of frames that the reference knows; unplaced frames are failures."""
    scores = ("rra15", "rta15", "maa30")
    if isinstance(truth, NotComputed):
        return dict.fromkeys(scores, truth)
    rows = {name: row for row, name in enumerate(truth.names)}
    wanted = [name for name in names if name in rows]
    known = 100 * len(wanted) / len(names)
    if len(wanted) < 2:
        few = NotComputed(f"the reference knows {len(wanted)} of the {len(names)} frames")
        return {**dict.fromkeys(scores, few), "reference_pct": known}
    placed = {} if rec is None else {name: pose for name, pose in zip(rec.names, rec.cameras.cam2world, strict=True)}
    nowhere = torch.eye(4, dtype=torch.float64)
    found = torch.stack([placed.get(name, nowhere).double() for name in wanted])
    true = truth.cameras.cam2world[[rows[name] for name in wanted]].double()
    errors = pose_scores(found, true, torch.tensor([name in placed for name in wanted]))
    return {"rra15": errors.rra15, "rta15": errors.rta15, "maa30": errors.maa30, "reference_pct": known}


def _imported(
    method: SfmMethod, scene: str, given: SfmMethods, colmap: ColmapSettings
) -> ColmapModelSettings | NotComputed:
    if given.imports is None:
        return NotComputed(f"no models of {method} were given (--imports DIR with DIR/{method}/{scene})")
    folder = given.imports / method
    found = [folder / scene] if (folder / scene).exists() else sorted(folder.glob(f"{scene}.*"))
    if not found:
        return NotComputed(f"there is no {folder / scene}")
    return with_poses_of(found[0], colmap)
