"""The problem of a sparse global alignment: frames, matches and priors, checked, and laid out flat for the optimizer.

Frames may differ in size, pairs in their number of matches: everything is concatenated over frames (n), anchors (a) and
points (p = 2 m: the sides i of all matches, then the sides j), with the frame each entry belongs to beside it.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Bool, Float, Int64
from torch import Tensor

from swimm3r.errors import RegistrationError, UsageError
from swimm3r.sfm.alignment.canonical import AnchoredFrame, CanonicalView, anchors_of
from swimm3r.sfm.alignment.kinematic_tree import KinematicTree, kinematic_tree
from swimm3r.sfm.features.pair_graph import groups
from swimm3r.sfm.mast3r.matching import PixelMatches
from swimm3r.sfm.mast3r.settings import AlignmentSettings


@dataclass(frozen=True)
class Predicted:
    """Anchors of one frame in another frame's camera as the network predicts them, for pairs without matches."""

    points: Float[Tensor, "a 3"]
    confidence: Float[Tensor, " a"]


@dataclass(frozen=True)
class AnchoredPair:
    """The matches of frames i and j: pixels, the anchors of their blocks, and their depth relative to those."""

    i: int
    j: int
    xy_i: Int64[Tensor, "m 2"]
    xy_j: Int64[Tensor, "m 2"]
    anchor_i: Int64[Tensor, " m"]
    anchor_j: Int64[Tensor, " m"]
    relative_i: Float[Tensor, " m"]
    relative_j: Float[Tensor, " m"]
    confidence: Float[Tensor, " m"]
    i_in_j: Predicted | None = None  # needed only where no match exceeds the confidence threshold
    j_in_i: Predicted | None = None


def anchored_pair(
    pair: tuple[int, int], matches: PixelMatches, views: tuple[CanonicalView, CanonicalView], subsample: int = 8
) -> AnchoredPair:
    """Matches of two frames, hung on the anchors of their canonical views."""
    anchor_i, relative_i = anchors_of(views[0], matches.xy1, subsample)
    anchor_j, relative_j = anchors_of(views[1], matches.xy2, subsample)
    return AnchoredPair(*pair, matches.xy1, matches.xy2, anchor_i, anchor_j, relative_i, relative_j, matches.confidence)


@dataclass(frozen=True)
class Known:
    """Prior knowledge; pixels are the network's, their centers at +0.5."""

    K: Float[Tensor, "n 3 3"] | None = None
    cam2world: Float[Tensor, "n 4 4"] | None = None
    posed: Bool[Tensor, " n"] | None = None  # for which frames; None: for all


@dataclass(frozen=True)
class AlignmentProblem:
    """Everything that stays constant during an alignment."""

    size: Float[Tensor, "n 2"]  # width, height
    focal: Float[Tensor, " n"]  # every frame's own first one, which its depths and relative depths belong to
    start_focal: Float[Tensor, " n"]  # where the optimization starts
    median: Float[Tensor, " n"]
    confidence: Float[Tensor, " n"]
    anchor_ratio: Float[Tensor, " a"]  # depth / median
    anchor_frame: Int64[Tensor, " a"]
    point_frame: Int64[Tensor, " p"]
    point_xy: Float[Tensor, "p 2"]
    point_anchor: Int64[Tensor, " p"]
    point_relative: Float[Tensor, " p"]
    match_confidence: Float[Tensor, " m"]  # 0 where the pair failed
    failed_point: Int64[Tensor, " f"]
    failed_frame: Int64[Tensor, " f"]
    failed_target: Float[Tensor, "f 3"]
    failed_confidence: Float[Tensor, " f"]
    tree: KinematicTree
    pixel_center: float
    known_K: Float[Tensor, "n 3 3"] | None
    known_pose: Float[Tensor, "n 4 4"] | None
    posed: Bool[Tensor, " n"]

    @staticmethod
    def of(
        frames: Sequence[AnchoredFrame], pairs: Sequence[AnchoredPair], settings: AlignmentSettings, known: Known
    ) -> "AlignmentProblem":
        """Raises the errors of `optimize.align`."""
        _check(frames, pairs, settings, known)
        center = 0.0 if settings.parity else 0.5
        counts = [len(f.anchor_depth) for f in frames]
        first = np.cumsum([0, *counts])
        sides = [(p.i, p.xy_i, p.anchor_i, p.relative_i) for p in pairs]
        sides += [(p.j, p.xy_j, p.anchor_j, p.relative_j) for p in pairs]
        frame = torch.cat([torch.full((len(xy),), f) for f, xy, _, _ in sides])
        passes = [bool((p.confidence > settings.confidence_threshold).any()) for p in pairs]
        median = torch.stack([f.anchor_depth.median() for f in frames])
        K, focal, start = _focal_lengths(frames, settings, known, center)
        anchor_frame = torch.repeat_interleave(torch.arange(len(frames)), torch.tensor(counts))
        pose = None if known.cam2world is None else known.cam2world.float()
        posed = known.posed if known.posed is not None else torch.full((len(frames),), pose is not None)
        return AlignmentProblem(
            size=torch.tensor([[f.width, f.height] for f in frames], dtype=torch.float32),
            focal=focal,
            start_focal=start,
            median=median,
            confidence=torch.tensor([f.confidence for f in frames]),
            anchor_ratio=torch.cat([f.anchor_depth for f in frames]) / median[anchor_frame],
            anchor_frame=anchor_frame,
            point_frame=frame,
            point_xy=torch.cat([xy for _, xy, _, _ in sides]).float() + center,
            point_anchor=torch.cat([anchor + int(first[f]) for f, _, anchor, _ in sides]),
            point_relative=torch.cat([relative for _, _, _, relative in sides]).float(),
            match_confidence=torch.cat([p.confidence * ok for p, ok in zip(pairs, passes, strict=True)]).float(),
            **_failed(pairs, passes, frame, torch.cat([anchor for _, _, anchor, _ in sides])),
            tree=kinematic_tree(_match_counts(pairs, len(frames)), counts, settings.tree),
            pixel_center=center,
            known_K=K,
            known_pose=pose,
            posed=posed,
        )

    @property
    def aspect(self) -> Float[Tensor, " n"]:
        """fy / fx of every frame, which is never optimized."""
        if self.known_K is None:
            return torch.ones(len(self.focal))
        return self.known_K[:, 1, 1] / self.known_K[:, 0, 0]


