"""Every source of scale that settings name, as estimates with standard deviations (`solve.ScaleEstimate`).

Camera height and altimeter compare with the ground straight below the cameras: the median height difference to sparse
points within 20 degrees of the vertical. Laser dots lie on the measured depth; their distance counts across the optical
axis, along which both beams run.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Float

from swimm3r.cameras import rows_of_frames, unproject
from swimm3r.errors import InputError
from swimm3r.io.navigation.read import read_navigation
from swimm3r.progress import Progress, silent
from swimm3r.scale.marked_points import (
    FrameNames,
    read_distances,
    read_laser_dots,
    read_points,
    read_scale_bars,
)
from swimm3r.scale.markers import find_markers, marker_estimates, marker_sizes
from swimm3r.scale.navigation.fit import NavigationFit
from swimm3r.scale.navigation.place import localized
from swimm3r.scale.rig import rig_estimates, rig_notes
from swimm3r.scale.settings import ScaleSettings
from swimm3r.scale.solve import ScaleEstimate
from swimm3r.scale.triangulation import ScenePoint, Sighting, scale_of_distance, triangulate_all
from swimm3r.scene.frames import Frames
from swimm3r.scene.georeference import up_from_scene
from swimm3r.scene.reconstruction import Reconstruction

_CONE = np.cos(np.radians(20.0))
_FEWEST_POINTS = 5  # of the ground below a camera
_MISPLACED = 3.0  # standard deviations of a marked point in pixels, from which it is named
_DOT_WINDOW = 2  # pixels around a laser dot whose depth counts


@dataclass(frozen=True)
class Sources:
    """Estimates of scale, and notes for the user."""

    estimates: tuple[ScaleEstimate, ...]
    notes: tuple[str, ...]
    points: dict[str, ScenePoint]  # named ones of --points


def scale_sources(
    rec: Reconstruction,
    frames: Frames,
    settings: ScaleSettings,
    navigation: NavigationFit | None,
    progress: Progress = silent,
) -> Sources:
    """All estimates. Raises InputError and UsageError that name the source and its fault."""
    names = FrameNames(rec.names, frames.width, frames.height, [n for n in frames.names if n not in set(rec.names)])
    noise = reprojection_noise(rec)
    sigma = float(np.hypot(settings.point_std, noise))
    estimates: list[ScaleEstimate] = []
    notes: list[str] = []
    for bar in read_scale_bars(settings.scale_bar, names):
        one, other = placed_points(rec, {"first": bar.ends[0], "second": bar.ends[1]}, sigma, bar.name).values()
        estimates.append(_of_distance(bar.name, one, other, bar.length, settings.length_std, settings))
    points: dict[str, ScenePoint] = {}
    if settings.points is not None:
        points = placed_points(rec, read_points(settings.points, names), sigma, str(settings.points))
    if settings.distances is not None:
        for known in read_distances(settings.distances):
            missing = [name for name in (known.one, known.other) if name not in points]
            if missing:
                raise InputError(
                    f"{settings.distances} speaks of {missing[0]}, and {settings.points} has no such point",
                    cause="a slip in a name", hint=f"points there are: {', '.join(points)}",
                )  # fmt: skip
            name = f"distance {known.one} to {known.other}"
            std = known.std or settings.length_std
            estimates.append(_of_distance(name, points[known.one], points[known.other], known.length, std, settings))
    sizes = marker_sizes(settings)
    if sizes is not None:
        found = find_markers(rec, frames, sizes.family, sizes.board, progress)
        of_markers, told = marker_estimates(rec, found, sizes, settings, noise)
        estimates += of_markers
        notes += told
    if settings.laser_dots is not None and settings.laser_spacing is not None:
        estimates += laser_estimates(rec, read_laser_dots(settings.laser_dots, names), settings)
    of_rig = rig_estimates(rec, settings)
    estimates += of_rig
    notes += rig_notes(rec, of_rig)
    if settings.camera_height is not None:
        estimates.append(_camera_height(rec, settings, navigation))
    if navigation is not None:
        estimates.append(_of_navigation(navigation, settings))
        if settings.altimeter:
            estimates.append(_altimeter(rec, settings, navigation))
        notes += navigation.notes
    return Sources(tuple(estimates), tuple(notes), points)


def check_sources(settings: ScaleSettings) -> None:
    """Read the files that settings name, before any work is done. Raises the error of the first that cannot be used."""
    if settings.nav is not None:
        localized(read_navigation(settings.nav, settings.nav_topic), settings)
    marker_sizes(settings)
    if settings.distances is not None:
        read_distances(settings.distances)
    for path in (settings.points, settings.laser_dots, settings.control):
        if path is not None and not path.is_file():
            raise InputError(f"there is no file {path}", cause="a slip in the name", hint="the path of the CSV")


def reprojection_noise(rec: Reconstruction) -> float:
    """The errors of poses and lens as pixels: the median reprojection error of the sparse points."""
    error = rec.points.error
    return float(error.median()) if len(error) else 0.5


def placed_points(
    rec: Reconstruction, sightings: dict[str, Sequence[Sighting]] | dict[str, list[Sighting]], sigma: float, where: str
) -> dict[str, ScenePoint]:
    """The points of the scene. Raises InputError that names the point and its fault."""
    points, failed = triangulate_all(rec.cameras, sightings, sigma)
    for name, why in failed.items():
        raise InputError(
            f"{where}: the place of point {name} cannot be found: {why}",
            cause="too few frames, or pixels of different things",
            hint="mark it in another frame, from another place",
        )
    for name, point in points.items():
        if point.rms_px > _MISPLACED * sigma * (1 + 2 / point.frames):
            raise InputError(
                f"{where}: the marks of point {name} contradict each other by {point.rms_px:.1f} pixels, most in"
                f" {rec.names[point.worst]}",
                cause="the two ends are exchanged in one frame, or a mark is on another thing",
                hint="mark it again there; --point-std where marks cannot be better",
            )
    return points


def ground_below(rec: Reconstruction, up: Float[np.ndarray, "3"]) -> Float[np.ndarray, " c"]:
    """Height of every camera above the ground straight below, in the run's unit; NaN where no points are there."""
    centers, xyz = rec.cameras.centers.double().numpy(), rec.points.xyz.double().numpy()
    points = rec.tracks.point.numpy()
    out = np.full(len(centers), np.nan)
    for i, rows in enumerate(rows_of_frames(rec.tracks.frame, len(centers))):
        center, mine = centers[i], points[rows.numpy()] if len(points) else np.arange(len(xyz))
        to_point = xyz[mine] - center
        fall = -to_point @ up
        below = fall > _CONE * np.linalg.norm(to_point, axis=1)
        if below.sum() >= _FEWEST_POINTS:
            out[i] = np.median(fall[below])
    return out


