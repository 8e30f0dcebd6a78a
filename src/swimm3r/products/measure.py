"""Distances, areas and volumes between picked points, each with the standard deviation that its points and scale cause.

    var f = sum_i g_i^T C_i g_i + (p s f)^2 + sum_k (t_k df/dk)^2

with the gradient g_i by point i, the relative deviation s of the scale, and p = 1, 2, 3 for lengths, areas and volumes.
t_k is the deviation of up about the local axes east and north, by which figures against the level change: where up is
that of the scene, its ground may slope, and their deviation is not known.

Volumes are those between the elevation map and the plane through the points of an outline; the heights of its cells add
cell^2 std sqrt(n) to their deviation.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path

import numpy as np
from jaxtyping import Bool, Float
from scipy.spatial.transform import Rotation

from swimm3r.errors import InputError, UsageError
from swimm3r.io.files.cache_key import cache_key
from swimm3r.products.grid import Grid
from swimm3r.products.habitat.areas import Area
from swimm3r.products.habitat.figures import figures
from swimm3r.products.habitat.tables import Lattice, lies_on_map, squares_inside
from swimm3r.products.picked_points import PickedPoint, picked
from swimm3r.products.record import FOLDER, read_record
from swimm3r.products.survey import Survey, open_survey
from swimm3r.rounding import rounded

_STEP = 1e-4  # of the points' extent, of numeric gradients; of a turn in radians
_GRAVITY_STD_DEG = 1.0  # of up as a camera measured it


@dataclass(frozen=True)
class Measurement:
    """One figure. `std` is None where the scale's, or that of a point or of a level, is not known."""

    name: str
    value: float
    std: float | None
    unit: str

    def __str__(self) -> str:
        std = " (standard deviation not known)" if self.std is None else f" ± {rounded(self.std, 2)}"
        digits = 4 if not self.std or self.value == 0 else max(2, int(np.log10(abs(self.value) / self.std)) + 3)
        return f"{self.name}: {rounded(self.value, min(digits, 9))}{std} {self.unit}"


def measure_run(
    run: Path, distance: Sequence[str] = (), area: Sequence[str] = (), volume: Sequence[str] = ()
) -> list[Measurement]:
    """Lengths along points, areas of and volumes within outlines of points (`picked_points`), in this order.

    Raises UsageError for too few points, InputError where nothing was measured at a point, or where a map is needed
    that the run does not have.
    """
    for name, points, least in (("--distance", distance, 2), ("--area", area, 3), ("--volume", volume, 3)):
        if points and len(points) < least:
            raise UsageError(
                f"{name} needs at least {least} points, got {len(points)}", cause="a slip", hint="further points"
            )
    if not (distance or area or volume):
        raise UsageError("nothing to measure", cause="no option names points", hint="--distance, --area or --volume")
    survey = open_survey(run)
    heights = _stored_heights(survey, needed=bool(volume))
    found: list[Measurement] = []
    if distance:
        found += lengths(_picked(survey, distance, heights), survey)
    if area:
        found += areas(_picked(survey, area, heights), survey, heights)
    if volume and heights is not None:
        found += volumes(_picked(survey, volume, heights), survey, heights)
    return found


def lengths(points: Sequence[PickedPoint], survey: Survey) -> list[Measurement]:
    """Length of each segment, of all together, and what lies between the ends: straight, level and in height."""
    unit = survey.place.unit
    found = []
    for one, other in pairwise(points):
        found.append(_measured(f"{one.text} to {other.text}", [one, other], _length, survey, unit, 1))
    if len(points) > 2:
        found.append(_measured("whole length", points, _length, survey, unit, 1))
    ends = [points[0], points[-1]]
    found.append(_measured("horizontal distance", ends, _level_distance, survey, unit, 1, by_level=True))
    found.append(_measured("difference in height", ends, _rise, survey, unit, 1, by_level=True))
    return found


