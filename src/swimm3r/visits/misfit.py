"""One visit brought onto another, and the uncertainty of its place on the other's ground.

Check points, averaged over neighborhoods of the site, show the bends that are left: the error of a single point is its
own and no matter of the ground. The covariance of the similarity adds what grows away from the shared points.
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
_LEAST_CHECKS = 4


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
    level, up = _left(placed.check, a.place, alignment)
    return Fit(name_a, "images", placed.rec, alignment, len(placed.check.xyz_a), level, up)


def misfit_at(earlier: Fit | None, later: Fit | None, ground: Ground, grid: Grid, georeference: Georeference) -> Misfit:
    """The misfit of two visits on the earlier one's ground; one that was not aligned with the other adds its own."""
    fits = [fit for fit in (earlier, later) if fit is not None]
    if later is not None and earlier is not None and later.onto != earlier.onto:
        fits = [later]
    x, y = grid.centers(Window(0, 0, grid.rows, grid.columns))
    height = np.where(np.isnan(ground.height), np.nanmedian(ground.height), ground.height)
    step = max(1, min(grid.rows, grid.columns) // 64)  # the covariance is smooth
    coarse = np.stack(np.broadcast_arrays(x[None, ::step], y[::step, None], height[::step, ::step]), -1)
    shape, points = coarse.shape[:2], georeference.from_local(coarse.reshape(-1, 3).astype(np.float64))
    variance = np.zeros(shape)
    for fit in fits:
        up = georeference.up
        along = np.einsum("i,nij,j->n", up, fit.alignment.covariance_at(points), up)
        variance += along.reshape(shape) * (georeference.scale or 1.0) ** 2
    rows, columns = np.minimum(np.arange(grid.rows) // step, shape[0] - 1), np.arange(grid.columns) // step
    up_at = np.sqrt(variance)[np.ix_(rows, np.minimum(columns, shape[1] - 1))]
    return Misfit(
        level=float(np.sqrt(sum(fit.level**2 for fit in fits))),
        up=float(np.sqrt(sum(fit.up**2 for fit in fits))),
        up_at=up_at,
    )


def _left(check: CheckPoints, georeference: Georeference, alignment: Alignment) -> tuple[float, float]:
    """Horizontal and vertical standard deviation of neighborhoods of check points, local units."""
    if len(check.xyz_a) < _LEAST_CHECKS:
        scale = georeference.scale or 1.0
        sizes = np.sqrt(np.trace(alignment.covariance[4:, 4:]) / 3) * scale
        return float(sizes), float(sizes)
    off = georeference.to_local(check.xyz_b - check.xyz_a)
    nearby = _neighborhoods(georeference.to_local(check.xyz_a)[:, :2])
    middle = np.median(off[nearby], axis=1)
    spread = np.sqrt(np.median(middle**2, axis=0)) * _MAD
    return float(np.hypot(*spread[:2]) / np.sqrt(2)), float(spread[2])


def _neighborhoods(xy: Float[np.ndarray, "n 2"]) -> Int[np.ndarray, "n k"]:
    """Each point with its nearest ones."""
    nearby: Any = KDTree(xy).query(xy, k=min(_NEIGHBORS, len(xy)))[1]
    return nearby
