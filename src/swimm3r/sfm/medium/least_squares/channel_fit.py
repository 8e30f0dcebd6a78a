"""One color channel of the water: what its pixels say, and the bounded least squares that weighs it (see seathru.py).

Cameras in video change exposure and white balance from frame to frame: I = g_f (J T_D + B). The gains g_f are estimated
with the water, and the residuals of a frame are whitened against the gain error tau that is left,

    r' = r - (1 - 1 / sqrt(1 + tau^2 |p|^2)) p (p . r) / |p|^2,    p = its prediction in units of its noise,

so that brightness common to a whole frame says little about the water. Depths are in units of their median.

Under a lamp on the camera (`lamp_fit.py`), T_D stands for all that becomes of its light, and the growth of backscatter
with distance is that of the beam: beta_B is then not fitted.
"""

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from swimm3r.sfm.medium.least_squares import kernels
from swimm3r.sfm.medium.settings import SeathruSettings

BINF, LOG_BETA_B, LOG_BETA_D, SLOPE, DARK, LOG_MEAN = range(6)  # the unknowns
LOWER = np.array([0.0, np.log(0.01), np.log(0.01), -2.0, 0.0, np.log(0.02)])
UPPER = np.array([1.0, np.log(10.0), np.log(10.0), 0.0, 0.2, np.log(1.5)])
_STEPS = 50
_SWEEPS = 30  # alternations between gains and J; each is a few sums


@dataclass(frozen=True)
class Ways:
    """Ways of light to pixels: from the surface at `z`, and before from the lamp to the surface if there is one."""

    z: np.ndarray
    path: np.ndarray  # length that light is attenuated over: z in daylight
    log_gain: np.ndarray  # of the light on the surface: 0 in daylight
    scatter: np.ndarray | None = None  # B over Binf under a lamp; None in daylight, where beta_B tells it

    def rows(self, which: np.ndarray) -> "Ways":
        """The ways of some pixels."""
        return self.each(lambda values: values[which])

    def each(self, change: Callable[[np.ndarray], np.ndarray]) -> "Ways":
        """The ways with every array changed."""
        scatter = None if self.scatter is None else change(self.scatter)
        return Ways(change(self.z), change(self.path), change(self.log_gain), scatter)


def daylight(z: np.ndarray) -> Ways:
    """Ways of light that falls evenly."""
    return Ways(z, z, np.zeros_like(z))


@dataclass(frozen=True)
class Pixels:
    """All samples of one channel."""

    I: np.ndarray
    ways: Ways
    frame: np.ndarray  # 0.. without gaps
    open_water: np.ndarray
    measured: np.ndarray  # False where the depth is a guess: such pixels tell of the darkest alone

    def of_measured_depth(self) -> "Pixels":
        """The pixels whose depth is no guess."""
        rows = self.measured
        return Pixels(self.I[rows], self.ways.rows(rows), self.frame[rows], self.open_water, rows[rows])


@dataclass(frozen=True)
class Observations:
    """Those samples that show points seen from several distances; `point` counts 0.. without gaps."""

    rows: np.ndarray  # into the samples
    ways: Ways
    point: np.ndarray
    frame: np.ndarray
    I: np.ndarray
    grids: int = 1  # of patches, all of which show the same pixels

    @cached_property
    def points(self) -> int:
        """Number of points."""
        return int(self.point.max()) + 1

    @cached_property
    def frames(self) -> int:
        """One more than the last frame."""
        return int(self.frame.max()) + 1

    @property
    def brightest(self) -> float:
        """Largest J: none under a lamp, of which J is known up to a factor."""
        return 1.0 if self.ways.scatter is None else np.inf


@dataclass(frozen=True)
class ChannelFit:
    """The unknowns at the optimum, and their covariance."""

    x: np.ndarray
    covariance: np.ndarray


@dataclass(frozen=True)
class _RangeBins:
    of_dark: Ways  # medians of the darkest pixels of each bin
    dark: np.ndarray
    of_mean: Ways  # medians of all
    mean: np.ndarray


