"""Depth maps against true ones: AbsRel, delta < 1.25 and RMSE_log, under a named alignment of scale.

    AbsRel = mean |p - g| / g,   delta = share of max(p / g, g / p) < 1.25,   RMSE_log = sqrt(mean (ln p - ln g)^2)

over the pixels where both are known (finite and > 0), then averaged over frames.
"""

from collections.abc import Iterable
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
    pairs: Iterable[tuple[Float[Tensor, "_ _"], Float[Tensor, "_ _"]]],
    align: DepthAlignment = "median",
    max_depth: float | None = None,
) -> DepthScores:
    """Scores of predicted and true depth maps of a sequence, both of z_depth or ray_depth; 0 or not finite is unknown.

    `median` scales each frame by median(true) / median(predicted) over its common pixels, `sequence_median` all frames
    by that of all their pixels together, for which it keeps them; `none` trusts the unit. Pixels truly at `max_depth`
    or beyond do not count.
    """
    frames, kept, known_pixels, scored_pixels = [], [], 0, 0
    for p, g in pairs:
        if p.shape != g.shape:
            raise ValueError(f"a predicted depth map of {tuple(p.shape)} pixels for a true one of {tuple(g.shape)}")
        known = _known(g) & (g < (torch.inf if max_depth is None else max_depth))
        scored = known & _known(p)
        known_pixels, scored_pixels = known_pixels + int(known.sum()), scored_pixels + int(scored.sum())
        if not scored.any():
            continue
        p, g = p[scored].double(), g[scored].double()
        match align:
            case "none":
                frames.append(_frame_scores(p, g))
            case "median":
                frames.append(_frame_scores(_median(g) / _median(p) * p, g))
            case "sequence_median":
                kept.append((p, g))
    if kept:
        scale = _median(torch.cat([g for _, g in kept])) / _median(torch.cat([p for p, _ in kept]))
        frames = [_frame_scores(scale * p, g) for p, g in kept]
    if not frames:
        none = NotComputed("no pixel has both a predicted and a true depth")
        return DepthScores(none, none, none, none, 0, align)
    absrel, delta, rmse_log = torch.tensor(frames, dtype=torch.float64).mean(0).tolist()
    return DepthScores(absrel, 100 * delta, rmse_log, scored_pixels / known_pixels, len(frames), align)


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
