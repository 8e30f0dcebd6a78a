"""Differences of two visits, cell by cell, with standard deviations that the pair of visits itself has confirmed.

    d  = h_b - h_a
    s2 = s_a^2 + s_b^2 + |grad h|^2 (s_xy^2 + s_p^2) + s_z^2 + |grad d|^2 s_r^2

For colors d and h are L*, a* and b*, and s_xy is wider by |d_h| tan(theta), theta the angle of the nearest camera's ray
from the vertical: where the ground has not changed, a difference of heights d_h is an error, by which the ray meets
other ground beside the cell; where it has, another surface is seen. No shift makes a color that is not there: the part
of a difference by which a color lies outside the range of those that the other visit has within 2 s_xy counts without
the term of s_xy, and the more significant of the two is taken.

s_p is the place that a height was taken at within its cell; s_xy and s_z are what check points say of the alignment
(`misfit`), at the cell. s_r is the place of a rim: maps smear a change over the ground beside it. Errors that both
visits have in common cancel, those of a surface that looks different now do not: there the deviations are larger.
Most of the ground, near and far from the cameras and from the points that both visits share, is taken to be unchanged:
where the spread of d / s over cells at like distances, or of like s_z, found from its median absolute value, is above
1, it is the factor by which s was too small. Depth and water are known the less, the farther away the ground was, and
bends the less, the farther away the shared points were.

A change is significant from `threshold` s on. From such cells it is followed to neighbors of at least two thirds of it
in the same direction, so that flanks belong to the place; places smaller than `min_area` are left out. Cells that one
of the visits did not see are unknown, neither changed nor unchanged.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from jaxtyping import Bool, Float, Float32, Int, UInt8
from scipy import ndimage

from swimm3r.visits.color import lab, lab_variance, light_gains
from swimm3r.visits.ground import Ground
from swimm3r.visits.settings import VisitSettings

UNKNOWN, UNCHANGED, MORE, LESS = range(4)  # of a cell: height or lightness
HEIGHT_KINDS = {MORE: "gained", LESS: "lost"}
COLOR_KINDS = {MORE: "paler", LESS: "darker"}
_MAD = 1.4826
_FOLLOWED = 0.67  # of the threshold, for cells that hang together with significant ones
_SMOOTH = 1.0  # cells, standard deviation of the filter that both visits pass: detail finer than the alignment
_MIN_CELLS = 40  # of a place, by default
_UNLIKE = 15.0  # CIELAB difference at which deviations of heights are larger by the square root of 2
_NEAR = 2  # cells around one whose heights tell how steep the ground is
_CLASSES, _CLASS_CELLS = 8, 400  # of cells that are alike: how many at most, and the cells of each at least
_RIM = 0.5  # cells, standard deviation of the place of a change's rim, which the filter leaves
_REACH = 2.0  # standard deviations of its place within which a cell's color may come from
_REACHES = (1, 2, 3, 4, 6, 8, 12, 16, 24, 40)  # cells that is rounded up to; beyond the last, colors come from anywhere
_PLACED = 0.25  # cells, standard deviation of where a cell's height was taken: half a pixel of a frame


@dataclass(frozen=True)
class Misfit:
    """Uncertainty of the place of one visit on another one's ground, local units."""

    level: Float[np.ndarray, "h w"]  # horizontal, per axis
    up: Float[np.ndarray, "h w"]


@dataclass(frozen=True)
class Difference:
    """One quantity, later minus earlier; NaN where either visit saw nothing."""

    value: Float32[np.ndarray, "h w"]
    std: Float32[np.ndarray, "h w"]
    inflation: float  # factor that the standard deviations were multiplied by, median over the cells

    @property
    def significance(self) -> Float32[np.ndarray, "h w"]:
        """Standard deviations from no change, with the sign of the difference."""
        return self.value / self.std


