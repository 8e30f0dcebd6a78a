"""The offset between two clocks: that under which the path of the cameras fits the navigation best.

The fit of a straight path at constant speed is the same under every offset; the standard deviation, from the curvature
of the sum of squares at its least, tells. The weights of the least are held for it, and the variance of positions is
that of their median: rows far off count less, so that a weighted mean of squares is a fifth below the variance.
"""

from collections.abc import Callable
from dataclasses import dataclass
from typing import TypeAlias

import numpy as np
from jaxtyping import Float

from swimm3r.io.navigation.record import Navigation
from swimm3r.scale.navigation.alignment import umeyama
from swimm3r.scale.navigation.matching import FEWEST, FrameTimes

_STEPS = 4000  # of a coarse search, at most
_FINEST = 1e-3  # seconds
_LEAST_STD = 2e-3  # metres, of any position
_Fit: TypeAlias = Callable[[np.ndarray, np.ndarray, np.ndarray], np.ndarray]
_REACH = 0.02  # seconds on either side of the best offset, over which the curvature is taken
_ROUNDS = 3  # of reweighting
_UNKNOWNS = 8  # a similarity and the offset
_MEDIAN_1, _MEDIAN_3 = 0.455, 2.366  # of the chi-squared distribution of 1 and of 3 degrees of freedom
_ENOUGH = 0.6  # of the positions that overlap at best: offsets with fewer are not compared


@dataclass(frozen=True)
class Offset:
    """Seconds that are added to the frames' times; `std` is infinite where the path does not show it."""

    seconds: float
    std: float


def find_offset(
    navigation: Navigation,
    times: FrameTimes,
    centers: Float[np.ndarray, "c 3"],
    limits: tuple[float, float],
    max_gap: float,
) -> Offset | None:
    """The offset within limits; None where none leaves 3 positions on the path."""
    low, high = limits
    spacing = float(np.median(np.diff(np.unique(times.seconds)))) if len(centers) > 1 else 1.0
    step = max((high - low) / _STEPS, min(spacing / 4, max((high - low) / 8, _FINEST)))
    grid = np.arange(low, high + step / 2, step)
    path = _camera_path(times, centers, max_gap)
    misfits = [_misfit(navigation, path, offset) for offset in grid.tolist()]
    most = max((count for count, _ in misfits), default=0)
    if most < FEWEST:
        return None
    least = max(FEWEST, int(_ENOUGH * most))
    cost = np.array([misfit if count >= least else np.inf for count, misfit in misfits])
    at = int(cost.argmin())

    def fit(offset: float) -> float:
        return _misfit(navigation, path, offset)[1]

    best = _least(fit, max(low, grid[at] - step), min(high, grid[at] + step))
    return Offset(best, _std(navigation, path, best))


def _std(navigation: Navigation, path: "_CameraPath", best: float) -> float:
    """The standard deviation of the best offset; infinite where the fit is no worse on either side."""
    inside, source = path.at(navigation.time - best)
    rows = inside > 0
    target, fit = navigation.position[rows], _fit_of(navigation)
    squared, weight = _residuals(source[rows], target, fit)
    axes, middle = (1, _MEDIAN_1) if navigation.has_heights_alone else (3, _MEDIAN_3)
    freedom = max(1, axes * len(target) - _UNKNOWNS) / (axes * len(target))
    variance = float(np.median(squared)) / middle / freedom + _LEAST_STD**2
    sides = [fit(path.at(navigation.time - best + side)[1][rows], target, weight) for side in (-_REACH, _REACH)]
    # the weighted sum of squares over the variance is chi^2; half of its second derivative is the information
    curvature = float(weight @ (sides[0] + sides[1] - 2 * squared)) / _REACH**2
    return float(np.sqrt(2 * variance / curvature)) if curvature > 0 and np.isfinite(curvature) else np.inf


@dataclass(frozen=True)
class _CameraPath:
    """The cameras' path between frames, as a smooth curve; navigation is noisy, and interpolated noise is less."""

    curve: Callable[[np.ndarray], np.ndarray]
    seconds: Float[np.ndarray, " c"]
    max_gap: float

    def at(self, moments: Float[np.ndarray, " n"]) -> tuple[Float[np.ndarray, " n"], Float[np.ndarray, "n 3"]]:
        """Marks (1) of moments between frames that follow closely, and the places at all moments."""
        after = np.clip(np.searchsorted(self.seconds, moments), 1, len(self.seconds) - 1)
        near = self.seconds[after] - self.seconds[after - 1] <= self.max_gap
        inside = (moments >= self.seconds[0]) & (moments <= self.seconds[-1]) & near
        return inside.astype(np.float64), self.curve(moments)


def _camera_path(times: FrameTimes, centers: Float[np.ndarray, "c 3"], max_gap: float) -> _CameraPath:
    from scipy.interpolate import CubicSpline

    seconds, first = np.unique(times.seconds, return_index=True)
    return _CameraPath(CubicSpline(seconds, centers[first]), seconds, max_gap)


def _misfit(navigation: Navigation, path: _CameraPath, offset: float) -> tuple[int, float]:
    """Number of positions on the path, and their mean squared distance under the best similarity, robustly."""
    inside, source = path.at(navigation.time - offset)
    rows = inside > 0
    if rows.sum() < FEWEST:
        return int(rows.sum()), np.inf
    squared, weight = _residuals(source[rows], navigation.position[rows], _fit_of(navigation))
    return int(rows.sum()), float(weight @ squared / weight.sum())


def _fit_of(navigation: Navigation) -> _Fit:
    return _heights if navigation.has_heights_alone else _similar


def _residuals(
    source: Float[np.ndarray, "n 3"], target: Float[np.ndarray, "n 3"], fit: _Fit
) -> tuple[Float[np.ndarray, " n"], Float[np.ndarray, " n"]]:
    """Squared distances under the best similarity, and the weights of the rows in it."""
    weight, squared = np.ones(len(source)), np.zeros(len(source))
    for _ in range(_ROUNDS):
        squared = fit(source, target, weight)
        weight = 1 / (1 + squared / (4 * np.median(squared) + 1e-12))
    return squared, weight


def _similar(source: np.ndarray, target: np.ndarray, weight: np.ndarray) -> np.ndarray:
    """Squared distances under the best similarity."""
    scale, R, t = umeyama(source, target, weight)
    return ((scale * source @ R.T + t - target) ** 2).sum(1)


def _heights(source: np.ndarray, target: np.ndarray, weight: np.ndarray) -> np.ndarray:
    """Squared differences of heights under the best scale and direction up."""
    rows = np.column_stack([source - source.mean(0), np.ones(len(source))])
    root = np.sqrt(weight)
    found = np.linalg.lstsq(rows * root[:, None], target[:, 2] * root, rcond=1e-6)[0]
    return (rows @ found - target[:, 2]) ** 2


def _least(fit: Callable[[float], float], low: float, high: float) -> float:
    """Golden-section search."""
    ratio = (np.sqrt(5) - 1) / 2
    inner = [high - ratio * (high - low), low + ratio * (high - low)]
    values = [fit(inner[0]), fit(inner[1])]
    while high - low > _FINEST:
        if values[0] < values[1]:
            high, inner[1], values[1] = inner[1], inner[0], values[0]
            inner[0] = high - ratio * (high - low)
            values[0] = fit(inner[0])
        else:
            low, inner[0], values[0] = inner[0], inner[1], values[1]
            inner[1] = low + ratio * (high - low)
            values[1] = fit(inner[1])
    return float((low + high) / 2)