def areas(points: Sequence[PickedPoint], survey: Survey, heights: Lattice | None) -> list[Measurement]:
    """Area of an outline in its own plane and from above, perimeter, and where there is a map the surface inside."""
    unit = f"{survey.place.unit}²"
    closed = [*points, points[0]]
    found = [
        _measured("area in the plane of the outline", points, _area, survey, unit, 2),
        _measured("area from above", points, _planar_area, survey, unit, 2, by_level=True),
        _measured("perimeter", closed[:-1], _perimeter, survey, survey.place.unit, 1),
    ]
    if heights is not None:
        outline = _outline(points)
        window, own = squares_inside(heights, outline)
        surface = figures(heights.heights(window), heights.spacing, own) if own.any() else None
        if surface is not None:
            planar = _measured("", points, _planar_area, survey, unit, 2)
            ratio = surface.rugosity
            std = None if planar.std is None else planar.std * ratio
            share = _measured_share(heights, outline, surface.coverage * own.sum(), own)
            covered = f"{share:.0%} of it measured, heights every {heights.spacing:.3g} {survey.place.unit}"
            found.append(Measurement(f"area of the surface ({covered})", planar.value * ratio, std, unit))
    return found


def volumes(points: Sequence[PickedPoint], survey: Survey, heights: Lattice) -> list[Measurement]:
    """Volumes above and below the plane of an outline, between it and the elevation map.

    Raises InputError where no height inside was measured.
    """
    outline = _outline(points)
    window, own = squares_inside(heights, outline)
    cells = _cell_heights(heights.heights(window)) if own.any() else np.full(own.shape, np.nan)
    known = own & ~np.isnan(cells)
    if not known.any():
        raise InputError(
            "no height was measured inside of the outline",
            cause="it lies in a hole or outside of the map, or it is smaller than a cell",
            hint="RUN/products/preview_elevation.png shows where there is a map",
        )
    row, column = np.nonzero(known)
    d = heights.spacing
    x = heights.grid.x0 + (window.column + column + 1) * d
    y = heights.grid.y1 - (window.row + row + 1) * d
    z = cells[known] - survey.place.origin[2]
    std = heights.heights(window, "elevation_std")
    noise = float(np.nanmedian(std)) if not np.isnan(std).all() else 0.0
    by_cells = d**2 * noise * float(np.sqrt(len(z)))

    def part(sign: float) -> Callable[[np.ndarray], float]:
        return lambda p: float(np.maximum(sign * (z - _plane_at(p, x, y)), 0).sum() * d**2)

    def net(p: np.ndarray) -> float:
        return float((z - _plane_at(p, x, y)).sum() * d**2)

    share = _measured_share(heights, outline, float(known.sum()), own)
    unit, covered = f"{survey.place.unit}³", f"{share:.0%} of the outline measured"
    kinds = (("above", part(1)), ("below", part(-1)), ("net", net))
    return [
        _measured(f"volume {name} ({covered})", points, volume, survey, unit, 3, by_cells) for name, volume in kinds
    ]


def _picked(survey: Survey, texts: Sequence[str], heights: Lattice | None) -> list[PickedPoint]:
    return [picked(survey, text, heights) for text in texts]


def _measured(
    name: str,
    points: Sequence[PickedPoint],
    function: Callable[[np.ndarray], float],
    survey: Survey,
    unit: str,
    power: int,
    further: float = 0.0,
    *,
    by_level: bool = False,
) -> Measurement:
    """The value of a function of points, with the deviation that points and scale cause, and a further one.

    `by_level`: the value is against the level, and changes where up does.
    """
    xyz = np.stack([point.xyz for point in points])
    value = function(xyz)
    step = max(_STEP * float(np.ptp(xyz, axis=0).max()), 1e-9)
    variance = further**2
    for i, point in enumerate(points):
        gradient = np.zeros(3)
        for axis in range(3):
            moved = [xyz.copy(), xyz.copy()]
            moved[0][i, axis] += step
            moved[1][i, axis] -= step
            gradient[axis] = (function(moved[0]) - function(moved[1])) / (2 * step)
        variance += float(gradient @ point.covariance @ gradient)
    metric, scale_std = survey.place.scale is not None, survey.place.scale_std
    known = all(point.known for point in points) and not (metric and scale_std is None)
    variance += (power * (scale_std or 0.0) * value) ** 2
    if by_level:
        tilt = _tilt_std(survey)
        known = known and tilt is not None
        variance += 0.0 if tilt is None else float(((tilt * _by_turn(xyz, function)) ** 2).sum())
    return Measurement(name, value, float(np.sqrt(variance)) if known else None, unit)


