"""The offset between two clocks: that under which the path of the cameras fits the navigation best.

The fit of a straight path at constant speed is the same under every offset; the standard deviation, from the curvature
of the sum of squares at its least, tells.
"""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

from swimm3r.io.navigation.record import Navigation
from swimm3r.scale.navigation.alignment import umeyama
from swimm3r.scale.navigation.matching import FEWEST, FrameTimes

_STEPS = 4000  # of a coarse search, at most
_FINEST = 1e-3  # seconds
_LEAST_STD = 2e-3  # metres, of any position
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
    count, variance = _misfit(navigation, path, best)
    # the sum of squares is count * misfit / variance; half of its second derivative is 1 / std^2
    reach = max(2 * step, 4 * _FINEST)
    sides = [fit(best - reach), fit(best + reach)]
    curvature = (sum(sides) - 2 * variance) / reach**2
    freedom = max(1, 3 * count - 8)
    std = (
        np.sqrt(2 * (variance + _LEAST_STD**2) / (curvature * freedom))
        if curvature > 0 and np.isfinite(curvature)
        else np.inf
    )
    return Offset(best, float(std))


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
    source, target = source[rows], navigation.position[rows]
    fit = _heights if navigation.has_heights_alone else _similar
    weight = np.ones(len(source))
    squared = np.zeros(len(source))
    for _ in range(3):
        squared = fit(source, target, weight)
        weight = 1 / (1 + squared / (4 * np.median(squared) + 1e-12))
    return len(source), float(weight @ squared / weight.sum())


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
