"""One visit brought onto another, and the uncertainty of its place on the other's ground.

Check points, averaged over neighborhoods of the site, show the bends that are left: the error of a single point is its
own and no matter of the ground. m_j is the offset of the neighborhood nearest to a cell, d its distance:

    s^2 = max(s_0, |m_j|)^2 + (r d)^2,   s_0 = 1.4826 median |m|,   r = median |m_i - m_j| / |x_i - x_j|

so that the uncertainty grows away from the points that both visits share. With too few check points, the covariance of
the similarity takes their place.
"""

from dataclasses import dataclass
from typing import Any

import numpy as np
from jaxtyping import Float, Int
from scipy.spatial import KDTree

from swimm3r.errors import RegistrationError
from swimm3r.products.grid import Grid, Window
from swimm3r.products.survey import Survey
from swimm3r.progress import Progress
from swimm3r.scene.georeference import Georeference
from swimm3r.scene.reconstruction import Reconstruction
from swimm3r.visits.adjustment import CheckPoints, place
from swimm3r.visits.alignment import Alignment, align, by_georeference
from swimm3r.visits.change import Misfit
from swimm3r.visits.ground import Ground
from swimm3r.visits.matches import Landmarks, match_visits
from swimm3r.visits.settings import VisitSettings

_NEIGHBORS = 8  # check points of a neighborhood
_MAD = 1.4826
_LEAST_CHECKS = 10
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
        nearest: Any = KDTree(self.xy).query(xy)
        distance, j = nearest
        rng = np.random.default_rng(0)
        one, other = rng.integers(len(self.xy), size=(2, _PAIRS))
        apart = np.linalg.norm(self.xy[one] - self.xy[other], axis=1)
        told = apart > np.median(apart) / 4  # nearer ones share check points
        off = np.column_stack([np.hypot(self.off[:, 0], self.off[:, 1]) / np.sqrt(2), np.abs(self.off[:, 2])])
        change = np.column_stack([
            np.linalg.norm(self.off[one, :2] - self.off[other, :2], axis=1) / np.sqrt(2),
            np.abs(self.off[one, 2] - self.off[other, 2]),
        ])  # fmt: skip
        rate = np.median(change[told] / apart[told, None], axis=0) if told.any() else np.zeros(2)
        level, up = (np.hypot(np.maximum(least, off[j, k]), rate[k] * distance) for k, least in enumerate(self.spread))
        return level, up


@dataclass(frozen=True)
class Fit:
    """A visit brought onto another one, in the axes and unit of the first visit's files."""

    onto: str
    source: str
    rec: Reconstruction
    alignment: Alignment
    check_points: int
    level: float  # standard deviation of its place on the other's ground, horizontal per axis, local units
    up: float
    bends: Bends | None = None  # None with too few check points


def align_visit(
    onto: tuple[str, Survey, list[Landmarks]],
    visit: tuple[str, Survey, list[Landmarks]],
    settings: VisitSettings,
    progress: Progress,
) -> Fit:
    """The fit of a visit onto a placed one, each with its name and landmarks.

    By images where enough points agree, else by georeferences where both runs have one. Raises RegistrationError
    where neither tells.
    """
    (name_a, a, landmarks_a), (name_b, b, landmarks_b) = onto, visit
    matches = match_visits(landmarks_a, landmarks_b, settings, progress)
    try:
        alignment = align(a.rec, b.rec, matches, (name_a, name_b))
    except RegistrationError:
        known = by_georeference(a, b)
        if known is None:
            raise
        alignment, level, up = known
        moved = place(a.rec, b.rec, matches.select(np.zeros(0, np.int64)), alignment)
        return Fit(name_a, "georeference", moved.rec, alignment, 0, level, up)
    placed = place(a.rec, b.rec, matches, alignment)
    checks = len(placed.check.xyz_a)
    if checks < _LEAST_CHECKS:
        size = float(np.sqrt(np.trace(alignment.covariance[4:, 4:]) / 3)) * a.scale
        return Fit(name_a, "images", placed.rec, alignment, checks, size, size)
    bends = _bends(placed.check, a.place)
    return Fit(name_a, "images", placed.rec, alignment, checks, *bends.spread, bends)


def misfit_at(earlier: Fit | None, later: Fit | None, ground: Ground, grid: Grid, georeference: Georeference) -> Misfit:
    """The misfit of two visits on the earlier one's ground; one that was not aligned with the other adds its own."""
    fits = [fit for fit in (earlier, later) if fit is not None]
    if later is not None and earlier is not None and later.onto != earlier.onto:
        fits = [later]
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
    up = georeference.up
    along = np.einsum("i,nij,j->n", up, fit.alignment.covariance_at(georeference.from_local(points)), up)
    return np.full(len(points), fit.level), np.sqrt(along * (georeference.scale or 1.0) ** 2 + fit.up**2)


def _bends(check: CheckPoints, georeference: Georeference) -> Bends:
    xy = georeference.to_local(check.xyz_a)[:, :2]
    off = georeference.to_local(check.xyz_b) - georeference.to_local(check.xyz_a)
    nearby = _neighborhoods(xy)
    return Bends(np.median(xy[nearby], axis=1), np.median(off[nearby], axis=1))


def _neighborhoods(xy: Float[np.ndarray, "n 2"]) -> Int[np.ndarray, "n k"]:
    """Each point with its nearest ones."""
    nearby: Any = KDTree(xy).query(xy, k=min(_NEIGHBORS, len(xy)))[1]
    return nearby
