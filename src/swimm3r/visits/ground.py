"""The ground as one visit saw it: height and clear color of the cells of a grid, with their standard deviations.

    height      weighted median over the depth maps, std = 1.2533 s / sqrt(k), s the spread of k views
    color       mean of (I - B) / T_D (Eq. 4), in linear light, weighted by the square of the frames' rank

The deviation of a color also has the error of the backscatter, which all views of a visit share: it grows as the light
that arrives gets less. Restored images are of no use here: they hold back a color of which little light is left, and
more of it in one water than in another, which would pass for a change.

Cells of a single view have the spread of the visit's poorer cells. Views share errors, so these deviations are too
small by a factor, which `change` finds from the pair of visits.
"""

from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import torch
from jaxtyping import Bool, Float, Float32, UInt16
from scipy.spatial import KDTree

from swimm3r.errors import UsageError
from swimm3r.medium import MediumFit, backscatter, linear_from_srgb, transmittances
from swimm3r.products.elevation import elevation, frames_over
from swimm3r.products.frame_colors import Points, shown_by
from swimm3r.products.grid import Grid, Window, chosen_gsd, grid_of
from swimm3r.products.survey import Survey
from swimm3r.progress import Progress, silent
from swimm3r.sfm.medium.settings import RestoreSettings

_TILE = 512  # cells along the side of the windows that are filled one after another
_MOST_CELLS = 4e7  # of a comparison, whose grids are in memory: about 150 bytes each
_PIXELS = 2.0  # of a frame along a cell, by default: depth is not known for each pixel by itself
_MEDIAN = 1.2533  # standard deviation of a median by that of a mean, for normal errors
_LEAST_PIXELS = 0.25  # of a frame on the ground: no height is surer, however well its views agree
_POOR = 0.9  # quantile of a view's spread that single views have: they are where matching was hard
_LEVEL = 0.05  # sine of the angle from the horizontal below which a ray counts as no flatter
_LEAST_COLOR_STD = 0.02  # of the color itself: what interpolation leaves
_LEAST_TRANSMITTANCE = 1e-3  # of a channel: with less, its color is unknown by a multiple of white in any case


@dataclass(frozen=True)
class Ground:
    """One visit on the common grid; NaN where nothing was seen."""

    height: Float32[np.ndarray, "h w"]  # local units
    height_std: Float32[np.ndarray, "h w"]
    views: UInt16[np.ndarray, "h w"]
    color: Float32[np.ndarray, "h w 3"]  # without the water, linear light
    color_std: Float32[np.ndarray, "h w 3"]
    distance: Float32[np.ndarray, "h w"]  # from the nearest camera, local units
    slant: Float32[np.ndarray, "h w"]  # tangent of the angle between that camera's ray and the vertical

    @property
    def seen(self) -> Bool[np.ndarray, "h w"]:
        """True where the height is known."""
        return ~np.isnan(self.height)


def common_grid(surveys: list[Survey], gsd: float | None = None) -> Grid:
    """The grid that holds the ground of all visits, which have one place. Raises UsageError where it is too large."""
    grid_scale = surveys[0].place.grid_scale
    on_map = gsd or chosen_gsd(_PIXELS * max(survey.footprint for survey in surveys) * grid_scale)
    grids = [grid_of(survey, on_map) for survey in surveys]
    step = grids[0].gsd
    west, north = min(grid.x0 for grid in grids), max(grid.y1 for grid in grids)
    east = max(grid.x0 + grid.columns * step for grid in grids)
    south = min(grid.y1 - grid.rows * step for grid in grids)
    rows, columns = round((north - south) / step), round((east - west) / step)
    if rows * columns > _MOST_CELLS:
        enough = chosen_gsd(on_map * float(np.sqrt(rows * columns / _MOST_CELLS)))
        raise UsageError(
            f"the common map of the visits would have {columns:,} x {rows:,} cells",
            cause="visits are compared in memory, and the cell size is too small for the extent of the site",
            hint=f"--gsd {enough:g}",
        )
    return replace(grids[0], x0=west, y1=north, rows=rows, columns=columns)


def observe(survey: Survey, grid: Grid, progress: Progress = silent) -> Ground:
    """The ground of a visit on a grid."""
    shape = (grid.rows, grid.columns)
    ground = Ground(
        np.full(shape, np.nan, np.float32), np.full(shape, np.nan, np.float32), np.zeros(shape, np.uint16),
        np.full((*shape, 3), np.nan, np.float32), np.full((*shape, 3), np.nan, np.float32),
        np.full(shape, np.nan, np.float32), np.full(shape, np.nan, np.float32),
    )  # fmt: skip
    tiles = list(grid.tiles(_TILE))
    for done, window in enumerate(tiles):
        progress(f"ground of {survey.folder.name}", done, len(tiles))
        _fill(ground, survey, grid, window)
    progress(f"ground of {survey.folder.name}", len(tiles), len(tiles))
    return _with_floor(ground, _LEAST_PIXELS * survey.footprint)


