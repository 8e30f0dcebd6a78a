"""Ground control: points with known coordinates, marked in frames; a similarity by some, residuals at all.

    name, easting, northing, depth | latitude, longitude, depth  [, std] [, role]      --control; role: control or check

Heights may stand for depths; names of columns and units are those of navigation files. Check points take no part in the
fit: their residuals tell its accuracy.
"""

from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path as FilePath
from typing import Literal

import numpy as np
from jaxtyping import Float

from swimm3r.errors import InputError
from swimm3r.io.files.damage import Remedy, guard
from swimm3r.io.navigation.record import Navigation, check_coordinates
from swimm3r.io.navigation.table import read_cells, read_positions
from swimm3r.scale.navigation.alignment import GROUND_STD, Alignment, Path, align
from swimm3r.scale.navigation.place import LocalNavigation, Place, localized
from swimm3r.scale.settings import ScaleSettings
from swimm3r.scale.triangulation import ScenePoint

_FEWEST = 3  # control points
_ON_A_LINE = 0.02  # spread across the main direction, as a share of that along it
_OFF = 5.0  # standard deviations at a control point, from which the points are refused
_REMEDY = Remedy(
    "a CSV with name, easting, northing, depth or latitude, longitude, depth",
    cause="a slip in the name, or another kind of file",
    fault="cannot be read",
)


@dataclass(frozen=True)
class ControlPoint:
    """Residual of a point: the run's place less the stated one, metres east, north and up."""

    name: str
    role: Literal["control", "check"]
    residual: tuple[float, float, float]
    std: tuple[float, float, float]


@dataclass(frozen=True)
class ControlFit:
    """A run aligned by control points."""

    alignment: Alignment
    place: Place
    points: tuple[ControlPoint, ...]
    center: Float[np.ndarray, "3"]  # of the control points, in the run
    notes: tuple[str, ...] = ()

    def rms(self, role: Literal["control", "check"]) -> float | None:
        """Root mean square residual of the points of a role, metres; None without any."""
        squared = [sum(v * v for v in point.residual) for point in self.points if point.role == role]
        return float(np.sqrt(np.mean(squared))) if squared else None


def fit_control(
    points: Mapping[str, ScenePoint], up: Float[np.ndarray, "3"], settings: ScaleSettings, place: Place | None = None
) -> ControlFit:
    """The similarity by control points. Raises InputError that names what is wrong with them."""
    assert settings.control is not None
    local, roles, std = _read(settings.control, settings, place)
    names = local.navigation.names or ()
    seen = np.array([name in points for name in names])
    notes = [f"Point {name} of {settings.control.name} is marked in no frame." for name in names if name not in points]
    role = np.array(roles)
    used = np.flatnonzero(seen & (role == "control"))
    if len(used) < _FEWEST:
        raise InputError(
            f"{len(used)} control points of {settings.control} are marked in frames, and {_FEWEST} are needed",
            cause=f"names differ: {', '.join(names[:4])} in the one file, {', '.join(list(points)[:4])} in the other",
            hint="the same names in --points and --control; or fewer points with the role check",
        )
    chosen = [points[names[i]] for i in used]
    xyz = np.stack([point.xyz for point in chosen])
    spread = np.linalg.svd(xyz - xyz.mean(0), compute_uv=False)
    if spread[1] < _ON_A_LINE * spread[0]:
        raise InputError(
            f"the control points of {settings.control} lie on a line",
            cause="they leave the turn about it open",
            hint="a point beside the line; or navigation",
        )
    pairs = _Pairs(
        names=tuple(names[i] for i in used),
        xyz=xyz,
        covariance=np.stack([point.covariance for point in chosen]),
        coordinates=local.navigation.position[used],
        std=std[used],
        up=up,
        outlier=settings.outlier,
    )
    alignment = pairs.aligned()
    _check(alignment, pairs, settings.control)
    found = []
    for i in np.flatnonzero(seen).tolist():
        point = points[names[i]]
        residual = alignment.scale * alignment.R @ point.xyz + alignment.t - local.navigation.position[i]
        errors = np.sqrt(np.diag(alignment.scale**2 * alignment.R @ point.covariance @ alignment.R.T) + std[i] ** 2)
        found.append(ControlPoint(names[i], roles[i], _triple(residual), _triple(errors)))
    return ControlFit(alignment, local.place, tuple(found), xyz.mean(0), tuple(notes))


