"""Colors that change from frame to frame though the scene does not: exposure and white balance, apart from the water.

A camera that balances and exposes by itself stores I = M_f S + b_f, with S the colors (water included) that the dive
has on average: the mean of the M_f is the identity and that of the b_f is 0, so that water and scene keep their
meaning. Point t, seen in frame f from the ray depth z, has

    S_tf = a_t + sum_k (c_k + d_k a_t) (phi_k(z) - mean_t phi_k),    phi = z, z^2

the water to second order about the point's own mean distance: it moves colors toward its own, the farther the more, by
amounts that depend on the color. Three models are compared on points that none was fitted to: with water alone, with
frames alone, and with both. The variation that frames explain beyond the water decides whether they are needed.

The maps themselves are fitted in the water that structure from motion measured, S_tf = J_t T_D(z) + B(z): free water
and free maps would share out between them what both can explain. Diagonal entries are nearly free, for that is what
exposure and white balance are; the others, and offsets, are held closer to 0, as frames that look farther than others
resemble frames with an offset.

Where the gains of a frame change over the image, as under local tone mapping, I_f = e^(s_f) (M_f S + b_f) with the
shading s_f of `swimm3r.appearance`, 0 on average over frames at every place. A further model has them, too.

Where the camera recorded its gains g_f on linear light, they make a model of their own, whose one free number is the
slope of the tone curve: M_f = diag(g_f^slope), about the identity. Maps of frames are then held to these, not to 1.
"""

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
import torch
from jaxtyping import Float, Int
from scipy.sparse import csr_matrix
from torch import Tensor

from swimm3r.appearance import ORDERS, about_identity

_ROUNDS = 8  # of alternating fits
_GAIN_STD, _MIX_STD, _OFFSET_STD = 0.3, 0.05, 0.02  # of a frame's map about the identity, before anything is seen
_SHADING_STD = 0.2  # of a logarithmic gain's slowest cosines, before anything is seen; faster ones have less
_REDUNDANCY = 100.0  # observations that share an error: what is common to a frame and no map of colors
_NEAR = 20.0  # observations that share an error as they are near each other in a frame
_LEAST_SCALE = 2e-3  # pixel value, the least spread that residuals are weighed by
_BRIGHTEST = 1.2  # clear color of a point
_TERMS = 4  # of the water, per channel
_HELD = 0.01  # range of the logarithms of recorded gains up to which a camera held them
_SLOPES = 0.0, 1.5  # of a tone curve in logarithms; sRGB's is 0.42 to 1
_DARK, _FULL = 0.02, 0.97  # pixel values beyond which nothing can be told about a color


@dataclass(frozen=True)
class ColorTracks:
    """Colors of points that several frames see."""

    color: Float[Tensor, "o 3"]
    ray_depth: Float[Tensor, " o"]
    point: Int[Tensor, " o"]
    frame: Int[Tensor, " o"]
    frames: int
    T_D: Float[Tensor, "o 3"] | None = None  # of the measured water; None where none was
    backscatter: Float[Tensor, "o 3"] | None = None
    gains: Float[Tensor, "f 3"] | None = None  # of linear light, by the camera's record
    cosines: Float[Tensor, "o k"] | None = None  # of shadings, at the places of the observations in their images


@dataclass(frozen=True)
class ColorEvidence:
    """Robust spreads, in pixel values, of the colors that one point has in several frames, on held-out points."""

    points: int
    alone: float  # about the point's mean color
    water: float  # about that and the water
    frames: float  # about that and the frames' maps
    both: float
    shaded: float | None = None  # about both and the frames' shadings; None where places in the image are not known
    recorded: float | None = None  # about the water and the gains that the camera recorded; None without any
    slope: float | None = None  # of the tone curve that they act through

    @property
    def by_water(self) -> float:
        """Share of the variance that the water explains."""
        return _explained(self.alone, self.water)

    @property
    def by_frames(self) -> float:
        """Share that the frames explain of what the water leaves."""
        return _explained(self.water, self.both)

    @property
    def by_shading(self) -> float | None:
        """Share that shadings explain of what water and frames leave; None where places in the image are not known."""
        return None if self.shaded is None else _explained(self.both, self.shaded)

    def is_shaded(self, least_share: float, least_change: float = 0.0) -> bool:
        """Return whether shadings explain so much of what water and frames leave, and change colors by so much."""
        if self.shaded is None or self.by_shading is None:
            return False
        moved = max(0.0, self.both**2 - self.shaded**2) ** 0.5
        return self.by_shading >= least_share and moved >= least_change

    @property
    def by_record(self) -> float | None:
        """Share that the recorded gains explain of what the water leaves; None without any."""
        return None if self.recorded is None else _explained(self.water, self.recorded)