@dataclass(frozen=True)
class Evidence:
    """Evidence besides the observations."""

    bins: _RangeBins
    Binf: tuple[float, float]  # median of open water, or else the mean of what is far, and its standard deviation
    alone: bool  # no observations
    lower: np.ndarray
    upper: np.ndarray

    def lit(self, brighter: float) -> "Evidence":
        """The evidence under a lamp whose strength has a logarithm that much larger."""

        def changed(ways: Ways) -> Ways:
            return replace(ways, log_gain=ways.log_gain + brighter)

        bins = replace(self.bins, of_dark=changed(self.bins.of_dark), of_mean=changed(self.bins.of_mean))
        return replace(self, bins=bins)


@dataclass(frozen=True)
class _Noise:
    """Noise of the observations; weights are square roots of inverse variances."""

    weight: np.ndarray
    gain_std: float  # tau


def fit_channel(pixels: Pixels, observations: Observations | None, settings: SeathruSettings) -> ChannelFit:
    """The water of one channel, with frame gains only where steady exposure leaves far larger residuals.

    A camera that rises over flat ground with changing exposure looks like one with a steady exposure in other water:
    gains that are not needed would only blur the answer.
    """
    if observations is None:
        evidence = evidence_of(pixels, settings, alone=True)
        x = best_start(evidence, None, 0.0, settings)
        return ChannelFit(x, _covariance(x, evidence, None, None, settings))
    fit, spread = _fit_observations(pixels, observations, 0.0, settings)
    if len(np.unique(observations.frame)) > 2:
        varying, smaller = _fit_observations(pixels, observations, settings.gain_std, settings)
        if smaller < settings.gain_evidence * spread:
            return varying
    return fit


def _fit_observations(
    pixels: Pixels, observations: Observations, gain_std: float, settings: SeathruSettings
) -> tuple[ChannelFit, float]:
    """Robust least squares from a grid of starts, refined on all observations; and the spread of their residuals.

    Residuals count in units of `scale * sqrt(redundancy)`: their spread, and how many of them repeat the same error
    (estimated from how much the gradients of whole frames scatter).
    """
    evidence = evidence_of(pixels, settings)
    x = best_start(evidence, observations, gain_std, settings)
    least = settings.min_redundancy * observations.grids
    robust, redundancy = np.ones(len(observations.I)), least
    gain, tau = np.ones(pixels.frame.max() + 1), gain_std
    seen, noise = observations, _Noise(robust, tau)
    for _ in range(settings.reweightings):
        r = _residuals(x, seen, robust)
        scale = float(np.clip(1.4826 * np.median(np.abs(r)), 1e-3, settings.loss_scale))
        robust = 1 / np.sqrt(1 + (r / (2 * scale)) ** 2)
        if gain_std > 0:
            gain, tau = _gains(x, observations, robust / scale**2, tau, len(gain))
            seen = replace(observations, I=observations.I / gain[observations.frame])
            evidence = evidence_of(replace(pixels, I=pixels.I / gain[pixels.frame]), settings, tau)
        noise = _Noise(np.sqrt(robust / redundancy) / scale, tau)
        x = _solve(x, evidence, seen, noise, settings)
        redundancy = max(least, _redundancy(x, seen, _Noise(np.sqrt(robust) / scale, tau)))
    spread = float(np.median(np.abs(_residuals(x, seen, robust))))
    return ChannelFit(x, _covariance(x, evidence, seen, noise, settings)), spread


def evidence_of(pixels: Pixels, settings: SeathruSettings, gain_std: float = 0.0, alone: bool = False) -> Evidence:
    """Everything that pixels tell besides the points among them; gains of frames are uncertain by `gain_std`."""
    water = _open_water_color(pixels.open_water, gain_std, settings)
    lower, upper = LOWER.copy(), UPPER.copy()
    I, z = pixels.I[pixels.measured], pixels.ways.z[pixels.measured]
    upper[BINF] = _largest_Binf(I, z)
    if water is None:
        far = float(np.mean(I[z >= np.quantile(z, 0.9)]))
        return Evidence(_range_bins(pixels, settings), (far, settings.far_color_std), alone, lower, upper)
    upper[BINF] = min(1.0, max(upper[BINF], water[0] + 3 * water[1]))
    return Evidence(_range_bins(pixels, settings), water, alone, lower, upper)