@dataclass(frozen=True)
class Change:
    """The later of two visits against the earlier one."""

    height: Difference  # local units
    color: Difference | None  # CIELAB distance; None where a visit has no clear colors
    lab: Float32[np.ndarray, "h w 3"] | None  # differences of L*, a*, b*
    gains: Float[np.ndarray, "3"]  # on the later visit's linear colors
    height_kind: UInt8[np.ndarray, "h w"]  # UNKNOWN .. LESS: ground gained or lost
    color_kind: UInt8[np.ndarray, "h w"]  # UNKNOWN .. LESS: paler or darker
    shifted: float  # median difference of heights that was taken for the alignment's, local units

    @property
    def comparable(self) -> Bool[np.ndarray, "h w"]:
        """True where both visits saw the ground."""
        return self.height_kind != UNKNOWN


def compare(
    a: Ground, b: Ground, misfit: Misfit, gsd: float, white: Float[np.ndarray, "3"], settings: VisitSettings
) -> Change:
    """The change from ground a to ground b; `white` are factors that make the colors of a neutral (`color.neutral`)."""
    height, shifted = _height_difference(a, b, misfit, gsd)
    seen = ~np.isnan(height.value)
    color, by_axis, gains = None, None, np.ones(3)
    if not np.isnan(a.color).all() and not np.isnan(b.color).all():
        stable = seen & (np.abs(np.nan_to_num(height.significance)) < settings.threshold / 2)
        gains, _ = light_gains(a.color, b.color, stable)
        aside = np.abs(_filled(height.value.astype(np.float64))) * np.nan_to_num(np.fmax(a.slant, b.slant))
        color, by_axis = _color_difference(a, b, gains, white, np.hypot(misfit.level, aside) / gsd, misfit)
        # on a surface that looks different, errors that both visits had in common no longer cancel
        unlike = np.sqrt(1 + (np.nan_to_num(color.value) / _UNLIKE) ** 2)
        height = replace(height, std=(height.std * unlike).astype(np.float32))
    least = max(1, round((settings.min_area or _MIN_CELLS * gsd**2) / gsd**2))
    height_kind = _kinds(height, height.value, settings.threshold, settings.min_height, least)
    color_kind = np.zeros_like(height_kind)
    if color is not None and by_axis is not None:
        color_kind = _kinds(color, by_axis[..., 0], settings.threshold, settings.min_color, least)
    return Change(height, color, by_axis, gains, height_kind, color_kind, shifted)


def _height_difference(a: Ground, b: Ground, misfit: Misfit, gsd: float) -> tuple[Difference, float]:
    smooth_a, smooth_b = _smoothed(_inside(a.height)), _smoothed(_inside(b.height))
    value = (smooth_b - smooth_a).astype(np.float64)
    slope = np.maximum(_slope(smooth_a), _slope(smooth_b)) / gsd
    variance = a.height_std.astype(np.float64) ** 2 + b.height_std.astype(np.float64) ** 2
    variance += slope**2 * (misfit.level**2 + (_PLACED * gsd) ** 2) + misfit.up**2
    variance += _smeared(value)
    shifted = float(np.nanmedian(value)) if np.isfinite(value).any() else 0.0
    return _calibrated(value - shifted, np.sqrt(variance), (np.fmax(a.distance, b.distance), misfit.up)), shifted