def laser_estimates(
    rec: Reconstruction, dots: Sequence[tuple[str, Sighting, Sighting]], settings: ScaleSettings
) -> list[ScaleEstimate]:
    """A scale per frame with laser dots."""
    assert settings.laser_spacing is not None
    out = []
    for name, one, other in dots:
        ends = []
        for dot in (one, other):
            z, std = _depth_at(rec, dot, name)
            camera = rec.cameras[dot.frame]
            pixel = torch.tensor([[dot.xy]], dtype=torch.float64)
            world = unproject(camera, pixel, torch.tensor([[z]], dtype=torch.float64))[0, 0].numpy()
            pose = camera.cam2world[0].double().numpy()
            ends.append((pose[:3, :3].T @ (world - pose[:3, 3]), std / z))
        across = ends[0][0][:2] - ends[1][0][:2]
        length = float(np.linalg.norm(across))
        pixels = float(np.hypot(*(np.array(one.xy) - np.array(other.xy))))
        relative = [
            np.hypot(ends[0][1], ends[1][1]) / np.sqrt(2),
            np.sqrt(2) * settings.point_std / max(pixels, 1e-9),
            settings.laser_std / settings.laser_spacing,
            settings.minimum_std,
        ]
        std = float(np.sqrt(np.sum(np.square(relative))))
        out.append(
            ScaleEstimate(f"lasers in {name}", settings.laser_spacing / length, std, f"{settings.laser_spacing:g} m")
        )
    return out