def _range_bins(pixels: Pixels, settings: SeathruSettings) -> _RangeBins:
    """The darkest pixels of each of `range_bins` equal depth intervals, and the average of those of measured depth.

    The darkest of this channel: leaves whose green reaches the camera leave nothing of red but the backscatter.
    """
    I, z = pixels.I, pixels.ways.z
    nearest, farthest = np.quantile(z[pixels.measured], [0.002, 0.998])
    edges = np.linspace(nearest, farthest, settings.range_bins + 1)
    which = np.digitize(z, edges[1:-1])
    dark, measured = [], []
    for k in range(settings.range_bins):
        inside = np.flatnonzero(which == k)
        told = inside[pixels.measured[inside]]
        if len(told) < settings.min_bin_pixels:
            continue
        count = int(np.ceil(settings.dark_fraction * len(inside)))
        dark.append(inside[np.argpartition(I[inside], count - 1)[:count]])
        measured.append(told)
    if not dark:  # few samples: one bin is all there is
        dark.append(np.argsort(I, kind="stable")[: max(1, int(settings.dark_fraction * len(z)))])
        measured.append(np.flatnonzero(pixels.measured))
    return _RangeBins(
        _median_ways(pixels.ways, dark),
        np.array([np.median(I[which]) for which in dark]),
        _median_ways(pixels.ways, measured),
        np.array([np.mean(I[which]) for which in measured]),
    )


def _median_ways(ways: Ways, bins: list[np.ndarray]) -> Ways:
    return ways.each(lambda values: np.array([np.median(values[rows]) for rows in bins]))


def _open_water_color(I: np.ndarray, gain_std: float, settings: SeathruSettings) -> tuple[float, float] | None:
    if len(I) < settings.min_open_water:
        return None
    spread = 1.4826 * np.median(np.abs(I - np.median(I)))
    middle = float(np.median(I))
    return middle, float(np.hypot(np.hypot(spread / 2, gain_std * middle), settings.open_water_std))


def _largest_Binf(I: np.ndarray, z: np.ndarray) -> float:
    """The veiling light is hardly brighter than the brightest things in the farthest tenth of the scene."""
    far = z >= np.quantile(z, 0.9)
    return float(np.clip(1.2 * np.quantile(I[far], 0.98), 0.02, 1.0))


def _log_transmittance(x: np.ndarray, ways: Ways) -> np.ndarray:
    """ln T_D: finite where T_D itself underflows, at many times the median depth."""
    return ways.log_gain - np.exp(x[LOG_BETA_D] + x[SLOPE] * ways.z) * ways.path


def attenuations(x: np.ndarray, ways: Ways) -> tuple[np.ndarray, np.ndarray]:
    """T_D and B of light on its ways."""
    scatter = -np.expm1(-np.exp(x[LOG_BETA_B]) * ways.z) if ways.scatter is None else ways.scatter
    return np.exp(_log_transmittance(x, ways)), x[BINF] * scatter


def _residuals(x: np.ndarray, seen: Observations, weight: np.ndarray) -> np.ndarray:
    """I - B - J T_D with the J of every point eliminated."""
    T_D, B = attenuations(x, seen.ways)
    direct = seen.I - B
    J = kernels.surface_colors(T_D, direct, weight, seen.point, seen.points, seen.brightest)
    return direct - J[seen.point] * T_D


def _whitened(x: np.ndarray, seen: Observations, noise: _Noise) -> np.ndarray:
    """The residuals in units of their noise, blind to a common gain of each frame as far as gains are uncertain."""
    residuals = _residuals(x, seen, noise.weight**2)
    return kernels.whitened(residuals, seen.I, noise.weight, seen.frame, seen.frames, noise.gain_std)


def _gains(
    x: np.ndarray, seen: Observations, weight: np.ndarray, gain_std: float, frames: int
) -> tuple[np.ndarray, float]:
    """The gain of every frame, 1 on average and 1 where a frame has no observations, and how much gains vary."""
    T_D, B = attenuations(x, seen.ways)
    present = np.bincount(seen.frame, minlength=frames) > 0
    gain = kernels.frame_gains(
        T_D, B, seen.I, weight, seen.point, seen.frame, seen.points, present, 1 / gain_std**2, _SWEEPS, seen.brightest
    )
    return gain, float(np.clip(np.sqrt(np.mean(np.log(gain[present]) ** 2)), 1e-3, 0.15))