@dataclass(frozen=True)
class FrameColorFit:
    """A frame's colors from the dive's: maps (M, b) as [3, 4], their mean over frames (identity, 0), and shadings."""

    maps: Float[Tensor, "f 3 4"]
    evidence: ColorEvidence
    shaded: "ShadedFit | None" = None  # None where places in the image are not known


@dataclass(frozen=True)
class ShadedFit:
    """The maps of all frames with their shadings, which are 0 on average over frames."""

    maps: Float[Tensor, "f 3 4"]
    shading: Float[Tensor, "f k 3"]


def fit_frame_colors(tracks: ColorTracks) -> FrameColorFit | None:
    """The maps of all frames, and how much they explain; None where fewer than 40 points are seen three times."""
    seen = _usable(tracks)
    points = np.unique(seen.point)
    if len(points) < 40:
        return None
    half = np.searchsorted(points, seen.point) % 2 == 0
    spreads = np.array([_spreads(seen.rows(half), seen.rows(~half)), _spreads(seen.rows(~half), seen.rows(half))])
    alone, water, frames, both, recorded, shaded = np.sqrt((spreads**2).mean(0)).tolist()
    of_record = (None, None) if seen.log_gains is None else (recorded, _recorded(seen).slope)
    center = _recorded(seen).maps
    of_shading = None if seen.cosines is None else shaded
    evidence = ColorEvidence(len(points), alone, water, frames, both, of_shading, *of_record)
    with_shading = None
    if seen.cosines is not None:
        fit = _final(seen, center, shaded=True)
        with_shading = ShadedFit(torch.from_numpy(fit.maps).float(), torch.from_numpy(fit.shading).float())
    return FrameColorFit(torch.from_numpy(_final(seen, center).maps).float(), evidence, with_shading)


@dataclass(frozen=True)
class _Seen:
    color: np.ndarray  # [o, 3]
    z: np.ndarray  # in medians
    point: np.ndarray
    frame: np.ndarray
    frames: int
    T_D: np.ndarray | None
    backscatter: np.ndarray | None
    log_gains: np.ndarray | None  # [f, 3], 0 on average; None where the camera recorded none, or held them
    cosines: np.ndarray | None = None  # [o, k]

    def rows(self, which: np.ndarray) -> "_Seen":
        T_D, backscatter, cosines = (
            None if values is None else values[which] for values in (self.T_D, self.backscatter, self.cosines)
        )
        own = self.color[which], self.z[which], self.point[which], self.frame[which], self.frames
        return _Seen(*own, T_D, backscatter, self.log_gains, cosines)

    def evened(self, shading: np.ndarray) -> "_Seen":
        """The same observations without the frames' shadings [f, k, 3]."""
        if self.cosines is None or not shading.any():
            return self
        log_gain = np.einsum("ok,okc->oc", self.cosines, shading[self.frame])
        return replace(self, color=self.color / np.exp(log_gain))


@dataclass(frozen=True)
class _Fit:
    water: np.ndarray  # [terms, 3]
    maps: np.ndarray  # [f, 3, 4]
    shading: np.ndarray  # [f, k, 3]
    slope: float = 0.0  # of the tone curve through which recorded gains act


# the maps of all frames from observations, common colors, weights, their scale, and the maps of before
MapFit = Callable[[_Seen, np.ndarray, np.ndarray, float, np.ndarray], np.ndarray]


