"""The offset between the clocks of frames and of navigation that names the images.

Such navigation states where the vehicle was when an image was taken, by the vehicle's clock; the camera's may differ by
some tenths of a second, and a vehicle that heaves is then centimetres away.

    p_i = s R c(t_i - d) + t + noise,   d ~ N(0, nav_latency_std)

d is the mean of its posterior, on a grid, under Student's t noise of 4 degrees of freedom. A straight path at constant
speed shows no offset, and leaves d at 0 with the standard deviation of the prior.
"""

from dataclasses import replace

import numpy as np
from jaxtyping import Bool, Float
from scipy.interpolate import CubicSpline
from scipy.spatial.transform import Rotation, Slerp

from swimm3r.scale.navigation.alignment import Alignment, Path, align, realign
from swimm3r.scale.navigation.time_offset import Offset
from swimm3r.scale.settings import ScaleSettings

_REACH = 3.0  # standard deviations of the prior, on either side
_STEPS = 17
_FEWEST = 8  # positions that the offset is found from
_GAPS = 3.0  # of the usual interval between frames: test frames and blurred ones are missing
_FREEDOM = 4.0  # of Student's t
_ROUNDS = 3  # of grids, each finer than the one before
_UNKNOWNS = 8  # a similarity and the offset
_LEAST_STD = 1e-4  # metres
_SPREAD_ROUNDS = 20


def find_latency(path: Path, seconds: Float[np.ndarray, " k"], settings: ScaleSettings) -> Offset | None:
    """The offset of the navigation's clock, t_navigation = t_frame + d, of rows at these moments of the frames.

    None where `nav_latency_std` is 0, too few positions lie within the path, or cameras of a rig share their moments.
    """
    reach = limit = _REACH * settings.nav_latency_std
    within = within_path(seconds, -limit, settings) & within_path(seconds, limit, settings)
    if not limit or within.sum() < _FEWEST or len(np.unique(seconds)) < len(seconds):
        return None
    offset = Offset(0.0, settings.nav_latency_std)
    for _ in range(_ROUNDS):
        shifts = np.linspace(max(offset.seconds - reach, -limit), min(offset.seconds + reach, limit), _STEPS)
        offset = _posterior(path, seconds, shifts, within, offset.seconds, settings)
        reach = _REACH * max(offset.std, float(shifts[1] - shifts[0]))
    return offset


def within_path(seconds: Float[np.ndarray, " k"], offset: float, settings: ScaleSettings) -> Bool[np.ndarray, " k"]:
    """Marks of the rows that an offset leaves between frames that follow closely."""
    moments = np.unique(seconds)
    if len(moments) < 2:
        return np.zeros(len(seconds), bool)
    asked = seconds - offset
    after = np.clip(np.searchsorted(moments, asked), 1, len(moments) - 1)
    gaps = np.diff(moments)
    longest = max(settings.nav_gap, _GAPS * float(np.median(gaps)))
    return (asked >= moments[0]) & (asked <= moments[-1]) & (gaps[after - 1] <= longest)


def at_offset(path: Path, seconds: Float[np.ndarray, " k"], offset: float) -> Path:
    """The path with its cameras where they were at the moments of the positions."""
    moments, first = np.unique(seconds, return_index=True)
    turns = Slerp(moments, Rotation.from_matrix(path.rotations[first]))
    asked = seconds - offset
    centers = CubicSpline(moments, path.centers[first])(asked)
    return replace(path, centers=centers, rotations=turns(asked.clip(moments[0], moments[-1])).as_matrix())


def _posterior(
    path: Path,
    seconds: Float[np.ndarray, " k"],
    shifts: Float[np.ndarray, " s"],
    within: Bool[np.ndarray, " k"],
    near: float,
    settings: ScaleSettings,
) -> Offset:
    """Mean and standard deviation of the offset over a grid; the alignment at `near` weighs the rows of all."""
    start = align(at_offset(path, seconds, near).rows(within), settings)
    found = [realign(at_offset(path, seconds, shift).rows(within), settings, start) for shift in shifts.tolist()]
    freedom = 1 - _UNKNOWNS / np.isfinite(start.std).sum()
    cost = np.array([_misfit(each, path.std is not None) for each in found]) * freedom / start.correlation
    cost += (shifts / settings.nav_latency_std) ** 2
    share = np.exp(-(cost - cost.min()) / 2)
    share /= share.sum()
    mean = float(share @ shifts)
    return Offset(mean, float(np.sqrt(share @ (shifts - mean) ** 2)))


def _misfit(alignment: Alignment, stated: bool) -> float:
    """Minus twice the logarithm of the likelihood of the positions, their spread as stated or as is likeliest."""
    total = 0.0
    for axes in (slice(0, 2), slice(2, 3)):  # level and upright, as in the alignment
        known = np.isfinite(alignment.std[:, axes])
        residual, std = alignment.residual[:, axes][known], alignment.std[:, axes][known]
        if not stated:
            std = np.full_like(residual, _spread(residual))
        total += float((2 * np.log(std) + (_FREEDOM + 1) * np.log1p((residual / std) ** 2 / _FREEDOM)).sum())
    return total


def _spread(residual: Float[np.ndarray, " n"]) -> float:
    """The likeliest spread of Student's t, by expectation and maximization."""
    squared = residual**2
    variance = float(squared.mean()) + _LEAST_STD**2 if len(residual) else 1.0
    for _ in range(_SPREAD_ROUNDS):
        weight = (_FREEDOM + 1) / (_FREEDOM + squared / variance)
        variance = float((weight * squared).mean()) + _LEAST_STD**2 if len(residual) else 1.0
    return float(np.sqrt(variance))
