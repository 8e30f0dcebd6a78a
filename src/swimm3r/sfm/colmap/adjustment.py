"""Bundle adjustment of a finished reconstruction, plain and behind a port.

Behind a port the exact image of a point differs from that of the central lens by a shift that depends on its depth
(`swimm3r.refraction.central`). So depth and shift are found in turn: observations are moved to where the central lens
has the points that they show at their present depth, and poses and points are adjusted to them; what this converges to
is the adjustment under exact refraction.

Errors of verified matches have long tails: on a synthetic dive their median is 0.13 px, and they reach the 4 px at
which observations are dropped. A loss that is quadratic up to 1 px, COLMAP's, lets the tails bend the path
(`benchmarks/stereo.py`), so that of a last adjustment is quadratic up to the typical error.
"""

from collections.abc import Callable
from dataclasses import replace
from functools import partial
from typing import TYPE_CHECKING

import numpy as np
import torch

from swimm3r.cameras import cameras_of, project, rows_of_frames
from swimm3r.io.colmap.model import from_pycolmap, to_pycolmap
from swimm3r.progress import Progress, silent
from swimm3r.refraction.central import CameraInWater
from swimm3r.scene.reconstruction import Reconstruction, Tracks

if TYPE_CHECKING:
    import pycolmap

WIDEST = 1.0  # px up to which the robust loss is quadratic while poses still move: COLMAP's
_NARROWEST = 0.01  # px, of exact observations
_TURNS = 3  # the shift changes with the change of depth, a hundredth of a pixel after the second


def typical_error(model: "pycolmap.Reconstruction") -> float:
    """Median reprojection error of the tracks of a model in pixels, 0.01 to 1: the width of the loss that suits it."""
    errors = [point.error for point in model.points3D.values() if point.track.length() > 1]
    return float(np.clip(np.median(errors), _NARROWEST, WIDEST)) if errors else WIDEST


def robust_adjustment(width: float) -> "pycolmap.BundleAdjustmentOptions":
    """Options of an adjustment whose loss is quadratic up to errors of `width` pixels, and linear far beyond."""
    import pycolmap

    options = pycolmap.BundleAdjustmentOptions()
    options.print_summary = False
    options.ceres.loss_function_type = pycolmap.LossFunctionType.SOFT_L1
    options.ceres.loss_function_scale = width
    return options


def bundle_adjust(rec: Reconstruction, *, lens: bool = False) -> Reconstruction:
    """The same frames and tracks with poses and points that reproject best, and the lens too where asked."""
    return with_adjusted_model(rec, partial(adjust_model, lens=lens))


def with_adjusted_model(
    rec: Reconstruction, adjust: "Callable[[pycolmap.Reconstruction], pycolmap.Reconstruction]"
) -> Reconstruction:
    """The same frames and tracks with poses, points and lens of their model after an adjustment."""
    table = from_pycolmap(adjust(to_pycolmap(rec.colmap_model())))
    return replace(
        rec,
        cameras=cameras_of(table),
        points=replace(rec.points, xyz=torch.from_numpy(table.xyz), error=torch.from_numpy(table.error)),
        tracks=Tracks(*(torch.from_numpy(a) for a in (table.track_point, table.track_frame, table.track_xy))),
    )


def adjust_model(model: "pycolmap.Reconstruction", *, lens: bool = False) -> "pycolmap.Reconstruction":
    """A copy of a model after bundle adjustment of its poses and points, and its lens where asked."""
    import pycolmap

    out = pycolmap.Reconstruction(model)
    out.update_point_3d_errors()
    options = robust_adjustment(typical_error(out))
    options.refine_focal_length = options.refine_extra_params = lens
    options.ceres.solver_options.num_threads = 1  # as in mapping: the same sums in the same order
    pycolmap.bundle_adjustment(out, options)
    out.update_point_3d_errors()
    return out


def adjust_through_port(
    rec: Reconstruction, housed: CameraInWater, distance: float, *, lens: bool, progress: Progress = silent
) -> Reconstruction:
    """The reconstruction under exact refraction, its lens the central one of the port, or adjusted from there.

    `distance` is the median distance of the points from the port in meters: a reconstruction has no scale of its own.
    Tracks keep the pixels that were observed; errors of points are those under refraction.
    """
    for turn in range(_TURNS):
        progress("refraction", turn, _TURNS)
        pixels = _through_central_lens(rec, housed, distance)
        moved = bundle_adjust(replace(rec, tracks=replace(rec.tracks, xy=pixels)), lens=lens)
        points = replace(rec.points, xyz=moved.points.xyz, error=moved.points.error)
        rec = replace(rec, cameras=moved.cameras, points=points)
    progress("refraction", _TURNS, _TURNS)
    return rec


def _through_central_lens(rec: Reconstruction, housed: CameraInWater, distance: float) -> torch.Tensor:
    """The pixels of the tracks as the central lens has their points."""
    tracks, z = rec.tracks, torch.zeros(len(rec.tracks.point), dtype=torch.float64)
    for i, rows in enumerate(rows_of_frames(tracks.frame, len(rec.names))):
        z[rows] = project(rec.cameras[i], rec.points.xyz[tracks.point[rows]].double()[None])[1][0]
    meters = z * ((distance + housed.outside) / z[z > 0].median())
    shift = housed.shift(tracks.xy, meters)
    usable = (meters > housed.outside) & shift.isfinite().all(-1)
    return tracks.xy + torch.where(usable[:, None], shift, 0.0).to(tracks.xy)
