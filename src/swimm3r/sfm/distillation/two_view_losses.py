"""Training losses of the network without water: pointmaps and descriptors against the truth (MASt3R, 3.2).

    l_regr  = |X / s - X* / s*|                    per pixel of both views, all points in the frame of camera 1
    s       = mean |X| over the known pixels of both views; where lengths are metres, s* stands for both
    L_conf  = mean(C l_regr - 0.2 log C)           per view, the views added
    l_match = -log(e_ii / sum_k e_ki) - log(e_ii / sum_k e_ik),      e_ik = exp(D1_i . D2_k / T), each share >= 1e-8
    L_match = mean(Q l_match - 10 log Q),          Q: mean of both descriptors' confidence
    L       = L_conf + 0.075 L_match

The published weights come from these; here they make the small teacher of `benchmarks/learning`.
"""

import math
from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from swimm3r.sfm.mast3r.network import Descriptors, Pointmap

MATCHING_WEIGHT = 0.075
_ALPHA = 0.2  # of log C
_MATCHING_ALPHA = 10.0  # of log Q
_SKY_ERROR = 2.0
_TEMPERATURE = 0.05
_LEAST = 1e-8
LEAST_SHARE = 1e-8
"""Lower bound of each share e_ii / sum, as the reference has it: a rarer match costs no more and has no gradient."""


@dataclass(frozen=True)
class TruePoints:
    """The surface point of every pixel of one view, in the frame of camera 1."""

    points: Float[Tensor, "b h w 3"]
    valid: Bool[Tensor, "b h w"]
    sky: Bool[Tensor, "b h w"] | None = None  # sky or open water: nothing to be found, and the network shall know


@dataclass(frozen=True)
class TrueMatches:
    """Pixels of two views that show one point where `valid`, and pixels drawn anyhow elsewhere: wrong answers to tell
    the right ones from. Whole pixels, flat: y * w + x."""

    index1: Tensor  # int64 [b, n]
    index2: Tensor
    valid: Bool[Tensor, "b n"]


def mean_distance(
    one: Float[Tensor, "b h w 3"],
    valid1: Bool[Tensor, "b h w"],
    two: Float[Tensor, "b h w 3"],
    valid2: Bool[Tensor, "b h w"],
) -> Float[Tensor, " b"]:
    """s: mean distance of the known points of both views from camera 1."""
    total = sum((torch.where(v, p.norm(dim=-1), 0.0).flatten(1).sum(1) for p, v in ((one, valid1), (two, valid2))))
    count = valid1.flatten(1).sum(1) + valid2.flatten(1).sum(1)
    return (total / (count + _LEAST)).clamp(min=_LEAST)


def regression_errors(
    predicted: tuple[Float[Tensor, "b h w 3"], Float[Tensor, "b h w 3"]],
    truth: tuple[TruePoints, TruePoints],
    metric: Bool[Tensor, " b"],
) -> tuple[Float[Tensor, "b h w"], Float[Tensor, "b h w"]]:
    """l_regr of both views, to be read where the truth is valid; `metric` says whose lengths are metres."""
    valid = (truth[0].valid, truth[1].valid)
    true_scale = mean_distance(truth[0].points, valid[0], truth[1].points, valid[1])
    own_scale = mean_distance(predicted[0], valid[0], predicted[1], valid[1])
    scale = torch.where(metric, true_scale, own_scale)[:, None, None, None]
    true_scale = true_scale[:, None, None, None]
    one, two = (
        torch.linalg.vector_norm(p / scale - t.points / true_scale, dim=-1)
        for p, t in zip(predicted, truth, strict=True)
    )
    return one, two


def pointmap_loss(
    predicted: tuple[Pointmap, Pointmap], truth: tuple[TruePoints, TruePoints], metric: Bool[Tensor, " b"]
) -> Float[Tensor, ""]:
    """L_conf, the mean over all known pixels of a batch; in the sky the error counts as 2: confidence shall be low."""
    errors = regression_errors((predicted[0].points, predicted[1].points), truth, metric)
    total = predicted[0].confidence.new_zeros(())
    for error, view, true in zip(errors, predicted, truth, strict=True):
        known = true.valid
        if true.sky is not None:
            error = torch.where(true.sky & ~true.valid, _SKY_ERROR, error)
            known = true.valid | true.sky
        if bool(known.any()):
            confidence = view.confidence[known]
            total = total + (confidence * error[known] - _ALPHA * confidence.log()).mean()
    return total


def matching_errors(
    first: Float[Tensor, "b n d"], second: Float[Tensor, "b n d"], least_share: float = LEAST_SHARE
) -> Float[Tensor, "b n"]:
    """l_match of n rows that belong together, each against all others (InfoNCE, both ways)."""
    similarity = first @ second.mT / _TEMPERATURE
    own = similarity.diagonal(dim1=1, dim2=2)
    most = -math.log(least_share) if least_share > 0 else math.inf
    columns, rows = ((similarity.logsumexp(dim) - own).clamp(max=most) for dim in (1, 2))
    return columns + rows


def matching_loss(
    predicted: tuple[Descriptors, Descriptors], matches: TrueMatches, least_share: float = LEAST_SHARE
) -> Float[Tensor, ""]:
    """L_match over the valid rows of a batch; the others only stand among the wrong answers."""
    rows, confidences = [], []
    for view, index in zip(predicted, (matches.index1, matches.index2), strict=True):
        flat = view.descriptors.flatten(1, 2)
        rows.append(flat.gather(1, index[..., None].expand(-1, -1, flat.shape[-1])))
        confidences.append(view.confidence.flatten(1).gather(1, index))
    confidence = (0.5 * (confidences[0] + confidences[1]))[matches.valid]
    if len(confidence) == 0:
        return confidence.sum()
    error = matching_errors(rows[0], rows[1], least_share)[matches.valid]
    return (error * confidence - _MATCHING_ALPHA * confidence.log()).mean()


def two_view_loss(
    points: tuple[Pointmap, Pointmap],
    descriptors: tuple[Descriptors, Descriptors],
    truth: tuple[TruePoints, TruePoints],
    matches: TrueMatches,
    metric: Bool[Tensor, " b"],
    least_share: float = LEAST_SHARE,
) -> Float[Tensor, ""]:
    """L of a batch of pairs in one direction."""
    return pointmap_loss(points, truth, metric) + MATCHING_WEIGHT * matching_loss(descriptors, matches, least_share)