def _fill(ground: Ground, survey: Survey, grid: Grid, window: Window) -> None:
    """Fill the cells of a window."""
    frames = frames_over(survey, grid, window)
    if not frames:
        return
    own: Any = np.s_[window.row : window.row + window.rows, window.column : window.column + window.columns]
    found = elevation(survey, grid, window, frames)
    ground.height[own] = found.height
    ground.height_std[own] = _MEDIAN * found.std / np.sqrt(np.maximum(found.views, 1))
    ground.views[own] = found.views
    rows, columns = np.nonzero(~np.isnan(found.height))
    if not len(rows):
        return
    x, y = grid.centers(window)
    points = Points(np.stack([x[columns], y[rows], found.height[rows, columns]], -1), size=grid.gsd)
    centers = survey.centers[list(survey.indices)]
    nearest: Any = KDTree(centers).query(points.xyz)
    ray = centers[nearest[1]] - points.xyz
    ground.distance[own][rows, columns] = nearest[0]
    above = np.maximum(np.abs(ray[:, 2]), _LEVEL * nearest[0])
    ground.slant[own][rows, columns] = np.hypot(ray[:, 0], ray[:, 1]) / above
    if survey.rec.medium is None:
        return
    mean, std = _colors(survey, points, frames)
    ground.color[own][rows, columns], ground.color_std[own][rows, columns] = mean, std


def _colors(survey: Survey, points: Points, frames: list[int]) -> tuple[np.ndarray, np.ndarray]:
    """Weighted means of the clear colors that frames show of points, and the means' standard deviations."""
    fit = survey.rec.medium
    assert fit is not None
    n = len(points.xyz)
    weight, squared = np.zeros(n), np.zeros(n)
    first, second, shared = np.zeros((n, 3)), np.zeros((n, 3)), np.zeros((n, 3))
    for i in frames:
        shown = shown_by(survey, points, i, "filmed")
        if shown is None:
            continue
        pose = survey.rec.cameras.cam2world[i].double().numpy()
        ray = (survey.place.from_local(points.xyz[shown.which]) - pose[:3, 3]) @ pose[:3, :3]
        light, veil_std = clear_light(torch.from_numpy(shown.colors), torch.from_numpy(ray), fit)
        w = shown.rank.astype(np.float64) ** 2
        weight[shown.which] += w
        squared[shown.which] += w**2
        first[shown.which] += w[:, None] * light
        second[shown.which] += w[:, None] * light**2
        shared[shown.which] += w[:, None] * veil_std
    with np.errstate(invalid="ignore", divide="ignore"):
        mean = first / weight[:, None]
        count = (weight**2 / squared)[:, None]  # views that would weigh as much if all were alike
        spread = np.maximum(second / weight[:, None] - mean**2, 0) * count / np.maximum(count - 1, 1e-3)
        std = np.where(count > 1.2, np.sqrt(spread / count), np.nan)
        std = np.hypot(std, shared / weight[:, None])
    return mean.astype(np.float32), np.hypot(std, _LEAST_COLOR_STD * mean).astype(np.float32)


def clear_light(
    filmed: Float[torch.Tensor, "n 3"], ray: Float[torch.Tensor, "n 3"], fit: MediumFit
) -> tuple[Float[np.ndarray, "n 3"], Float[np.ndarray, "n 3"]]:
    """Linear light of filmed colors (stored, 0..1) without the water, and the deviations that errors of B leave.

    Eq. 4 in the encoding of the fit, not clamped. `ray` leads from the camera to the point, in the axes of the camera
    and in units of the fit.
    """
    z = ray.double().norm(dim=1)
    medium = fit.at(z, ray.double() / z[:, None])
    T_D = transmittances(z, medium)[0].clamp(min=_LEAST_TRANSMITTANCE)
    I = filmed.double()
    direct = (linear_from_srgb(I) if fit.encoding == "linear" else I) - backscatter(z, medium)
    J, std = direct / T_D, RestoreSettings().veil_error / T_D
    if fit.encoding == "linear":
        return J.numpy(), std.numpy()
    return linear_from_srgb(J).numpy(), ((linear_from_srgb(J + std) - linear_from_srgb(J - std)) / 2).numpy()


def _with_floor(ground: Ground, least: float) -> Ground:
    """The ground with the deviation of a poor view for cells that one view shows, and no deviation below `least`."""
    height_std, color_std = ground.height_std.copy(), ground.color_std.copy()
    one_view = ground.height_std * np.sqrt(np.maximum(ground.views, 1))
    if np.isfinite(one_view).any():
        poor = float(np.nanquantile(one_view, _POOR))
        height_std = np.where(ground.seen, np.hypot(np.nan_to_num(height_std, nan=poor), least), np.nan)
    lacking = np.isnan(color_std) & ~np.isnan(ground.color)
    if lacking.any():
        relative = (color_std / np.maximum(ground.color, 1e-4)).reshape(-1, 3)
        told = np.isfinite(relative).any(0)
        typical = np.full(3, 0.1)  # by channel: water takes one more than another
        typical[told] = np.nanmedian(relative[:, told], axis=0)
        color_std[lacking] = (2 * typical * np.maximum(ground.color, 1e-2))[lacking]
    return replace(ground, height_std=height_std.astype(np.float32), color_std=color_std)
