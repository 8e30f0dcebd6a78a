"""Depth maps against true ones: AbsRel, delta < 1.25 and RMSE_log, under a named alignment of scale.

    AbsRel = mean |p - g| / g,   delta = share of max(p / g, g / p) < 1.25,   RMSE_log = sqrt(mean (ln p - ln g)^2)

over the pixels where both are known (finite and > 0), then averaged over frames.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from swimm3r.evaluate import NotComputed

DepthAlignment = Literal["none", "median", "sequence_median"]


@dataclass(frozen=True)
class DepthScores:
    """Means over the frames that have scored pixels."""

    absrel: float | NotComputed
    delta_125: float | NotComputed  # %
    rmse_log: float | NotComputed
    coverage: float | NotComputed  # share of the truly known pixels that were scored, 0..1
    frames: int  # scored
    variant: str  # the alignment, as "median"


def depth_scores(
    predicted: Sequence[Float[Tensor, "_ _"]],
    true: Sequence[Float[Tensor, "_ _"]],
    align: DepthAlignment = "median",
    max_depth: float | None = None,
) -> DepthScores:
    """Scores of a sequence of depth maps, both of z_depth or both of ray_depth; 0 or not finite means unknown.

    `median` scales each frame by median(true) / median(predicted) over its common pixels, `sequence_median` all frames
    by that of all their pixels together, `none` trusts the unit. Pixels truly at `max_depth` or beyond do not count.
    """
    if len(predicted) != len(true):
        raise ValueError(f"{len(predicted)} predicted depth maps for {len(true)} true ones")
    pairs, known_pixels = [], 0
    for p, g in zip(predicted, true, strict=True):
        if p.shape != g.shape:
            raise ValueError(f"a predicted depth map of {tuple(p.shape)} pixels for a true one of {tuple(g.shape)}")
        known = _known(g) & (g < (torch.inf if max_depth is None else max_depth))
        known_pixels += int(known.sum())
        scored = known & _known(p)
        if scored.any():
            pairs.append((p[scored].double(), g[scored].double()))
    if not pairs:
        none = NotComputed("no pixel has both a predicted and a true depth")
        return DepthScores(none, none, none, none, 0, align)
    match align:
        case "none":
            scales = [1.0] * len(pairs)
        case "median":
            scales = [_median(g) / _median(p) for p, g in pairs]
        case "sequence_median":
            scales = [_median(torch.cat([g for _, g in pairs])) / _median(torch.cat([p for p, _ in pairs]))] * len(
                pairs
            )
    scored = [_frame_scores(s * p, g) for s, (p, g) in zip(scales, pairs, strict=True)]
    frames = torch.tensor(scored, dtype=torch.float64)
    absrel, delta, rmse_log = frames.mean(0).tolist()
    coverage = sum(len(g) for _, g in pairs) / known_pixels
    return DepthScores(absrel, 100 * delta, rmse_log, coverage, len(pairs), align)


def _frame_scores(p: Float[Tensor, " n"], g: Float[Tensor, " n"]) -> tuple[float, float, float]:
    absrel = ((p - g).abs() / g).mean()
    delta = (torch.maximum(p / g, g / p) < 1.25).double().mean()
    rmse_log = ((p.log() - g.log()) ** 2).mean().sqrt()
    return absrel.item(), delta.item(), rmse_log.item()


def _known(depth: Float[Tensor, "h w"]) -> Bool[Tensor, "h w"]:
    return torch.isfinite(depth) & (depth > 0)


def _median(values: Float[Tensor, " n"]) -> float:
    # torch.median takes the lower of the two middle values, torch.quantile refuses more than 16 million
    ordered, n = values.sort().values, len(values)
    return ((ordered[(n - 1) // 2] + ordered[n // 2]) / 2).item()