def prior_residuals(x: np.ndarray, evidence: Evidence, settings: SeathruSettings) -> np.ndarray:
    """Everything but the tracks, each in its own standard deviations.

    Light cannot be missing, so B above the dark envelope is a fault, and a bin without anything black is none. Without
    observations nothing tells J' from B: then the darkest pixels are taken for black, as Sea-Thru does.
    """
    bins = evidence.bins
    T_D, B = attenuations(x, bins.of_dark)
    dark = (bins.dark - B - x[DARK] * T_D) / settings.dark_std
    if not evidence.alone:
        dark = np.where(dark < 0, 3.0 * dark, np.sqrt(2 * (np.sqrt(1 + dark.clip(0) ** 2) - 1)))
    _, B = attenuations(x, bins.of_mean)
    expected = np.exp(x[LOG_MEAN] + _log_transmittance(x, bins.of_mean))
    average = (bins.mean - B - expected) / np.hypot(settings.average_std * expected, settings.dark_std)
    single = [
        x[DARK] / 0.003 if evidence.alone else (x[DARK] - settings.dark_reflectance) / settings.dark_reflectance_std,
        (x[LOG_MEAN] + np.log(settings.lsac_f)) / settings.mean_reflectance_std,
        (x[LOG_BETA_B] - x[LOG_BETA_D] + 0.7) / 1.0,  # r = beta_B / beta_D is U(0, 1) in the paper: log mean -1, std 1
        x[SLOPE] / settings.slope_std,
        (x[BINF] - evidence.Binf[0]) / evidence.Binf[1],
    ]
    return np.concatenate([dark, average / np.sqrt(len(average)), single])


def _solve(
    start: np.ndarray, evidence: Evidence, seen: Observations | None, noise: _Noise | None, settings: SeathruSettings
) -> np.ndarray:
    """Levenberg-Marquardt within the bounds: unknowns that press against a bound are left out of the step.

    Six unknowns and up to 10^5 residuals: normal equations are 20 times cheaper than a general solver's SVD.
    """

    last = (np.full(4, np.nan), np.zeros(0))  # the unknowns that observations see, and their residuals

    def residuals(x: np.ndarray) -> np.ndarray:
        nonlocal last
        prior = prior_residuals(x, evidence, settings)
        if seen is None or noise is None:
            return prior
        if not np.array_equal(last[0], x[:4]):
            last = (x[:4].copy(), _whitened(x, seen, noise))
        return np.concatenate([prior, last[1]])

    x = np.clip(start, evidence.lower, evidence.upper)
    r, damping = residuals(x), 1e-3
    for _ in range(_STEPS):
        rows = _jacobian(residuals, x, r)
        gradient, information = rows.T @ r, rows.T @ rows
        pressed = ((x <= evidence.lower) & (gradient > 0)) | ((x >= evidence.upper) & (gradient < 0))
        free = np.flatnonzero(~pressed)
        before = r @ r
        while damping < 1e8:
            system = information[np.ix_(free, free)]
            step = np.zeros_like(x)
            step[free] = -np.linalg.solve(system + np.diag(damping * np.diag(system) + 1e-9), gradient[free])
            tried = np.clip(x + step, evidence.lower, evidence.upper)
            r_tried = residuals(tried)
            if r_tried @ r_tried < before:
                x, r, damping = tried, r_tried, max(damping / 8, 1e-9)
                break
            damping *= 6
        if before - r @ r < 1e-7 * before:
            break
    return x


def best_start(
    evidence: Evidence, observations: Observations | None, gain_std: float, settings: SeathruSettings
) -> np.ndarray:
    """The best local optimum from a grid of starts, on few observations."""
    few = None if observations is None else thinned(observations, settings.start_observations)
    noise = None if few is None else _Noise(np.full(len(few.I), 1 / settings.loss_scale), gain_std)
    best, lowest = None, np.inf
    for start in _starts(evidence):
        x = _solve(start, evidence, few, noise, settings)
        cost = (prior_residuals(x, evidence, settings) ** 2).sum()
        if few is not None and noise is not None:
            cost += 2 * (np.sqrt(1 + _whitened(x, few, noise) ** 2) - 1).sum()
        if cost < lowest:
            best, lowest = x, cost
    assert best is not None
    return best


