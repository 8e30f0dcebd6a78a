"""Scale and place of a run from every source that settings name: the numbers, before any file changes.

The scale is that of all sources together (`solve`). Place and axes are those of the control points, else of the
navigation, with the middle of their path held where they put it; else those that the run had, else up from the scene.
"""

from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Float

from swimm3r.progress import Progress, silent
from swimm3r.scale.control import ControlFit, fit_control
from swimm3r.scale.navigation.alignment import Alignment
from swimm3r.scale.navigation.fit import NavigationFit, fit_navigation
from swimm3r.scale.navigation.geodesy import geodetic_from_local
from swimm3r.scale.navigation.place import Place
from swimm3r.scale.settings import ScaleSettings
from swimm3r.scale.solve import ScaleEstimate, ScaleSolution, solve_scale
from swimm3r.scale.sources import scale_sources
from swimm3r.scene.frames import Frames
from swimm3r.scene.georeference import Georeference, Vector, local_georeference, up_from_scene
from swimm3r.scene.reconstruction import Reconstruction


@dataclass(frozen=True)
class RunScale:
    """Metres per unit of a run's files, and its place; `georeference` is for the files as they are."""

    solution: ScaleSolution
    georeference: Georeference
    navigation: NavigationFit | None
    control: ControlFit | None
    notes: tuple[str, ...]


def estimate_scale(
    rec: Reconstruction,
    frames: Frames,
    settings: ScaleSettings,
    before: Georeference | None = None,
    progress: Progress = silent,
) -> RunScale:
    """Everything that the sources tell. Raises InputError and UsageError that name the source and its fault."""
    navigation = None if settings.nav is None else fit_navigation(rec, frames, settings)
    sources = scale_sources(rec, frames, settings, navigation, progress)
    estimates, notes = list(sources.estimates), list(sources.notes)
    control = None
    if settings.control is not None:
        place = None if navigation is None else navigation.place
        control = fit_control(sources.points, up_from_scene(rec)[2], settings, place)
        found = control.alignment
        count = sum(point.role == "control" for point in control.points)
        std = float(np.hypot(found.scale_std, settings.minimum_std))
        estimates.append(ScaleEstimate("ground control", found.scale, std, f"{count} points, {found.rms:.3g} m rms"))
        notes += control.notes
    solution = solve_scale(estimates, settings.outlier)
    if control is not None:
        georeference = _placed(control.alignment, control.place, control.center, solution)
    elif navigation is not None:
        centers = rec.cameras.centers.double().numpy()[navigation.matched.frame]
        georeference = _placed(navigation.alignment, navigation.place, centers.mean(0), solution)
    else:
        georeference = _kept(before or local_georeference(rec), rec, solution)
    names = tuple(each.estimate.source for each in solution.sources if not each.is_outlier)
    return RunScale(solution, replace(georeference, sources=names), navigation, control, tuple(notes))


def _placed(found: Alignment, place: Place, center: Float[np.ndarray, "3"], solution: ScaleSolution) -> Georeference:
    """The georeference of an alignment under the scale of all sources, `center` held."""
    held = found.scale * found.R @ center + found.t
    local_origin = held - solution.scale * found.R @ center
    grid = np.array([place.grid_scale, place.grid_scale, 1.0])
    R = place.to_grid @ found.R
    origin = np.array(place.base) + grid * (place.to_grid @ local_origin)
    away = np.linalg.norm(solution.scale * center)
    sides = np.radians(np.abs(found.rotation_std_deg)).max() * away
    origin_std = np.hypot(found.center_std, np.hypot(sides, solution.std * away))
    geodetic = None
    if place.origin is not None:
        latitude, longitude, _ = geodetic_from_local(local_origin[None], place.origin)[0]
        geodetic = (float(latitude), float(longitude))
    return Georeference(
        epsg=place.epsg,
        origin=_vector(origin),
        rotation=(_vector(R[0]), _vector(R[1]), _vector(R[2])),
        scale=solution.scale,
        scale_std=solution.std,
        origin_std=_vector(origin_std) if np.isfinite(origin_std).all() else None,
        rotation_std_deg=_vector(found.rotation_std_deg),
        grid_scale=float(place.grid_scale),
        geodetic=geodetic,
    )


def _kept(before: Georeference, rec: Reconstruction, solution: ScaleSolution) -> Georeference:
    """The place that a run has, the middle of its cameras held, under another scale."""
    center = rec.cameras.centers.double().numpy().mean(0)
    grid = np.array([before.grid_scale, before.grid_scale, 1.0])
    old = 1.0 if before.scale is None else before.scale
    known_place = before.scale is not None and any(before.origin)
    moved = (old - solution.scale) * before.R @ center if known_place else np.zeros(3)
    origin = np.array(before.origin) + grid * moved
    return replace(before, origin=_vector(origin), scale=solution.scale, scale_std=solution.std)


def _vector(values: Float[np.ndarray, "3"]) -> Vector:
    x, y, z = (float(value) for value in values)
    return x, y, z
