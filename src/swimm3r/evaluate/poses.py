"""Errors of estimated camera poses against reference poses, up to one similarity of the world.

Relative errors take every pair i < j. The relative pose is W_i W_j^-1 (the VGGT convention: the baseline as camera i
sees it; seen from j its direction error is another number wherever rotations are wrong). RRA and RTA are the shares
of pairs strictly below a threshold, mAA(30) the area under the accuracy curve of max(rotation, translation) over
whole-degree bins up to 30. A pair with an unregistered frame is a failure of 180 degrees.
"""

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Literal

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from swimm3r.evaluate import NotComputed
from swimm3r.geometry import (
    DegenerateAlignmentError,
    align_poses,
    align_similarity,
    mean_rotation,
    relative_poses,
    rotation_angle,
)

SeenFrom = Literal["i", "j"]
Curve = Literal["histogram", "trapezoid"]
_NO_BASELINE = NotComputed("no pair of registered frames has a baseline in the reference")
_BLOCK = 1 << 16  # pairs at a time: 10,000 frames have 50 million


@dataclass(frozen=True)
class RelativePoseErrors:
    """Errors of the relative poses of all pairs i < j, degrees; 180 where a frame is not registered."""

    pairs: Int[Tensor, "pairs 2"]
    rotation: Float[Tensor, " pairs"]
    translation: Float[Tensor, " pairs"]  # between the baselines' directions, 0..180
    baseline: Float[Tensor, " pairs"]  # length of the reference's, in its unit
    registered: Bool[Tensor, " pairs"]

    @property
    def sign_blind_translation(self) -> Float[Tensor, " pairs"]:
        """Angle between the baselines as lines, 0..90, as RTA counts it; 180 where a frame is not registered."""
        folded = torch.minimum(self.translation, 180 - self.translation)
        return torch.where(self.registered, folded, self.translation)


@dataclass(frozen=True)
class AbsolutePoseErrors:
    """Errors of the registered poses after alignment with the reference."""

    ate: float | NotComputed  # RMSE of the camera centers, in the reference's unit
    rotation_deg: float  # mean over frames, after the rotation that fits the orientations best
    rotation_median_deg: float
    alignment: str  # of the ATE: "centers" (Umeyama), or "poses" where the centers lie on a line


@dataclass(frozen=True)
class PoseScores:
    """Scores of the tables and `summary.json`; percentages over all pairs, unregistered frames count as failures."""

    rra15: float  # %
    rta15: float  # %
    maa30: float  # %
    rotation_deg: float | NotComputed
    translation_deg: float | NotComputed  # mean angle between relative translations of registered pairs, 0..180
    ate: float | NotComputed
    registered: int
    frames: int
    variant: str  # the conventions behind the numbers


def relative_pose_errors(
    cam2world: Float[Tensor, "n 4 4"],
    reference: Float[Tensor, "n 4 4"],
    registered: Bool[Tensor, " n"] | None = None,
    seen_from: SeenFrom = "i",
) -> RelativePoseErrors:
    """Rotation and baseline errors of every pair; poses of unregistered frames are not looked at.

    A baseline of no length has no direction and stands at 90 degrees from any other.
    """
    blocks = list(_blocks(cam2world, reference, _all_if_none(registered, cam2world), seen_from))
    return RelativePoseErrors(
        **{name: torch.cat([getattr(block, name) for block in blocks]) for name in vars(blocks[0])}
    )


