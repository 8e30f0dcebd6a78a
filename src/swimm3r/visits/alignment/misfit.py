"""One visit brought onto another, and the uncertainty of its place on the other's ground.

Check points, averaged over neighborhoods of the site, show the bends that are left: the error of a single point is its
own and no matter of the ground. m_j are the offsets of neighborhoods at distances d_j from a cell, d the smallest:

    s^2 = max(s_0^2, m^2) + (r d)^2,   m^2 = sum d_j^-2 m_j^2 / sum d_j^-2,   s_0 = 1.4826 median |m_j|,
    r = median |m_i - m_j| / |x_i - x_j|

Beside a neighborhood m is its offset, far away the root mean square of many: one of them may be small by chance. The
uncertainty grows away from the points that both visits share. With too few check points, the covariance of the
similarity takes their place.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from jaxtyping import Float, Int
from scipy.spatial import KDTree

from swimm3r.products.grid import Grid, Window
from swimm3r.scene.georeference import Georeference
from swimm3r.visits.alignment.joint import CheckPoints
from swimm3r.visits.alignment.similarity import Alignment
from swimm3r.visits.change import Misfit
from swimm3r.visits.ground import Ground

_NEIGHBORS = 8  # check points of a neighborhood
_MAD = 1.4826
_LEAST_CHECKS = 10
_AROUND = 64  # nearest neighborhoods that tell the offset at a cell
_PAIRS = 2000  # of neighborhoods, whose offsets tell how fast bends change


@dataclass(frozen=True)
class Bends:
    """Offsets of neighborhoods of check points, local axes and units."""

    xy: Float[np.ndarray, "n 2"]
    off: Float[np.ndarray, "n 3"]  # of the later visit from the earlier one

    @property
    def spread(self) -> tuple[float, float]:
        """Standard deviation of a typical neighborhood, horizontal per axis and vertical."""
        x, y, up = np.sqrt(np.median(self.off**2, axis=0)) * _MAD
        return float(np.hypot(x, y) / np.sqrt(2)), float(up)

    def at(self, xy: Float[np.ndarray, "k 2"]) -> tuple[Float[np.ndarray, " k"], Float[np.ndarray, " k"]]:
        """Horizontal and vertical standard deviation at places."""
        count = min(_AROUND, len(self.xy))
        tree: Any = KDTree(self.xy)
        distance, j = tree.query(xy, k=np.arange(1, count + 1))
        rng = np.random.default_rng(0)
        one, other = rng.integers(len(self.xy), size=(2, _PAIRS))
        apart = np.linalg.norm(self.xy[one] - self.xy[other], axis=1)
        told = apart > np.median(apart) / 4  # nearer ones share check points
        squared = np.column_stack([(self.off[:, :2] ** 2).mean(1), self.off[:, 2] ** 2])
        weight = 1 / np.maximum(distance, 1e-9 * max(float(np.ptp(self.xy)), 1.0)) ** 2
        off = np.sqrt(np.einsum("kn,knc->ck", weight, squared[j]) / weight.sum(1))
        change = np.column_stack([
            np.linalg.norm(self.off[one, :2] - self.off[other, :2], axis=1) / np.sqrt(2),
            np.abs(self.off[one, 2] - self.off[other, 2]),
        ])  # fmt: skip
        rate = np.median(change[told] / apart[told, None], axis=0) if told.any() else np.zeros(2)
        level, up = (
            np.hypot(np.maximum(least, off[k]), rate[k] * distance[:, 0]) for k, least in enumerate(self.spread)
        )
        return level, up


@dataclass(frozen=True)
class Fit:
    """The way a visit came onto an earlier one, and how well it lies there."""

    onto: str  # name of the earlier visit
    alignment: Alignment  # of its files with the earlier visit, in the axes and unit of the first visit's files
    check_points: int
    merged: int  # matches that joint mapping took for one point of both visits
    error_px: float | None  # median reprojection error of these; None without joint mapping
    level: float  # standard deviation of its place on the other's ground, horizontal per axis, local units
    up: float
    bends: Bends | None  # None with too few check points


def fit_of(
    onto: str, alignment: Alignment, joint: tuple[CheckPoints, int, float] | None, georeference: Georeference
) -> Fit:
    """The fit by check points, or by the covariance of the similarity where these are few.

    `joint` are check points, merged matches and their error after joint mapping; None where there was none.
    """
    check, merged, error = joint or (CheckPoints(np.zeros((0, 3)), np.zeros((0, 3))), 0, None)
    if len(check) >= _LEAST_CHECKS:
        bends = _bends(check, georeference)
        level, up = bends.spread
    else:
        bends = None
        levels, ups = _stds_by_covariance(alignment, georeference.to_local(alignment.pivot[None]), georeference)
        level, up = float(levels[0]), float(ups[0])
    return Fit(onto, alignment, len(check), merged, error, level, up, bends)


def fits_between(earlier: str, later: str, fits: Mapping[str, Fit | None]) -> list[Fit]:
    """The fits that lead from one visit to another, by way of those that they were aligned with."""
    chains: list[list[str]] = []
    for name in (earlier, later):
        chain: list[str] = []
        at = name
        while (fit := fits[at]) is not None:
            chain.append(at)
            at = fit.onto
        chains.append(chain)
    apart = [name for chain in chains for name in chain if not all(name in each for each in chains)]
    return [fit for name in apart if (fit := fits[name]) is not None]


def misfit_at(fits: Sequence[Fit], ground: Ground, grid: Grid, georeference: Georeference) -> Misfit:
    """The misfit of two visits on the earlier one's ground, by the fits that lead from one to the other."""
    x, y = grid.centers(Window(0, 0, grid.rows, grid.columns))
    height = np.where(np.isnan(ground.height), np.nanmedian(ground.height), ground.height)
    step = max(1, min(grid.rows, grid.columns) // 64)  # bends and covariance are smooth
    coarse = np.stack(np.broadcast_arrays(x[None, ::step], y[::step, None], height[::step, ::step]), -1)
    shape, points = coarse.shape[:2], coarse.reshape(-1, 3).astype(np.float64)
    variance = np.zeros((2, *shape))
    for fit in fits:
        variance += np.stack(_stds(fit, points, georeference)).reshape(2, *shape) ** 2
    rows, columns = np.minimum(np.arange(grid.rows) // step, shape[0] - 1), np.arange(grid.columns) // step
    level, up = np.sqrt(variance)[:, rows[:, None], np.minimum(columns, shape[1] - 1)[None]]
    return Misfit(level, up)


def _stds(
    fit: Fit, points: Float[np.ndarray, "n 3"], georeference: Georeference
) -> tuple[Float[np.ndarray, " n"], Float[np.ndarray, " n"]]:
    """Horizontal and vertical standard deviation of a fit at local points."""
    if fit.bends is not None:
        return fit.bends.at(points[:, :2])
    return _stds_by_covariance(fit.alignment, points, georeference)


def _stds_by_covariance(
    alignment: Alignment, points: Float[np.ndarray, "n 3"], georeference: Georeference
) -> tuple[Float[np.ndarray, " n"], Float[np.ndarray, " n"]]:
    R, scale = georeference.R, georeference.scale or 1.0
    local = R @ alignment.covariance_at(georeference.from_local(points)) @ R.T
    x, y, up = scale * np.sqrt(np.diagonal(local, axis1=1, axis2=2)).T
    return np.hypot(x, y) / np.sqrt(2), up


def _bends(check: CheckPoints, georeference: Georeference) -> Bends:
    xy = georeference.to_local(check.xyz_a)[:, :2]
    off = georeference.to_local(check.xyz_b) - georeference.to_local(check.xyz_a)
    nearby = _neighborhoods(xy)
    return Bends(np.median(xy[nearby], axis=1), np.median(off[nearby], axis=1))


def _neighborhoods(xy: Float[np.ndarray, "n 2"]) -> Int[np.ndarray, "n k"]:
    """Each point with its nearest ones."""
    nearby: Any = KDTree(xy).query(xy, k=min(_NEIGHBORS, len(xy)))[1]
    return nearby