def _usable(tracks: ColorTracks) -> _Seen:
    """Observations of points that three frames or more show neither dark nor full."""
    color, z = tracks.color.double().numpy(), tracks.ray_depth.double().numpy()
    point, frame = tracks.point.numpy(), tracks.frame.numpy()
    good = (color > _DARK).all(1) & (color < _FULL).all(1) & (z > 0) & np.isfinite(z)
    count = np.bincount(point[good], minlength=int(point.max(initial=0)) + 1)
    good &= count[point] >= 3
    T_D, backscatter = (None if each is None else each.double().numpy() for each in (tracks.T_D, tracks.backscatter))
    unit = np.median(z[good]) if good.any() else 1.0
    cosines = None if tracks.cosines is None else tracks.cosines.double().numpy()
    seen = _Seen(color, z / unit, point, frame, tracks.frames, T_D, backscatter, _log_gains(tracks), cosines)
    return seen.rows(good)


def _log_gains(tracks: ColorTracks) -> np.ndarray | None:
    if tracks.gains is None or not tracks.frames:
        return None
    logs = np.log(tracks.gains.double().numpy())
    logs = logs - logs.mean(0)
    return logs if np.ptp(logs, axis=0).max() > _HELD else None


class _Means:
    """Weighted means over the observations of each point."""

    def __init__(self, point: np.ndarray) -> None:
        self.point = np.unique(point, return_inverse=True)[1]
        self.weight = np.ones(len(point))

    def __call__(self, values: np.ndarray) -> np.ndarray:
        total = np.bincount(self.point, self.weight).clip(1e-12)
        return np.stack([np.bincount(self.point, self.weight * v) / total for v in values.T], -1)[self.point]

    def reweigh(self, residuals: np.ndarray) -> float:
        """Weigh observations by their residuals [o, 3] (Cauchy); returns the residuals' scale."""
        size = np.linalg.norm(residuals, axis=1)
        scale = max(_LEAST_SCALE, 1.4826 * float(np.median(size)))
        self.weight = 1 / (1 + (size / (2 * scale)) ** 2)
        return scale


def _basis(seen: _Seen, mean: _Means, a: np.ndarray) -> np.ndarray:
    """Terms [o, terms, 3] of the change that the water makes to the color of a point, per channel."""
    phi = np.stack([seen.z, seen.z**2], -1)
    phi = phi - mean(phi)
    return np.concatenate([np.repeat(phi[..., None], 3, -1), phi[..., None] * a[:, None]], 1)


def _spreads(fitted: _Seen, held: _Seen) -> list[float]:
    """Spreads of held-out points: alone, with water, with frames' maps, with both, with water and recorded gains, and
    with water, maps and shadings."""
    recorded = _recorded(fitted)
    own = _own_maps(recorded.maps)
    both = _fitted(fitted, True, own)
    shaded = both if fitted.cosines is None else _fitted(fitted, True, own, shaded=True)
    models = (_fitted(fitted, False), _fitted(fitted, True), _fitted(fitted, False, own), both, recorded, shaded)
    return [_spread(held, model) for model in models]


def _fitted(seen: _Seen, with_water: bool, map_fit: MapFit | None = None, *, shaded: bool = False) -> _Fit:
    """Robust alternating least squares."""
    filmed, maps = seen, np.tile(np.eye(3, 4), (seen.frames, 1, 1))
    shading = np.zeros((seen.frames, len(ORDERS), 3))
    water = np.zeros((_TERMS, 3))
    mean = _Means(seen.point)
    for _ in range(_ROUNDS if with_water or map_fit is not None else 0):
        seen = filmed.evened(shading)
        S = _common(seen, maps)
        a = mean(S)
        basis = _basis(seen, mean, a)
        if with_water:
            water = np.stack([_least_squares(basis[..., c], (S - a)[:, c], mean.weight) for c in range(3)], -1)
        of_water = np.einsum("otc,tc->oc", basis, water)
        predicted = mean(S - of_water) + of_water
        scale = mean.reweigh(seen.color - _filmed(seen, maps, predicted))
        if map_fit is not None:
            maps = map_fit(seen, predicted, mean.weight, scale, maps)
        if shaded:
            shading = _shadings(filmed, _filmed(seen, maps, predicted), mean.weight, scale)
    return _Fit(water, maps, shading)


def _recorded(seen: _Seen) -> _Fit:
    """Water, and the maps of the recorded gains through a tone curve of one slope; those of no gains without any."""
    if seen.log_gains is None:
        return _fitted(seen, True)
    fit = _fitted(seen, True, _record_maps)
    logs = np.log(np.diagonal(fit.maps[..., :3], axis1=1, axis2=2))
    slope = float((logs - logs.mean(0)).ravel() @ seen.log_gains.ravel() / (seen.log_gains**2).sum())
    return replace(fit, slope=slope)


