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
shading s_f of `swimm3r.appearance`, 0 on average over frames at every place. A further model has them, too, the
same for all channels. Where a lamp lights the ground, average colors of parts of the images are held to ground that
reflects alike (`GroundColors`): points do not tell of light that all frames of a line share.

Where the camera recorded its gains g_f on linear light, they make a model of their own, whose one free number is the
slope of the tone curve: M_f = diag(g_f^slope), about the identity. Maps of frames are then held to these, not to 1.
"""

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
import torch
from jaxtyping import Float, Int
from torch import Tensor

from swimm3r.appearance import ORDERS, about_identity
from swimm3r.imaging.joint_gains import GainEvidence, joint_gains

_ROUNDS = 8  # of alternating fits
_GAIN_STD, _MIX_STD, _OFFSET_STD = 0.3, 0.05, 0.02  # of a frame's map about the identity, before anything is seen
_SHADING_STD = 0.2  # of a logarithmic gain's slowest cosines, before anything is seen; faster ones have less
_GROUND_STD, _GROUND_SHARED = 0.3, 4.0  # of average colors in parts of images about the dive's, and parts that share it
_REDUNDANCY = 100.0  # observations that share an error: what is common to a frame and no map of colors
_NEAR = 20.0  # observations that share an error as they are near each other in a frame
_LEAST_SCALE = 2e-3  # pixel value, the least spread that residuals are weighed by
_BRIGHTEST = 1.2  # clear color of a point
_TERMS = 4  # of the water, per channel
_HELD = 0.01  # range of the logarithms of recorded gains up to which a camera held them
_SLOPES = 0.0, 1.5  # of a tone curve in logarithms; sRGB's is 0.42 to 1
_DARK, _FULL = 0.02, 0.97  # pixel values beyond which nothing can be told about a color


@dataclass(frozen=True)
class GroundColors:
    """Average colors of the ground in parts of the images, with the water before it."""

    color: Float[Tensor, "m 3"]
    T_D: Float[Tensor, "m 3"]
    backscatter: Float[Tensor, "m 3"]
    frame: Int[Tensor, " m"]
    cosines: Float[Tensor, "m k"]  # at the middle of the part


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
    ground: GroundColors | None = None  # where the frames are taken to show alike ground


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
        fit = _final(seen, center, shaded=True, ground=tracks.ground)
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

    def terms(self, *, shaded: bool) -> np.ndarray:
        """The constant, and the cosines of shadings if there are to be any, [o, k]."""
        constant = np.ones((len(self.point), 1))
        return constant if self.cosines is None or not shaded else np.concatenate([constant, self.cosines], 1)

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


# the maps and shadings of all frames from observations as filmed, common colors, weights, their scale, and the maps of
# before
Turn = Callable[[_Seen, np.ndarray, np.ndarray, float, np.ndarray], tuple[np.ndarray, np.ndarray]]


def _no_shading(frames: int) -> np.ndarray:
    return np.zeros((frames, len(ORDERS), 3))


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
    own = _own_colors(recorded.maps)
    both = _fitted(fitted, True, own)
    shaded = both if fitted.cosines is None else _fitted(fitted, True, _own_colors(recorded.maps, shaded=True))
    models = (_fitted(fitted, False), _fitted(fitted, True), _fitted(fitted, False, own), both, recorded, shaded)
    return [_spread(held, model) for model in models]


def _fitted(filmed: _Seen, with_water: bool, turn: Turn | None = None) -> _Fit:
    """Robust alternating least squares."""
    fit = _Fit(np.zeros((_TERMS, 3)), np.tile(np.eye(3, 4), (filmed.frames, 1, 1)), _no_shading(filmed.frames))
    mean = _Means(filmed.point)
    for _ in range(_ROUNDS if with_water or turn is not None else 0):
        seen = filmed.evened(fit.shading)
        S = _common(seen, fit.maps)
        a = mean(S)
        basis = _basis(seen, mean, a)
        if with_water:
            found = [_least_squares(basis[..., c], (S - a)[:, c], mean.weight) for c in range(3)]
            fit = replace(fit, water=np.stack(found, -1))
        of_water = np.einsum("otc,tc->oc", basis, fit.water)
        predicted = mean(S - of_water) + of_water
        scale = mean.reweigh(seen.color - _filmed(seen, fit.maps, predicted))
        if turn is not None:
            maps, shading = turn(filmed, predicted, mean.weight, scale, fit.maps)
            fit = replace(fit, maps=maps, shading=shading)
    return fit


def _recorded(seen: _Seen) -> _Fit:
    """Water, and the maps of the recorded gains through a tone curve of one slope; those of no gains without any."""
    if seen.log_gains is None:
        return _fitted(seen, True)
    fit = _fitted(seen, True, _record_maps)
    logs = np.log(np.diagonal(fit.maps[..., :3], axis1=1, axis2=2))
    slope = float((logs - logs.mean(0)).ravel() @ seen.log_gains.ravel() / (seen.log_gains**2).sum())
    return replace(fit, slope=slope)


def _record_maps(
    seen: _Seen, S: np.ndarray, weight: np.ndarray, scale: float, maps: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """The maps of the recorded gains, with the slope of the tone curve that fits the colors of points best."""
    assert seen.log_gains is not None
    mean = _Means(seen.point)
    mean.weight = weight * (S.clip(_DARK) ** 2).mean(1)  # of logarithms
    x, y = seen.log_gains[seen.frame], np.log(seen.color / S.clip(_DARK))
    x, y = x - mean(x), y - mean(y)
    slope = (mean.weight @ (x * y).sum(1)) / max(float(mean.weight @ (x * x).sum(1)), 1e-12)
    out = np.tile(np.eye(3, 4), (seen.frames, 1, 1))
    out[:, range(3), range(3)] = np.exp(np.clip(slope, *_SLOPES) * seen.log_gains)
    return about_identity(torch.from_numpy(out)).numpy(), _no_shading(seen.frames)


def _own_colors(center: np.ndarray, *, shaded: bool = False, ground: GroundColors | None = None) -> Turn:
    """The fit of a free map per frame, held to `center` [f, 3, 4], and of shadings, held to 0 and to even `ground`.

    Lights that move and local tone mapping change all channels alike, and so do shadings: what changes by channel over
    an image is water, which they would take for their own. By turns with the points' colors alone, frames that share no
    point would take long to agree. So the points are moved first by what gains and shadings of all frames, found at
    once, would change them by.
    """

    def turn(
        filmed: _Seen, S: np.ndarray, weight: np.ndarray, scale: float, maps: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray]:
        expected = _filmed(filmed, maps, S).clip(_DARK)
        delta, of_logs = np.log(filmed.color / expected), weight * (expected**2).mean(1)
        shown = of_logs, filmed.point, filmed.frame
        alone = _held_to_none(filmed.frames, scale, shaded=shaded)
        if ground is not None:
            alone = _with_ground(alone, ground, maps, scale)
        mean = delta.mean(1, keepdims=True)
        of_all = joint_gains(mean, filmed.terms(shaded=shaded), *shown, alone)
        apart = _held_to_none(filmed.frames, scale, shaded=False)
        of_each = joint_gains(delta - mean, filmed.terms(shaded=False), *shown, apart)
        shading = np.repeat(of_all.gains[:, 1:], 3, -1) if shaded else _no_shading(filmed.frames)
        moved = S * np.exp(of_all.changes + of_each.changes)
        return _affine_maps(filmed.evened(shading), moved, weight, scale, center), shading

    return turn


def _held_to_none(frames: int, scale: float, *, shaded: bool) -> GainEvidence:
    """Gains of frames, and their shadings if there are to be any, before anything is seen."""
    stay = [_REDUNDANCY / _GAIN_STD**2]
    if shaded:
        stay += list(_NEAR * (np.hypot(*np.array(ORDERS).T) / _SHADING_STD) ** 2)
    return GainEvidence(np.tile(scale**2 * np.diag(stay), (frames, 1, 1)), np.zeros((frames, len(stay), 1)))


def _with_ground(alone: GainEvidence, ground: GroundColors, maps: np.ndarray, scale: float) -> GainEvidence:
    """With ground that reflects alike everywhere, within `_GROUND_STD`."""
    terms = np.concatenate([np.ones((len(ground.frame), 1)), ground.cosines.double().numpy()], 1)
    color, T_D, B = (values.double().numpy() for values in (ground.color, ground.T_D, ground.backscatter))
    frame = ground.frame.numpy()
    inverse = np.linalg.inv(maps[..., :3])
    direct = np.einsum("mij,mj->mi", inverse[frame], color - maps[frame, :, 3]) - B
    J = direct.sum(0) / T_D.sum(0)
    expected = np.einsum("mij,mj->mi", maps[frame, :, :3], J * T_D + B) + maps[frame, :, 3]
    expected = expected.clip(_DARK)
    std = np.hypot(_GROUND_STD * J * T_D, _DARK) / expected
    weight = _NEAR * scale**2 / (_GROUND_SHARED * std**2).mean(1)
    delta = np.log(color.clip(_DARK) / expected).mean(1, keepdims=True)
    information, products = alone.information.copy(), alone.products.copy()
    np.add.at(information, frame, weight[:, None, None] * terms[:, :, None] * terms[:, None, :])
    np.add.at(products, frame, weight[:, None, None] * terms[:, :, None] * delta[:, None, :])
    return GainEvidence(information, products)


def _final(seen: _Seen, center: np.ndarray, *, shaded: bool = False, ground: GroundColors | None = None) -> _Fit:
    """The maps of all observations, held to `center`: in the measured water, in free water where none was measured."""
    turn = _own_colors(center, shaded=shaded, ground=ground)
    return _fitted(seen, True, turn) if seen.T_D is None else _fitted_in_water(seen, center, turn)


def _fitted_in_water(filmed: _Seen, center: np.ndarray, turn: Turn) -> _Fit:
    """The maps in known water, from those of `center` on."""
    assert filmed.T_D is not None
    assert filmed.backscatter is not None
    maps, shading, mean = center, _no_shading(filmed.frames), _Means(filmed.point)
    for _ in range(_ROUNDS):
        seen = filmed.evened(shading)
        direct = _common(seen, maps) - filmed.backscatter
        J = (mean(filmed.T_D * direct) / mean(filmed.T_D**2).clip(1e-9)).clip(0.0, _BRIGHTEST)
        predicted = J * filmed.T_D + filmed.backscatter
        scale = mean.reweigh(seen.color - _filmed(seen, maps, predicted))
        maps, shading = turn(filmed, predicted, mean.weight, scale, maps)
    return _Fit(np.zeros((_TERMS, 3)), maps, shading)


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
