"""Agreement of two-view matches with the poses and intrinsics of a method's own reconstruction.

    F = K_j^-T [t]x R K_i^-1,   d_j = dist(x_j, F x_i),   d_i = dist(x_i, F^T x_j),   error = (d_i + d_j) / 2

in undistorted pixels of the original images, which must be the same grid for every method compared.
"""

from dataclasses import dataclass

import torch
from jaxtyping import Float, Int
from torch import Tensor

from swimm3r.evaluate import NotComputed
from swimm3r.geometry import SymmetricForm, fundamental_from_poses, symmetric_epipolar_error

_CHUNK = 1 << 18  # matches at a time: dense matchers keep millions


@dataclass(frozen=True)
class MatchScores:
    """Agreement of the retained matches with the epipolar geometry of the map."""

    epipolar_px: float | NotComputed  # mean
    inlier_1px: float | NotComputed  # share below 1 px, 0..1
    matches: int
    variant: str


def epipolar_errors(
    i: Int[Tensor, " m"],
    j: Int[Tensor, " m"],
    xy_i: Float[Tensor, "m 2"],
    xy_j: Float[Tensor, "m 2"],
    K: Float[Tensor, "n 3 3"],
    cam2world: Float[Tensor, "n 4 4"],
    form: SymmetricForm = "mean",
) -> Float[Tensor, " m"]:
    """Symmetric epipolar error of each match, px; `i` and `j` index the frames. NaN where both share one center."""
    errors = [xy_i.new_zeros(0, dtype=torch.float64)]
    K, cam2world = K.double(), cam2world.double()
    for a, b, x_a, x_b in zip(*(t.split(_CHUNK) for t in (i, j, xy_i, xy_j)), strict=True):
        F = fundamental_from_poses(cam2world[a], cam2world[b], K[a], K[b])
        errors.append(symmetric_epipolar_error(F, x_a.double(), x_b.double(), form))
    return torch.cat(errors)


def match_scores(errors: Float[Tensor, " m"], pixel_scale: float = 1.0, form: SymmetricForm = "mean") -> MatchScores:
    """Mean and inlier share of `epipolar_errors` of that form; `pixel_scale` is original pixels per pixel of theirs.

    NaN errors (two frames with one center) have no epipolar geometry and are left out.
    """
    errors = errors[~errors.isnan()] * pixel_scale
    variant = f"{form} of both distances"
    if not len(errors):
        none = NotComputed("no match between frames with a baseline")
        return MatchScores(none, none, 0, variant)
    inliers = (errors < 1).double().mean().item()
    return MatchScores(errors.mean().item(), inliers, len(errors), variant)
