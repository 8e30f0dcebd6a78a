"""One scale of many sources: weighted robust least squares on its logarithm.

    log s = sum w_i log s_i / sum w_i,   w_i = h_i / std_i^2

h_i are Tukey's biweights of the residuals in units of their standard deviations, found from the weighted median on.
Where sources agree worse than their standard deviations say, the result's grows by the same factor.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from swimm3r.errors import InputError

_BIWEIGHT = 4.685  # of Tukey: 95% efficiency under Gaussian noise
_ROUNDS = 50
_DISAGREE = 5.0  # standard deviations between two sources, of which nothing tells the wrong one
_WORTH_TELLING = 0.02  # relative difference below which two sources are only averaged


@dataclass(frozen=True)
class ScaleEstimate:
    """Metres per unit of the run by one source; `std` is relative, of the logarithm."""

    source: str  # as "scale bar 1", "marker 17", "navigation"
    scale: float
    std: float
    detail: str = ""

    def __post_init__(self) -> None:
        if not (self.scale > 0 and math.isfinite(self.scale) and self.std > 0):
            raise ValueError(f"{self.source} gives the scale {self.scale} with the standard deviation {self.std}")


@dataclass(frozen=True)
class SourceResidual:
    """A source beside the result: its residual as a share, and in its own standard deviations."""

    estimate: ScaleEstimate
    residual: float
    in_std: float
    is_outlier: bool


@dataclass(frozen=True)
class ScaleSolution:
    """Metres per unit of the run, its relative standard deviation, and what every source says."""

    scale: float
    std: float
    sources: tuple[SourceResidual, ...]

    @property
    def outliers(self) -> tuple[SourceResidual, ...]:
        """Sources that the others contradict; the result does not follow them."""
        return tuple(each for each in self.sources if each.is_outlier)


def solve_scale(estimates: Sequence[ScaleEstimate], outlier: float = 4.0) -> ScaleSolution:
    """The scale that the sources agree on. Raises InputError where there are none, or two that contradict each other.

    `outlier` is the residual in standard deviations from which a source is named an outlier.
    """
    if not estimates:
        raise InputError(
            "no source gives the scale of this run",
            cause="no marker was found, or the sources given tell the place alone",
            hint="--scale-bar, --markers, --nav or another source; swimm3r scale --help lists them",
        )
    logs = np.log([each.scale for each in estimates])
    stds = np.array([each.std for each in estimates])
    if len(estimates) == 2:
        _check_pair(estimates[0], estimates[1])
    middle = _weighted_median(logs, 1 / stds**2)
    weights = np.ones_like(logs)
    for _ in range(_ROUNDS):
        away = (logs - middle) / (stds * _spread(logs, stds, middle))
        weights = np.where(np.abs(away) < _BIWEIGHT, (1 - (away / _BIWEIGHT) ** 2) ** 2, 0.0)
        if len(estimates) < 3 or not weights.any():
            weights = np.ones_like(logs)
        total = weights / stds**2
        before, middle = middle, float(total @ logs / total.sum())
        if abs(middle - before) < 1e-12:
            break
    in_std = (logs - middle) / stds
    outlying = np.abs(in_std) > outlier if len(estimates) > 2 else np.zeros(len(logs), bool)
    total = weights / stds**2
    kept = weights > 0
    chi = float((weights * in_std**2).sum() / max(1, kept.sum() - 1))
    std = math.sqrt(max(1.0, chi) / total.sum())
    rows = zip(estimates, logs, in_std, outlying, strict=True)
    return ScaleSolution(
        math.exp(middle),
        std,
        tuple(SourceResidual(e, math.expm1(x - middle), float(r), bool(o)) for e, x, r, o in rows),
    )


def _spread(logs: np.ndarray, stds: np.ndarray, middle: float) -> float:
    """The factor by which residuals exceed their standard deviations, robustly; at least 1."""
    return max(1.0, 1.4826 * float(np.median(np.abs(logs - middle) / stds))) if len(logs) > 2 else 1.0


def _check_pair(one: ScaleEstimate, other: ScaleEstimate) -> None:
    difference = math.log(one.scale / other.scale)
    if abs(difference) > max(_DISAGREE * math.hypot(one.std, other.std), _WORTH_TELLING):
        raise InputError(
            f"{one.source} and {other.source} contradict each other: {one.scale:.5g} and {other.scale:.5g} m per unit,"
            f" {100 * abs(math.expm1(difference)):.1f}% apart with {100 * math.hypot(one.std, other.std):.1f}% of"
            " standard deviation",
            cause="a wrong length or unit of one of the two; nothing tells which",
            hint="a third source; or leave the wrong one out",
        )


def _weighted_median(values: np.ndarray, weights: np.ndarray) -> float:
    order = np.argsort(values)
    share = np.cumsum(weights[order]) / weights.sum()
    return float(values[order][np.searchsorted(share, 0.5)])