def _record_maps(seen: _Seen, S: np.ndarray, weight: np.ndarray, scale: float, maps: np.ndarray) -> np.ndarray:
    """The maps of the recorded gains, with the slope of the tone curve that fits the colors of points best."""
    assert seen.log_gains is not None
    mean = _Means(seen.point)
    mean.weight = weight * (S.clip(_DARK) ** 2).mean(1)  # of logarithms
    x, y = seen.log_gains[seen.frame], np.log(seen.color / S.clip(_DARK))
    x, y = x - mean(x), y - mean(y)
    slope = (mean.weight @ (x * y).sum(1)) / max(float(mean.weight @ (x * x).sum(1)), 1e-12)
    out = np.tile(np.eye(3, 4), (seen.frames, 1, 1))
    out[:, range(3), range(3)] = np.exp(np.clip(slope, *_SLOPES) * seen.log_gains)
    return about_identity(torch.from_numpy(out)).numpy()


def _own_maps(center: np.ndarray) -> MapFit:
    """The fit of a free map per frame, held to `center` [f, 3, 4]."""

    def fit(seen: _Seen, S: np.ndarray, weight: np.ndarray, scale: float, maps: np.ndarray) -> np.ndarray:
        return _frame_maps(seen, S, weight, scale, maps, center)

    return fit


def _final(seen: _Seen, center: np.ndarray, *, shaded: bool = False) -> _Fit:
    """The maps of all observations, held to `center`: in the measured water, in free water where none was measured."""
    if seen.T_D is None:
        return _fitted(seen, True, _own_maps(center), shaded=shaded)
    return _fitted_in_water(seen, center, shaded=shaded)


def _fitted_in_water(seen: _Seen, center: np.ndarray, *, shaded: bool) -> _Fit:
    """The maps in known water, held to `center`."""
    assert seen.T_D is not None
    assert seen.backscatter is not None
    filmed, maps, mean = seen, center, _Means(seen.point)
    shading = np.zeros((seen.frames, len(ORDERS), 3))
    for _ in range(_ROUNDS):
        seen = filmed.evened(shading)
        direct = _common(seen, maps) - seen.backscatter
        J = (mean(seen.T_D * direct) / mean(seen.T_D**2).clip(1e-9)).clip(0.0, _BRIGHTEST)
        predicted = J * seen.T_D + seen.backscatter
        scale = mean.reweigh(seen.color - _filmed(seen, maps, predicted))
        maps = _frame_maps(seen, predicted, mean.weight, scale, maps, center)
        if shaded:
            shading = _shadings(filmed, _filmed(seen, maps, predicted), mean.weight, scale)
    return _Fit(np.zeros((_TERMS, 3)), maps, shading)


def _shadings(seen: _Seen, unshaded: np.ndarray, weight: np.ndarray, scale: float) -> np.ndarray:
    """The shadings [f, k, 3] from what the frames would show without, 0 on average, held to 0 where little is seen."""
    assert seen.cosines is not None
    unshaded = unshaded.clip(_DARK)
    delta, weights = np.log(seen.color / unshaded), weight[:, None] * unshaded**2
    order = np.hypot(*np.array(ORDERS).T)
    stay = np.diag(_NEAR * scale**2 * (order / _SHADING_STD) ** 2)
    found = np.zeros((seen.frames, len(ORDERS), 3))
    rows = np.argsort(seen.frame, kind="stable")
    ends = np.searchsorted(seen.frame[rows], np.arange(seen.frames + 1))
    for f in range(seen.frames):
        own = rows[ends[f] : ends[f + 1]]
        B = seen.cosines[own]
        for c in range(3):
            weighted = B * weights[own, c, None]
            found[f, :, c] = np.linalg.solve(weighted.T @ B + stay, weighted.T @ delta[own, c])
    return found - found.mean(0)