def _read(
    file: FilePath, settings: ScaleSettings, place: Place | None
) -> tuple[LocalNavigation, list[Literal["control", "check"]], Float[np.ndarray, "n 3"]]:
    """Points in local metres, their roles and standard deviations."""
    with guard(file, _REMEDY):
        cells, columns = read_cells(file)
        frame, position, std = read_positions(file, cells, columns)
    if "name" not in cells:
        raise InputError(f"{file} has no column name", cause="another table", hint=_REMEDY.hint)
    names = tuple(cells["name"])
    if len(set(names)) < len(names):
        twice = next(name for name in names if names.count(name) > 1)
        raise InputError(f"{file} has two points named {twice}", cause="a slip", hint="one row per point")
    words = [word.lower() or "control" for word in cells.get("role", ["control"] * len(names))]
    wrong = [word for word in words if word not in ("control", "check")]
    if wrong:
        raise InputError(f"{file} has the role {wrong[0]!r}", cause="a slip", hint="control or check")
    roles: list[Literal["control", "check"]] = ["check" if word == "check" else "control" for word in words]
    time = np.arange(len(names), dtype=np.float64)
    given = np.full((len(names), 3), settings.control_std) if std is None else std
    given = np.where(np.isnan(given), settings.control_std, given)
    record = Navigation(file, frame, position, "names", time, names)
    check_coordinates(record)
    return localized(record, settings, place), roles, given


@dataclass(frozen=True)
class _Pairs:
    """Control points in the run and as they are stated."""

    names: tuple[str, ...]
    xyz: Float[np.ndarray, "n 3"]
    covariance: Float[np.ndarray, "n 3 3"]  # of xyz
    coordinates: Float[np.ndarray, "n 3"]  # local metres
    std: Float[np.ndarray, "n 3"]  # of the coordinates
    up: Float[np.ndarray, "3"]  # in the run
    outlier: float

    def aligned(self) -> Alignment:
        """The similarity, errors of the marks turned to metres by a first one."""
        first = self._align(self.std)
        marks = first.scale**2 * np.diagonal(first.R @ self.covariance @ first.R.T, axis1=1, axis2=2)
        return self._align(np.sqrt(self.std**2 + marks))

    def _align(self, std: Float[np.ndarray, "n 3"]) -> Alignment:
        eye = np.tile(np.eye(3), (len(self.xyz), 1, 1))
        path = Path(self.xyz, eye, self.coordinates, std, None, np.zeros((len(self.xyz), 3)), self.up, GROUND_STD)
        return align(path, ScaleSettings(outlier=self.outlier))

    def without(self, k: int) -> "_Pairs":
        """All points but one."""
        kept = np.arange(len(self.xyz)) != k
        names = tuple(name for i, name in enumerate(self.names) if i != k)
        arrays = {name: getattr(self, name)[kept] for name in ("xyz", "covariance", "coordinates", "std")}
        return replace(self, names=names, **arrays)

    def swapped(self) -> "_Pairs":
        """East as north and north as east."""
        order = [1, 0, 2]
        return replace(self, coordinates=self.coordinates[:, order], std=self.std[:, order])


def _check(found: Alignment, pairs: _Pairs, file: FilePath) -> None:
    """Refuse points that contradict each other, or that put the ground above the cameras."""
    away = np.abs(found.residual / found.std).max(1)
    extent = float(np.linalg.norm(pairs.coordinates - pairs.coordinates.mean(0), axis=1).mean())
    upside_down = float((found.R @ pairs.up)[2]) < 0.5
    bad = np.median(np.linalg.norm(found.residual, axis=1)) > 0.1 * extent
    if upside_down or bad:
        swapped = pairs.swapped().aligned()
        fits = np.median(np.linalg.norm(swapped.residual, axis=1)) < 0.05 * extent
        if fits and float((swapped.R @ pairs.up)[2]) > 0.5:
            raise InputError(
                f"with {file} the cameras would film from below the ground"
                if upside_down
                else f"the points of {file} do not fit the run",
                cause="the columns of easting and northing (or longitude and latitude) are swapped",
                hint="exchange the names of the two columns",
            )
        raise InputError(
            f"the points of {file} do not fit the run: {found.rms:.3g} m root mean square over an extent of"
            f" {extent:.3g} m",
            cause="points are exchanged, or heights stand in a column of depths",
            hint="compare names and coordinates with the marks in --points",
        )
    if away.max() > _OFF and len(pairs.names) > _FEWEST:
        left = [pairs.without(k).aligned() for k in range(len(pairs.names))]
        worst = int(np.argmin([float(((a.residual / a.std) ** 2).sum()) for a in left]))
        found = left[worst]
        off = found.scale * found.R @ pairs.xyz[worst] + found.t - pairs.coordinates[worst]
        raise InputError(
            f"control point {pairs.names[worst]} is {np.linalg.norm(off):.3g} m from where the others put it; with"
            f" it the points contradict each other by up to {away.max():.1f} standard deviations",
            cause="its coordinates or its marks are wrong",
            hint="correct it, or give it the role check",
        )


def _triple(values: np.ndarray) -> tuple[float, float, float]:
    x, y, z = (float(v) for v in values)
    return x, y, z