def _starts(evidence: Evidence) -> list[np.ndarray]:
    return [
        np.array([evidence.Binf[0], np.log(beta_B), np.log(beta_D), 0.0, 0.02, np.log(0.4)])
        for beta_B in (0.1, 0.5, 2.0)
        for beta_D in (0.2, 0.7, 2.0)
    ]


def thinned(seen: Observations, count: int) -> Observations:
    """Every k-th point, so that about `count` observations remain."""
    step = max(1, int(np.ceil(len(seen.I) / count)))
    rows = np.flatnonzero(seen.point % step == 0)
    return replace(
        seen, rows=seen.rows[rows], ways=seen.ways.rows(rows), point=seen.point[rows] // step, frame=seen.frame[rows],
        I=seen.I[rows],
    )  # fmt: skip


def _jacobian(residuals: Callable[[np.ndarray], np.ndarray], x: np.ndarray, at_x: np.ndarray) -> np.ndarray:
    """By forward differences, the last unknown first; the unknowns are all of order 1."""
    columns = [(residuals(x + 1e-6 * e) - at_x) / 1e-6 for e in reversed(np.eye(len(x)))]
    return np.stack(columns[::-1], -1)


def _scores(x: np.ndarray, seen: Observations, noise: _Noise) -> tuple[np.ndarray, np.ndarray]:
    """Information of the observations about the unknowns they see, and the gradient each frame contributes."""
    r = _whitened(x, seen, noise)
    rows = _jacobian(lambda y: _whitened(np.concatenate([y, x[4:]]), seen, noise), x[:4], r)
    gradient = np.stack([np.bincount(seen.frame, rows[:, i] * r) for i in range(rows.shape[1])], -1)
    return rows.T @ rows, gradient[np.unique(seen.frame)]


def _redundancy(x: np.ndarray, seen: Observations, noise: _Noise) -> float:
    """By how much the gradients of whole frames scatter more than independent residuals would let them."""
    return float(frame_scatter(*_scores(x, seen, noise)).mean())


def frame_scatter(information: np.ndarray, gradient: np.ndarray) -> np.ndarray:
    """Variance of the frames' gradients, [frames, unknowns], in units of the one that the information lets expect.

    It is given along each eigenvector of the information that tells anything.
    """
    gradient = gradient - gradient.mean(0)
    values, vectors = np.linalg.eigh(information)
    visible = values > 1e-6 * values.max()
    whitened = gradient @ vectors[:, visible] / np.sqrt(values[visible])
    return (whitened**2).sum(0) * len(gradient) / max(1, len(gradient) - 1)


def _covariance(
    x: np.ndarray, evidence: Evidence, seen: Observations | None, noise: _Noise | None, settings: SeathruSettings
) -> np.ndarray:
    """From the curvature at the optimum; unknowns at a bound keep their freedom to leave it.

    On top comes what errors of depth do, which no residual shows: where observations of a point differ by s in ln z and
    each is wrong by `depth_error`, differences in depth are overrated by depth_error^2 / s^2, and the betas with them.
    """
    at_x = prior_residuals(x, evidence, settings)
    prior = _jacobian(lambda y: prior_residuals(y, evidence, settings), x, at_x)
    information = prior.T @ prior
    if seen is None or noise is None:
        return np.linalg.inv(information + 1e-9 * np.eye(len(x)))
    information[:4, :4] += _scores(x, seen, noise)[0]
    log_z = np.log(seen.ways.z)
    log_z = log_z - (np.bincount(seen.point, log_z) / np.bincount(seen.point))[seen.point]
    overrated = settings.depth_error**2 / np.mean(log_z**2)
    extra = np.zeros(len(x))
    extra[[LOG_BETA_B, LOG_BETA_D]] = overrated**2
    return np.linalg.inv(information + 1e-9 * np.eye(len(x))) + np.diag(extra)