def _color_difference(
    a: Ground,
    b: Ground,
    gains: Float[np.ndarray, "3"],
    white: Float[np.ndarray, "3"],
    level: Float[np.ndarray, "h w"],  # cells
    misfit: Misfit,
) -> tuple[Difference, Float32[np.ndarray, "h w 3"]]:
    """CIELAB distance, and the differences of L*, a*, b*; `level` is how far its color may be beside a cell."""
    lights = [_smoothed(ground.color) * factor for ground, factor in ((a, white), (b, white * gains))]
    stds = [ground.color_std * factor for ground, factor in ((a, white), (b, white * gains))]
    labs = [lab(light) for light in lights]
    by_axis = labs[1] - labs[0]
    middle = np.nanmedian(by_axis.reshape(-1, 3), axis=0) if np.isfinite(by_axis).any() else np.zeros(3)
    by_axis = by_axis - middle
    noise = lab_variance(lights[0], stds[0]) + lab_variance(lights[1], stds[1])
    noise += np.stack([_smeared(by_axis[..., k]) for k in range(3)], -1)
    variance, astray = noise.copy(), np.hypot(level, _PLACED)
    for k in range(3):
        variance[..., k] += (np.maximum(*(_slope(each[..., k]) for each in labs)) * astray) ** 2
    # factors of their own for L*, a*, b*: their errors differ in origin
    alike = np.fmax(a.distance, b.distance), misfit.up
    each = [_calibrated(by_axis[..., k], np.sqrt(variance[..., k]), alike) for k in range(3)]
    std = np.stack([one.std for one in each], -1)
    value = np.sqrt((by_axis**2).sum(-1))
    along = _along(by_axis, std)
    beyond = _beyond(labs[0], labs[1] - middle, astray)
    sure = _along(beyond, std * np.sqrt(noise / variance)) * value / np.maximum(np.sqrt((beyond**2).sum(-1)), 1e-9)
    along = np.where(beyond.any(-1), np.minimum(along, sure), along)
    inflation = max(one.inflation for one in each)
    found = Difference(value.astype(np.float32), along.astype(np.float32), inflation)
    return found, by_axis.astype(np.float32)


def _along(difference: Float[np.ndarray, "h w 3"], std: Float[np.ndarray, "h w 3"]) -> Float[np.ndarray, "h w"]:
    """Standard deviation along a difference by those along the axes."""
    return np.sqrt((difference**2 * std**2).sum(-1)) / np.maximum(np.sqrt((difference**2).sum(-1)), 1e-9)


def _beyond(
    a: Float[np.ndarray, "h w 3"], b: Float[np.ndarray, "h w 3"], astray: Float[np.ndarray, "h w"]
) -> Float[np.ndarray, "h w 3"]:
    """The part of b - a that no shift explains, of either what has appeared or what has gone, whichever is more.

    `astray` is the standard deviation of a cell's place, cells; none where its reach is beyond the last of `_REACHES`.
    """
    found = np.zeros(a.shape)
    steps = np.searchsorted(_REACHES, _REACH * astray)
    for step, cells in enumerate(_REACHES):
        rows = steps == step
        if not rows.any():
            continue
        appeared, gone = _outside(b, a, cells)[rows], -_outside(a, b, cells)[rows]
        more = (appeared**2).sum(-1) >= (gone**2).sum(-1)
        found[rows] = np.where(more[:, None], appeared, gone)
    return found


def _outside(
    values: Float[np.ndarray, "h w 3"], others: Float[np.ndarray, "h w 3"], reach: int
) -> Float[np.ndarray, "h w 3"]:
    """Excess of values over all others within `reach` cells along either axis; below all of them it is negative."""
    filled = np.stack([_filled(others[..., k]) for k in range(3)], -1)
    window = 2 * reach + 1, 2 * reach + 1, 1
    high, low = ndimage.maximum_filter(filled, window), ndimage.minimum_filter(filled, window)
    return np.maximum(np.nan_to_num(values - high), 0) + np.minimum(np.nan_to_num(values - low), 0)


def _calibrated(
    value: Float[np.ndarray, "h w"], std: Float[np.ndarray, "h w"], alike: Sequence[np.ndarray]
) -> Difference:
    """The difference with its deviations made as large as the spread of most cells that are `alike` says.

    The larger factor of the quantities [h, w] by which cells can be alike counts.
    """
    known = np.isfinite(value) & np.isfinite(std)
    factor = np.ones(value.shape)
    if known.any():
        ratio = np.abs(value[known] / std[known])
        factor[known] = np.max([_inflations(ratio, by[known].astype(np.float64)) for by in alike], axis=0)
    inflation = float(np.median(factor[known])) if known.any() else 1.0
    return Difference(value.astype(np.float32), (factor * std).astype(np.float32), inflation)