def _blocks(
    cam2world: Float[Tensor, "n 4 4"],
    reference: Float[Tensor, "n 4 4"],
    registered: Bool[Tensor, " n"],
    seen_from: SeenFrom = "i",
) -> Iterator[RelativePoseErrors]:
    """`relative_pose_errors` a block of pairs after the other, so that memory does not grow with their number."""
    _check_finite(cam2world[registered], "estimated")
    _check_finite(reference, "reference")
    n, row = len(cam2world), 0
    while True:  # once without any pair, too
        rows = max(1, _BLOCK // max(1, n - row))
        pairs = torch.triu_indices(min(rows, n - row), n - row, 1).mT + row
        yield _errors_of(pairs, cam2world, reference, registered, seen_from)
        row += rows
        if row >= n - 1:
            return


def _errors_of(
    pairs: Int[Tensor, "pairs 2"],
    cam2world: Float[Tensor, "n 4 4"],
    reference: Float[Tensor, "n 4 4"],
    registered: Bool[Tensor, " n"],
    seen_from: SeenFrom,
) -> RelativePoseErrors:
    first, second = pairs.unbind(-1) if seen_from == "i" else pairs.flip(-1).unbind(-1)
    found = relative_poses(cam2world[first], cam2world[second])
    true = relative_poses(reference[first], reference[second])
    both = registered[first] & registered[second]
    rotation = torch.rad2deg(rotation_angle(true[:, :3, :3].mT @ found[:, :3, :3]))
    translation = _angle_between(found[:, :3, 3], true[:, :3, 3])
    return RelativePoseErrors(
        pairs=pairs,
        rotation=torch.where(both, rotation, 180.0),
        translation=torch.where(both, translation, 180.0),
        baseline=true[:, :3, 3].norm(dim=-1),
        registered=both,
    )


def rra(errors: RelativePoseErrors, threshold: float) -> float:
    """Relative rotation accuracy: the percentage of pairs below `threshold` degrees."""
    return _percentage(errors.rotation < threshold)


def rta(errors: RelativePoseErrors, threshold: float) -> float:
    """Relative translation accuracy: the percentage of pairs with baselines, as lines, within `threshold` degrees."""
    return _percentage(errors.sign_blind_translation < threshold)


def maa(errors: RelativePoseErrors, limit: int = 30, curve: Curve = "histogram") -> float:
    """Mean average accuracy of max(rotation, sign-blind translation) up to `limit` degrees, percent.

    `histogram` averages the accuracies at 1, 2, ..., `limit` degrees, the last bin closed (PoseDiffusion, VGGT);
    `trapezoid` integrates the recall between the errors themselves (COLMAP's benchmark): a few hundredths more or less.
    """
    worst = torch.maximum(errors.rotation, errors.sign_blind_translation)
    if not len(worst):
        raise ValueError("the accuracy of no pairs is undefined: at least 2 frames are needed")
    if curve == "histogram":
        steps = torch.arange(1, limit + 1, dtype=worst.dtype)
        below = worst[:, None] < steps
        below[:, -1] |= worst == limit
        return _percentage(below)
    inside = worst[worst < limit].sort().values
    recall = torch.arange(len(inside) + 1, dtype=worst.dtype) / len(worst)
    at = torch.cat((worst.new_zeros(1), inside, worst.new_full((1,), limit)))
    return 100 * torch.trapezoid(torch.cat((recall, recall[-1:])), at).item() / limit


def absolute_pose_errors(cam2world: Float[Tensor, "n 4 4"], reference: Float[Tensor, "n 4 4"]) -> AbsolutePoseErrors:
    """ATE after the similarity that fits the centers, rotation errors after the rotation that fits the orientations.

    Two alignments, because a nearly straight track leaves the turn about it to the noise of the centers, which says
    nothing about the orientations.
    """
    if not len(cam2world):
        raise ValueError("no poses to compare")
    _check_finite(cam2world, "estimated")
    _check_finite(reference, "reference")
    turn = mean_rotation(reference[:, :3, :3] @ cam2world[:, :3, :3].mT)
    rotation = torch.rad2deg(rotation_angle(reference[:, :3, :3].mT @ turn @ cam2world[:, :3, :3]))
    alignment = "centers"
    try:
        similarity = align_similarity(cam2world[:, :3, 3], reference[:, :3, 3])
    except DegenerateAlignmentError:
        alignment = "poses"
        try:
            similarity = align_poses(cam2world, reference)
        except DegenerateAlignmentError as failure:
            similarity = NotComputed(str(failure))
    if isinstance(similarity, NotComputed):
        ate = similarity
    else:
        offsets = similarity.points(cam2world[:, :3, 3]) - reference[:, :3, 3]
        ate = (offsets**2).sum(-1).mean().sqrt().item()
    return AbsolutePoseErrors(
        ate=ate,
        rotation_deg=rotation.mean().item(),
        rotation_median_deg=rotation.quantile(0.5).item(),
        alignment=alignment,
    )


def pose_scores(
    cam2world: Float[Tensor, "n 4 4"],
    reference: Float[Tensor, "n 4 4"],
    registered: Bool[Tensor, " n"] | None = None,
) -> PoseScores:
    """Every pose score of one sequence of at least 2 frames; rows of `cam2world` count where `registered`."""
    registered = _all_if_none(registered, cam2world)
    relative = _relative_scores(cam2world, reference, registered)
    variant = "pairs i<j, W_i W_j^-1, sign-blind RTA, whole-degree mAA"
    if registered.sum() < 2:
        too_few = NotComputed(f"{int(registered.sum())} of {len(registered)} frames registered, at least 2 are needed")
        rotation_deg = translation_deg = ate = too_few
    else:
        absolute = absolute_pose_errors(cam2world[registered], reference[registered])
        rotation_deg, ate = absolute.rotation_deg, absolute.ate
        translation_deg = relative.translation_deg
        variant += f", ATE aligned by {absolute.alignment}"
    return PoseScores(
        rra15=relative.rra15,
        rta15=relative.rta15,
        maa30=relative.maa30,
        rotation_deg=rotation_deg,
        translation_deg=translation_deg,
        ate=ate,
        registered=int(registered.sum()),
        frames=len(registered),
        variant=variant,
    )


@dataclass(frozen=True)
class _RelativeScores:
    rra15: float  # %
    rta15: float  # %
    maa30: float  # %
    translation_deg: float | NotComputed


def _relative_scores(
    cam2world: Float[Tensor, "n 4 4"], reference: Float[Tensor, "n 4 4"], registered: Bool[Tensor, " n"]
) -> _RelativeScores:
    """The scores of all pairs, which are never held together."""
    longest = _longest_baseline(reference)
    percent, pairs = torch.zeros(3, dtype=torch.float64), 0
    angle, directed = 0.0, 0
    for errors in _blocks(cam2world, reference, registered):
        n = len(errors.pairs)
        percent += n * torch.tensor([rra(errors, 15.0), rta(errors, 15.0), maa(errors, 30)], dtype=torch.float64)
        counted = _with_baseline(errors, longest)
        angle += errors.translation[counted].sum().item()
        pairs, directed = pairs + n, directed + int(counted.sum())
    rra15, rta15, maa30 = (percent / pairs).tolist()
    return _RelativeScores(rra15, rta15, maa30, angle / directed if directed else _NO_BASELINE)


def mean_translation_error(errors: RelativePoseErrors) -> float | NotComputed:
    """Mean angle between estimated and true relative translations (signed, 0..180) over registered pairs, degrees.

    Pairs whose true baseline is under a millionth of the longest have no direction and are left out.
    """
    counted = _with_baseline(errors, errors.baseline.max().item())
    return errors.translation[counted].mean().item() if counted.any() else _NO_BASELINE


def _with_baseline(errors: RelativePoseErrors, longest: float) -> Bool[Tensor, " pairs"]:
    return errors.registered & (errors.baseline > 1e-6 * longest)


def _longest_baseline(reference: Float[Tensor, "n 4 4"]) -> float:
    centers = reference[:, :3, 3]
    rows = centers.split(max(1, _BLOCK // max(1, len(centers))))
    return max((torch.cdist(some, centers).max().item() for some in rows), default=0.0)


def _angle_between(a: Float[Tensor, "n 3"], b: Float[Tensor, "n 3"]) -> Float[Tensor, " n"]:
    # atan2 of sine and cosine: acos loses half the digits near 0
    angle = torch.rad2deg(torch.atan2(torch.linalg.cross(a, b).norm(dim=-1), (a * b).sum(-1)))
    directed = (a.norm(dim=-1) > 0) & (b.norm(dim=-1) > 0)
    return torch.where(directed, angle, 90.0)


def _percentage(hits: Bool[Tensor, "..."]) -> float:
    if not hits.numel():
        raise ValueError("the accuracy of no pairs is undefined: at least 2 frames are needed")
    return 100 * hits.double().mean().item()


def _all_if_none(registered: Bool[Tensor, " n"] | None, poses: Float[Tensor, "n 4 4"]) -> Bool[Tensor, " n"]:
    return torch.ones(len(poses), dtype=torch.bool) if registered is None else registered


def _check_finite(poses: Float[Tensor, "n 4 4"], which: str) -> None:
    if not torch.isfinite(poses).all():
        raise ValueError(f"the {which} poses are not all finite")