def _focal_lengths(
    frames: Sequence[AnchoredFrame], settings: AlignmentSettings, known: Known, center: float
) -> tuple[Tensor | None, Tensor, Tensor]:
    """Known intrinsics, with the principal point of pixel centers at `center`; focal lengths; and those to start at."""
    focal = torch.tensor([f.focal for f in frames])
    K = None
    if known.K is not None:
        K = known.K.float().clone()
        K[:, :2, 2] += center - 0.5
        focal = K[:, 0, 0].clone()
    if settings.intrinsics != "shared":
        return K, focal, focal
    weight = torch.tensor([f.confidence for f in frames])
    return K, focal, ((focal * weight).sum() / weight.sum()).expand(len(frames)).clone()


def _match_counts(pairs: Sequence[AnchoredPair], frames: int) -> np.ndarray:
    """Number of matches of every two frames, symmetric."""
    matches = np.zeros((frames, frames))
    for p in pairs:
        matches[p.i, p.j] = matches[p.j, p.i] = len(p.confidence)
    return matches


def _failed(
    pairs: Sequence[AnchoredPair], passes: list[bool], point_frame: Tensor, point_anchor: Tensor
) -> dict[str, Tensor]:
    """The pointmap targets of all points of both frames of every pair without a confident match."""
    points, frames, targets, confidences = [], [], [], []
    for pair, ok in zip(pairs, passes, strict=True):
        if ok:
            continue
        for frame, other, predicted in ((pair.i, pair.j, pair.i_in_j), (pair.j, pair.i, pair.j_in_i)):
            if predicted is None:
                raise ValueError(f"the pair {pair.i}, {pair.j} has no confident match and no predicted anchors")
            mine = (point_frame == frame).nonzero()[:, 0]
            points.append(mine)
            frames.append(torch.full_like(mine, other))
            targets.append(predicted.points[point_anchor[mine]].float())
            confidences.append(predicted.confidence[point_anchor[mine]].float())
    none = torch.zeros(0, dtype=torch.int64)
    return {
        "failed_point": torch.cat([none, *points]),
        "failed_frame": torch.cat([none, *frames]),
        "failed_target": torch.cat([torch.zeros(0, 3), *targets]),
        "failed_confidence": torch.cat([torch.zeros(0), *confidences]),
    }


def _check(
    frames: Sequence[AnchoredFrame], pairs: Sequence[AnchoredPair], settings: AlignmentSettings, known: Known
) -> None:
    n = len(frames)
    if settings.intrinsics in ("prior", "fixed") and known.K is None:
        raise UsageError(
            f"intrinsics cannot be {settings.intrinsics!r}: none are known",
            cause="no calibration was given",
            hint="give one, or take intrinsics free or shared",
        )
    matched = [(p.i, p.j) for p in pairs if len(p.confidence)]
    if not matched:
        raise RegistrationError(
            f"not one pixel of the {n} frames matches between any two of them",
            cause="the frames show different places, or open water only",
            hint="a clip with the bottom in view and more overlap",
        )
    if len(parts := groups(n, matched)) > 1:
        sizes = ", ".join(str(len(part)) for part in parts[:5]) + (" ..." if len(parts) > 5 else "")
        raise RegistrationError(
            f"the frames fall into {len(parts)} groups without a match between them, of {sizes} frames",
            cause="a cut in the clip, or a stretch of open water",
            hint="take the longest stretch only, more frames per second, or a graph with more pairs",
        )