def _inflations(ratio: Float[np.ndarray, " n"], by: Float[np.ndarray, " n"]) -> Float[np.ndarray, " n"]:
    """Factors on deviations by the differences in deviations, found in classes of a quantity and interpolated."""
    count = max(1, min(_CLASSES, len(ratio) // _CLASS_CELLS, len(np.unique(by))))
    classes = np.array_split(np.argsort(by, kind="stable"), count)
    at = [float(np.median(by[rows])) for rows in classes]
    factors = [max(1.0, _MAD * float(np.median(ratio[rows]))) for rows in classes]
    return np.interp(by, at, factors)


def _kinds(
    difference: Difference, direction: Float[np.ndarray, "h w"], threshold: float, least: float, least_cells: int
) -> UInt8[np.ndarray, "h w"]:
    """The kind of every cell; `direction` has the sign of the change."""
    size = np.abs(np.nan_to_num(difference.significance)), np.abs(np.nan_to_num(difference.value))
    kind = np.where(np.isnan(difference.value), UNKNOWN, UNCHANGED).astype(np.uint8)
    for code, sign in ((MORE, 1), (LESS, -1)):
        there = np.sign(direction) == sign
        kind[_places(there * size[0], there * size[1], threshold, least, least_cells)] = code
    return kind


def _places(
    size: Float[np.ndarray, "h w"], amount: Float[np.ndarray, "h w"], threshold: float, least: float, least_cells: int
) -> Bool[np.ndarray, "h w"]:
    """Cells of significant places by their significance and the amount of the change."""
    core = (size >= threshold) & (amount >= least)
    wide = (size >= _FOLLOWED * threshold) & (amount >= _FOLLOWED * least)
    core = ndimage.binary_opening(core, np.ones((2, 2), bool))
    labels, count = connected(wide)
    hit = np.zeros(count + 1, bool)
    hit[np.unique(np.extract(core, labels))] = True
    cells = np.bincount(labels.ravel(), minlength=count + 1)
    hit &= cells >= least_cells
    hit[0] = False
    return np.take(hit, labels)


def connected(mask: Bool[np.ndarray, "h w"]) -> tuple[Int[np.ndarray, "h w"], int]:
    """The number of the place that each cell belongs to, from 1 on, 0 for none, and how many there are."""
    found: Any = ndimage.label(mask)
    return found[0], int(found[1])


def _smoothed(values: Float32[np.ndarray, "h w *c"]) -> Float[np.ndarray, "h w *c"]:
    """A Gaussian blur over what is known; NaN stays NaN."""
    known = ~np.isnan(values)
    sigma = (_SMOOTH, _SMOOTH, *[0.0] * (values.ndim - 2))
    total = ndimage.gaussian_filter(np.where(known, values, 0).astype(np.float64), sigma)
    weight = ndimage.gaussian_filter(known.astype(np.float64), sigma)
    return np.where(known, total / np.maximum(weight, 1e-9), np.nan)


def _inside(height: Float32[np.ndarray, "h w"]) -> Float32[np.ndarray, "h w"]:
    """Heights without the cells beside a hole, where a depth map's last triangles end at an unknown step."""
    return np.where(ndimage.binary_erosion(~np.isnan(height), np.ones((3, 3), bool), border_value=1), height, np.nan)


def _slope(height: Float[np.ndarray, "h w"]) -> Float[np.ndarray, "h w"]:
    """Largest difference of heights near a cell, per cell: steps count in full, unlike in a gradient."""
    filled = _filled(height)
    return (ndimage.maximum_filter(filled, 2 * _NEAR + 1) - ndimage.minimum_filter(filled, 2 * _NEAR + 1)) / (2 * _NEAR)


def _smeared(difference: Float[np.ndarray, "h w"]) -> Float[np.ndarray, "h w"]:
    """Variance of a difference beside a rim."""
    down, across = np.gradient(_filled(difference))
    return _RIM**2 * (down**2 + across**2)


def _filled(values: Float[np.ndarray, "h w"]) -> Float[np.ndarray, "h w"]:
    """Values with holes filled by the nearest known ones, for slopes."""
    known = np.isfinite(values)
    if known.all() or not known.any():
        return np.nan_to_num(values)
    nearest: Any = ndimage.distance_transform_edt(~known, return_distances=False, return_indices=True)
    return values[tuple(nearest)]