def _depth_at(rec: Reconstruction, dot: Sighting, frame: str) -> tuple[float, float]:
    """Measured depth around a pixel and its spread, in the run's unit."""
    name = rec.names[dot.frame]
    if name not in rec.depth:
        raise InputError(
            f"the frame {frame} has no depth map", cause="its depth was not computed", hint="dots in another frame"
        )
    z = rec.depth[name].z_depth
    rows, columns = z.shape
    x = int(dot.xy[0] * columns / rec.cameras.width)
    y = int(dot.xy[1] * rows / rec.cameras.height)
    window = z[max(0, y - _DOT_WINDOW) : y + _DOT_WINDOW + 1, max(0, x - _DOT_WINDOW) : x + _DOT_WINDOW + 1]
    window = window[window > 0].double()
    if len(window) < 3:
        raise InputError(
            f"no depth was measured at the laser dot {dot.xy[0]:g},{dot.xy[1]:g} of {frame}",
            cause="the ground there is hidden, blurred or without texture",
            hint="dots in another frame",
        )
    middle = float(window.median())
    return middle, max(1.4826 * float((window - middle).abs().median()), 0.003 * middle)


def _of_distance(
    name: str, one: ScenePoint, other: ScenePoint, length: float, length_std: float, settings: ScaleSettings
) -> ScaleEstimate:
    scale, std = scale_of_distance(one, other, length, length_std)
    views = min(one.frames, other.frames)
    return ScaleEstimate(name, scale, float(np.hypot(std, settings.minimum_std)), f"{length:g} m in {views} frames")


def _of_navigation(fit: NavigationFit, settings: ScaleSettings) -> ScaleEstimate:
    a = fit.alignment
    detail = f"{len(fit.matched.frame)} positions, {a.rms:.3g} m rms"
    if fit.offset is not None and fit.offset_found:
        detail += f", clock offset {fit.offset.seconds:+.2f} \u00b1 {fit.offset.std:.2f} s"
    return ScaleEstimate("navigation", a.scale, float(np.hypot(a.scale_std, settings.minimum_std)), detail)


def _vertical(rec: Reconstruction, navigation: NavigationFit | None) -> Float[np.ndarray, "3"]:
    return up_from_scene(rec)[2] if navigation is None else navigation.alignment.R[2]


def _camera_height(rec: Reconstruction, settings: ScaleSettings, navigation: NavigationFit | None) -> ScaleEstimate:
    assert settings.camera_height is not None
    heights = ground_below(rec, _vertical(rec, navigation))
    heights = heights[np.isfinite(heights)]
    if not len(heights):
        raise _no_ground("the camera height")
    std = float(np.hypot(settings.camera_height_std / settings.camera_height, settings.minimum_std))
    detail = f"{settings.camera_height:g} m over {len(heights)} frames"
    return ScaleEstimate("camera height", settings.camera_height / float(heights.mean()), std, detail)


def _altimeter(rec: Reconstruction, settings: ScaleSettings, navigation: NavigationFit) -> ScaleEstimate:
    altitude = navigation.matched.navigation.altitude
    heights = ground_below(rec, _vertical(rec, navigation))[navigation.matched.frame]
    known = False if altitude is None else np.isfinite(altitude) & (altitude > 0)  # 0 or -1: no echo
    both = np.isfinite(heights) & known
    if altitude is None or not both.any():
        if altitude is None:
            raise InputError(
                f"{settings.nav} has no altitude above the bottom", cause="--altimeter was given", hint="leave it out"
            )
        raise _no_ground("the altimeter")
    ratio = np.log(altitude[both] / heights[both])
    middle = float(np.median(ratio))
    scatter = 1.4826 * float(np.median(np.abs(ratio - middle))) / np.sqrt(both.sum())
    std = float(np.sqrt(settings.altimeter_std**2 + scatter**2))
    return ScaleEstimate("altimeter", float(np.exp(middle)), std, f"{int(both.sum())} altitudes")


def _no_ground(what: str) -> InputError:
    return InputError(
        f"{what} cannot be used: no frame has points of the ground straight below",
        cause="the camera looks ahead rather than down",
        hint="another source of scale, as --scale-bar or --markers",
    )