def _spread(seen: _Seen, fit: _Fit) -> float:
    """Robust spread of held-out points about what a fit says of their other observations."""
    seen = seen.evened(fit.shading)
    mean, off = _Means(seen.point), seen.color
    for _ in range(3):
        S = _common(seen, fit.maps)
        of_water = np.einsum("otc,tc->oc", _basis(seen, mean, mean(S)), fit.water)
        off = seen.color - _filmed(seen, fit.maps, mean(S - of_water) + of_water)
        mean.reweigh(off)
    return float(np.sqrt(np.average((off**2).mean(1), weights=mean.weight)))


def _common(seen: _Seen, maps: np.ndarray) -> np.ndarray:
    """Observed colors as the dive has them on average."""
    inverse = np.linalg.inv(maps[..., :3])
    return np.einsum("oij,oj->oi", inverse[seen.frame], seen.color - maps[seen.frame, :, 3])


def _filmed(seen: _Seen, maps: np.ndarray, S: np.ndarray) -> np.ndarray:
    return np.einsum("oij,oj->oi", maps[seen.frame, :, :3], S) + maps[seen.frame, :, 3]


def _least_squares(x: np.ndarray, y: np.ndarray, weight: np.ndarray) -> np.ndarray:
    information = (x * weight[:, None]).T @ x
    return np.linalg.solve(information + 1e-6 * len(x) * np.eye(x.shape[1]), x.T @ (weight * y))


def _frame_maps(
    seen: _Seen, S: np.ndarray, weight: np.ndarray, scale: float, maps: np.ndarray, center: np.ndarray
) -> np.ndarray:
    """Every frame's map from the dive's colors to its own, held to `center` where little is seen.

    By turns with the points' colors alone, frames that share no point would take long to agree. So the points are
    moved first by what gains of all frames, found at once, would change them by.
    """
    filmed = _filmed(seen, maps, S).clip(_DARK)
    delta = np.log(seen.color / filmed)
    of_points = _point_changes(seen, delta, weight * (filmed**2).mean(1), scale)
    return _affine_maps(seen, S * np.exp(of_points), weight, scale, center)


def _point_changes(seen: _Seen, delta: np.ndarray, weight: np.ndarray, scale: float) -> np.ndarray:
    """The change of each observation's point [o, 3] in delta_tf = gain_f + change_t, weighted least squares."""
    point = np.unique(seen.point, return_inverse=True)[1]
    links = csr_matrix((weight, (seen.frame, point)), shape=(seen.frames, int(point.max()) + 1))
    of_point = np.asarray(links.sum(0)).ravel().clip(1e-12)
    shared = links.multiply(1 / of_point).tocsr() @ links.T
    stay = _REDUNDANCY * scale**2 / _GAIN_STD**2
    system = np.diag(np.asarray(links.sum(1)).ravel() + stay) - shared.toarray()
    changes = np.zeros((len(point), 3))
    for c in range(3):
        mean = np.bincount(point, weight * delta[:, c]) / of_point
        left = np.bincount(seen.frame, weight * (delta[:, c] - mean[point]), minlength=seen.frames)
        gains = np.linalg.solve(system, left)
        changes[:, c] = (np.bincount(point, weight * (delta[:, c] - gains[seen.frame])) / of_point)[point]
    return changes


def _affine_maps(seen: _Seen, S: np.ndarray, weight: np.ndarray, scale: float, center: np.ndarray) -> np.ndarray:
    x = np.concatenate([S, np.ones((len(S), 1))], 1)
    information, products = np.zeros((seen.frames, 4, 4)), np.zeros((seen.frames, 4, 3))
    for i in range(4):
        for j in range(i, 4):
            of = np.bincount(seen.frame, weight * x[:, i] * x[:, j], minlength=seen.frames)
            information[:, i, j] = information[:, j, i] = of
        for c in range(3):
            products[:, i, c] = np.bincount(seen.frame, weight * x[:, i] * seen.color[:, c], minlength=seen.frames)
    found = np.empty((seen.frames, 3, 4))
    for c in range(3):
        std = np.array([_GAIN_STD if i == c else _MIX_STD for i in range(3)] + [_OFFSET_STD])
        stay = np.diag(_REDUNDANCY * scale**2 / std**2)
        held = center[:, c] @ stay
        found[:, c] = np.linalg.solve(information + stay, (products[..., c] + held)[..., None])[..., 0]
    return about_identity(torch.from_numpy(found)).numpy()


def _explained(before: float, after: float) -> float:
    return 1 - (after / before) ** 2 if before > 0 else 0.0