def _tilt_std(survey: Survey) -> Float[np.ndarray, "2"] | None:
    """Standard deviations of up about local east and north, radians; None where up is that of the scene."""
    if survey.place.rotation_std_deg is not None:
        return np.radians(survey.place.rotation_std_deg[:2])
    return None if survey.rec.up is None else np.radians([_GRAVITY_STD_DEG] * 2)


def _by_turn(p: Float[np.ndarray, "n 3"], function: Callable[[np.ndarray], float]) -> Float[np.ndarray, "2"]:
    """Derivatives of a function of points by their turn about local east and north."""
    middle, found = p.mean(0), []
    for axis in np.eye(3)[:2]:
        ends = [function(middle + Rotation.from_rotvec(side * _STEP * axis).apply(p - middle)) for side in (1, -1)]
        found.append((ends[0] - ends[1]) / (2 * _STEP))
    return np.array(found)


def _level_distance(p: Float[np.ndarray, "2 3"]) -> float:
    return float(np.hypot(*(p[1] - p[0])[:2]))


def _rise(p: Float[np.ndarray, "2 3"]) -> float:
    return float(p[1, 2] - p[0, 2])


def _length(p: Float[np.ndarray, "n 3"]) -> float:
    return float(np.linalg.norm(np.diff(p, axis=0), axis=1).sum())


def _perimeter(p: Float[np.ndarray, "n 3"]) -> float:
    return _length(np.concatenate([p, p[:1]]))


def _area(p: Float[np.ndarray, "n 3"]) -> float:
    return float(np.linalg.norm(_area_vector(p)))


def _planar_area(p: Float[np.ndarray, "n 3"]) -> float:
    return float(abs(_area_vector(p)[2]))


def _area_vector(p: Float[np.ndarray, "n 3"]) -> Float[np.ndarray, "3"]:
    away = p - p.mean(0)
    return np.cross(away, np.roll(away, -1, 0)).sum(0) / 2


def _plane_at(p: Float[np.ndarray, "n 3"], x: np.ndarray, y: np.ndarray) -> np.ndarray:
    """Heights of the plane fitted to points."""
    middle = p.mean(0)
    slopes = np.linalg.lstsq(p[:, :2] - middle[:2], p[:, 2] - middle[2], rcond=None)[0]
    return middle[2] + slopes[0] * (x - middle[0]) + slopes[1] * (y - middle[1])


def _cell_heights(values: Float[np.ndarray, "h w"]) -> Float[np.ndarray, "h1 w1"]:
    """Heights in the middle of the squares between four."""
    return (values[:-1, :-1] + values[:-1, 1:] + values[1:, :-1] + values[1:, 1:]) / 4


def _measured_share(heights: Lattice, outline: Area, squares: float, own: Bool[np.ndarray, "h w"]) -> float:
    """Share of an outline that so many measured squares make up, by the squares inside of it that are on the map."""
    if lies_on_map(heights, outline):
        return squares / float(own.sum())
    return min(1.0, squares * heights.spacing**2 / outline.exact_area)


def _outline(points: Sequence[PickedPoint]) -> Area:
    return Area("outline", ((np.stack([point.xyz[:2] for point in points]),),))


def _stored_heights(survey: Survey, *, needed: bool) -> Lattice | None:
    """The elevation map of a run, cell by cell; None where it has none and none is needed.

    Raises InputError where it was made before the run's scale or place changed.
    """
    folder = survey.folder / FOLDER
    record = read_record(folder)
    if record is None:
        if not needed:
            return None
        raise InputError(
            f"{survey.folder} has no elevation map, which volumes are measured on",
            cause="the map products were not made yet",
            hint=f"swimm3r products {survey.folder}",
        )
    if record.place != cache_key(survey.place):
        raise InputError(
            f"the maps in {folder} were made with another scale or place than the run has now",
            cause="swimm3r scale, or structure from motion anew, after swimm3r products",
            hint=f"swimm3r products {survey.folder}, which makes them again",
        )
    g, origin = survey.place.grid_scale, survey.place.origin
    x0, y1 = (record.west - origin[0]) / g, (record.north - origin[1]) / g
    return Lattice(Grid(x0, y1, record.gsd / g, record.rows, record.columns), survey.place, 1, folder)
