"""A lamp on the camera from the pixels that tell the water (see seathru.py), as `swimm3r.lamp` describes it.

    I_k = J_t L(X_k) exp(-beta_D (|X_k - p| + z_k)) + Binf G(d_k, z_k) / G(axis, infinity)

One robust least-squares problem over all channels finds strength, beam and position of the lamp, which the channels
share, with the water of each, which is then fitted again by itself. The colors J_t are eliminated. G moves with lamp
and water in every step: held at that of the step before, it leads both to others that explain less.

Known is the light on the same point in several places of the image and at several distances. Its strength is known as a
product with J alone: it is what makes surfaces reflect 1 / f on average, in the water that the channels have in the end
(`of_average_color`). J has no largest value here: one point with a wrong depth would set the strength by it. The power
of its fall-off is not fitted, as attenuation looks much like it over the distances of a dive: it is that of a small
lamp, 2 in linear light. For the same reason the lamp stands beside the camera, not ahead of it or behind, and beta_D
changes little with distance (`lamp_slope_std`).

Points that move along one axis of the images leave the beam across it open. Surfaces that are seen in one part of the
images reflect about as much as those in another, on average. Slopes and errors of depth, which many points share, would
outweigh that: points count by how well whole frames agree on the lamp (`redundancy_at`).
"""

from dataclasses import dataclass, replace
from typing import Any, cast

import numpy as np
import torch
from jaxtyping import Float
from scipy.optimize import least_squares, nnls
from torch import Tensor

from swimm3r.lamp import (
    FAR,
    FEW_NODES,
    INVERSE_SQUARE,
    NODES,
    STORED,
    TERMS,
    Lamp,
    lamp_distance,
    log_light,
    nodes_along,
    pattern_terms,
)
from swimm3r.medium import Encoding
from swimm3r.sfm.medium.least_squares import kernels
from swimm3r.sfm.medium.least_squares.channel_fit import (
    BINF,
    LOG_BETA_D,
    LOG_MEAN,
    SLOPE,
    Evidence,
    Observations,
    Pixels,
    Ways,
    attenuations,
    best_start,
    daylight,
    evidence_of,
    frame_scatter,
    prior_residuals,
    thinned,
)
from swimm3r.sfm.medium.settings import SeathruSettings

_BEAM_STD, _STRENGTH_STD = 3.0, 1.0  # of the beam's coefficients, and of the strength's logarithm
_OFFSET_STD = 0.2  # of the lamp's position beside the camera, in median depths
_WIDEST = 3.0  # of these that an unknown may reach
_NEAR = 1.4  # median depths within which a point is seen at least once
_OBSERVATIONS = 30_000  # of the points, which stand for all
_WATER = 200  # pixels of open water, likewise
_WATER_SHARED = 20.0  # of them that share an error
_STEPS = 25
_ROUNDS = 8
_COLUMNS, _ROWS = 6, 4  # of parts of the images whose average colors are about alike
_START = 0.1  # offset of the lamp to either side, in median depths: at the camera the light scattered has no derivative
_SETTLED = 0.01  # change of the lamp's unknowns in a round, in their standard deviations, that ends the rounds
_NOISE_BINS = 10  # of brightness
_LEAST_NOISE = 3e-4  # of the mean color of a patch: its pixels are rounded to 1/255
_SHARED = 1 + TERMS + 2  # unknowns of the lamp
_SCATTERING = 2000  # pixels that maps' form of the backscatter is fitted to
_ARRIVING = 0.05  # share of light below which a surface tells little of its color
_WATER_COLOR = 0.3  # color of open water that counts as a pixel's of white in full light
_WIDE = (0.6, 0.45)  # of the image that open water is looked at in
_HOLD = 1e-3  # of v to 0
_START_BETA = 0.4  # attenuation over a median depth before anything is known
_START_REDUNDANCY = 100.0  # likewise: what is known of lamps decides where the points tell little


@dataclass(frozen=True)
class LampPixels:
    """Pixels of a dive, lengths in medians of the ray depth."""

    color: np.ndarray  # [n, c]
    z: np.ndarray
    direction: np.ndarray  # [n, 3], unit, camera axes
    frame: np.ndarray
    open_water: np.ndarray  # [m, c]
    water_direction: np.ndarray
    measured: np.ndarray  # False where the depth is a guess
    grids: int = 1  # of patches, all of which show the same pixels

    def scatter(self, lamp: Lamp, beta_D: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """B over Binf of the pixels and of open water, [n, c] and [m, c]."""
        far = np.full(len(self.open_water), FAR * lamp.reference)
        at_pixels = _share_scattered(self.direction, self.z, lamp, beta_D)
        return at_pixels, _share_scattered(self.water_direction, far, lamp, beta_D)

    def ways(self, lamp: Lamp, scatter: np.ndarray | None = None) -> Ways:
        """Ways of the lamp's light; `scatter` is that of one channel."""
        points = torch.from_numpy(self.direction) * torch.from_numpy(self.z)[:, None]
        path = lamp_distance(points, lamp).numpy() + self.z
        return Ways(self.z, path, log_light(points, lamp).numpy(), scatter)

    def of_channel(self, c: int, lamp: Lamp, scatter: tuple[np.ndarray, np.ndarray]) -> Pixels:
        """One channel of them; open water as it would be on the optical axis."""
        here, water = (values[:, c] for values in scatter)
        ways = self.ways(lamp, here)
        return Pixels(self.color[:, c], ways, self.frame, self.open_water[:, c] / water, self.measured)


def seen_nearby(rows: np.ndarray, point: np.ndarray, z: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """The rows of points that a frame sees from near, their points numbered anew.

    The others are lit by little, and a third of their depths is off by 3 % and more: beam and water would explain that.
    """
    nearest = np.full(int(point.max()) + 1, np.inf)
    np.minimum.at(nearest, point, z[rows])
    kept = nearest[point] < _NEAR
    return rows[kept], np.unique(point[kept], return_inverse=True)[1]


def fit_lamp(
    pixels: LampPixels, rows: np.ndarray, point: np.ndarray, settings: SeathruSettings, encoding: Encoding
) -> tuple[Lamp, np.ndarray]:
    """The lamp that pixels and the points among them (`rows`, numbered by `point`) tell of, lengths in medians.

    With it comes beta_D per median depth and channel, of which its backscatter is made.
    """
    fall_off = INVERSE_SQUARE if encoding == "linear" else INVERSE_SQUARE / STORED
    channels = range(pixels.color.shape[1])
    unit = np.ones(len(rows))
    every = thinned(Observations(rows, daylight(unit), point, pixels.frame[rows], unit), _OBSERVATIONS)
    few = LampPixels(
        pixels.color[every.rows], pixels.z[every.rows], pixels.direction[every.rows], every.frame,
        *(values[:: max(1, len(values) // _WATER)] for values in (pixels.open_water, pixels.water_direction)),
        measured=pixels.measured[every.rows], grids=pixels.grids,
    )  # fmt: skip
    unknowns, beta_D = np.zeros(_SHARED), np.full(len(channels), _START_BETA)
    unknowns[-2:] = _START
    lamp = _lamp(unknowns, fall_off)
    noise, redundancy = np.full((len(channels), len(every.rows)), settings.loss_scale), _START_REDUNDANCY
    part = image_parts(few.direction)
    starts: list[np.ndarray] = []
    for _ in range(_ROUNDS):  # range bins of the priors and noise are those of the light found so far
        whole = pixels.scatter(lamp, beta_D)
        priors = [evidence_of(pixels.of_channel(c, lamp, whole), settings) for c in channels]
        starts = starts or [
            np.concatenate([unknowns, *waters]) for waters in _first_waters(few, every, priors, lamp, beta_D, settings)
        ]
        lit = [prior.lit(-np.log(lamp.strength)) for prior in priors]
        problem = _Problem(few, every.point, part, lit, noise, redundancy, fall_off, settings)
        before, unknowns = unknowns[:_SHARED], min(map(problem.solved, starts), key=problem.cost)
        starts, redundancy = [unknowns], max(1.0, problem.redundancy_at(unknowns))
        noise, lamp = problem.noise_at(unknowns), _lamp(unknowns[:_SHARED], fall_off)
        beta_D = _beta_D(unknowns[_SHARED:].reshape(len(priors), -1))
        if np.all(np.abs(unknowns[:_SHARED] - before) < _SETTLED * _std()):
            break
    return lamp, beta_D


def _first_waters(
    few: LampPixels,
    every: Observations,
    priors: list[Evidence],
    lamp: Lamp,
    beta_D: np.ndarray,
    settings: SeathruSettings,
) -> tuple[list[np.ndarray], list[np.ndarray]]:
    """Waters of all channels under a first lamp: as the points tell, and as all but the points tell.

    Points take the unknown beam of a strip over level ground for attenuation, from which no step leads back.
    """
    scatter, _ = few.scatter(lamp, beta_D)
    told, untold = [], []
    for c, prior in enumerate(priors):
        seen = Observations(every.rows, few.ways(lamp, scatter[:, c]), every.point, every.frame, few.color[:, c])
        told.append(best_start(prior, seen, 0.0, settings))
        untold.append(best_start(prior, None, 0.0, settings))
    return told, untold


def image_parts(direction: np.ndarray) -> np.ndarray:
    """Numbers 0.. without gaps of the parts of the images that directions lie in, each with about as many of them."""
    across, down = (direction[:, k] / direction[:, 2] for k in (0, 1))
    column = np.searchsorted(np.quantile(across, np.arange(1, _COLUMNS) / _COLUMNS), across)
    row = np.searchsorted(np.quantile(down, np.arange(1, _ROWS) / _ROWS), down)
    return np.unique(column * _ROWS + row, return_inverse=True)[1]


def of_average_color(lamp: Lamp, log_means: np.ndarray, settings: SeathruSettings) -> Lamp:
    """The lamp as strong as the average color of the dive asks, in water that was fitted after it.

    Images determine the product of light and clear colors alone. With s the logarithm of the strength and m_c those of
    the mean clear colors of the channels (`log_means`), s + m_c stays, and
    s^2 / std_s^2 + sum_c (m_c + ln f)^2 / std_m^2 is least.
    """
    s, above = np.log(lamp.strength), log_means + np.log(settings.lsac_f)
    of_strength, of_mean = _STRENGTH_STD**-2, settings.mean_reflectance_std**-2
    stronger = (of_mean * above.sum() - of_strength * s) / (of_strength + len(above) * of_mean)
    return replace(lamp, strength=float(np.exp(s + stronger)))


def exponential_backscatter(
    pixels: LampPixels, lamp: Lamp, Binf: np.ndarray, beta_D: np.ndarray
) -> tuple[Float[Tensor, "6"], np.ndarray]:
    """v and beta_B of maps, whose backscatter is Binf V(d) (1 - exp(-beta_B z)), nearest to light scattered once.

    Nearest on the pixels in units of the light that arrives from their surfaces, as what backscatter is wrong by is
    read as color; and in open water all around.
    """
    every = max(1, len(pixels.z) // _SCATTERING)
    direction, z = pixels.direction[::every], pixels.z[::every]
    toward, points = torch.from_numpy(direction), torch.from_numpy(direction * z[:, None])
    path = (lamp_distance(points, lamp).numpy() + z)[:, None]
    arriving = np.exp(log_light(points, lamp).numpy()[:, None] - beta_D * path)
    share = _share_scattered(direction, z, lamp, beta_D)
    around = torch.stack(torch.meshgrid(*(torch.linspace(-e, e, 9) for e in _WIDE), torch.ones(1), indexing="ij"), -1)
    around = torch.nn.functional.normalize(around.reshape(-1, 3).double(), dim=-1)
    whole = _share_scattered(around.numpy(), np.full(len(around), FAR * lamp.reference), lamp, beta_D)
    here, there = pattern_terms(toward).numpy(), pattern_terms(around).numpy()
    weight = Binf / np.hypot(arriving, _ARRIVING) / len(z) ** 0.5
    of_water = Binf / _WATER_COLOR / len(around) ** 0.5

    def residuals(x: np.ndarray) -> np.ndarray:
        v, beta_B = x[:TERMS], np.exp(x[TERMS:])
        near = np.exp(here @ v)[:, None] * -np.expm1(-beta_B * z[:, None]) - share
        far = np.exp(there @ v)[:, None] - whole
        return np.concatenate([(weight * near).ravel(), (of_water * far).ravel(), _HOLD * v])

    found = least_squares(residuals, np.zeros(TERMS + len(Binf)), max_nfev=_STEPS).x
    return torch.from_numpy(found[:TERMS]), np.exp(found[TERMS:])


def _share_scattered(direction: np.ndarray, z: np.ndarray, lamp: Lamp, beta_D: np.ndarray) -> np.ndarray:
    """`share_scattered` of `swimm3r.lamp` by a compiled kernel, [n, c]."""
    of_lamp = lamp.position.numpy(), lamp.reference, lamp.fall_off, lamp.beam.numpy(), beta_D
    far = FAR * lamp.reference
    whole = kernels.scattered(np.array([[0.0, 0.0, 1.0]]), np.array([far]), *nodes_along(NODES), *of_lamp)
    return kernels.scattered(direction, np.minimum(z, far), *nodes_along(FEW_NODES), *of_lamp) / whole


def noise_by_light(off: np.ndarray, light: np.ndarray, most: float) -> np.ndarray:
    """Standard deviation sqrt(a^2 + (b light)^2) of pixels about the model, from what they are off; at most `most`.

    a is the noise of the camera; b is what frames show differently of a surface, in shares of its light. Under a lamp
    light spans orders of magnitude: one standard deviation for all would be that of the dark far pixels, and the bright
    near ones would decide by what their frames show differently.
    """
    bins = np.array_split(np.argsort(light, kind="stable"), _NOISE_BINS)
    variance = np.array([max(1.4826 * float(np.median(np.abs(off[rows]))), _LEAST_NOISE) ** 2 for rows in bins])
    square = np.array([np.mean(light[rows] ** 2) for rows in bins])
    parts, _ = nnls(np.stack([np.ones(_NOISE_BINS), square], -1) / variance[:, None], np.ones(_NOISE_BINS))
    return np.clip(np.sqrt(parts[0] + parts[1] * light**2), _LEAST_NOISE, most)


def _lamp(shared: np.ndarray, fall_off: float) -> Lamp:
    values = torch.from_numpy(np.asarray(shared, dtype=np.float64))
    strength, beam, beside = values.split([1, TERMS, 2])
    position = torch.cat([beside, beside.new_zeros(1)])
    return Lamp(position, 1.0, fall_off, float(strength.exp()), beam, torch.zeros_like(beam))


@dataclass(frozen=True)
class _Problem:
    """Least squares for the lamp and the waters of all channels together."""

    few: LampPixels  # that see the points
    point: np.ndarray
    part: np.ndarray  # of the images
    priors: list[Evidence]  # of the channels, of a lamp of strength 1
    noise: np.ndarray  # of the channels' pixels, [c, n]
    redundancy: float  # of the pixels, beyond that of patches
    fall_off: float
    settings: SeathruSettings

    def solved(self, start: np.ndarray) -> np.ndarray:
        """Lamp and waters by bounded least squares with a soft L1 loss."""
        std = _std()
        lower = np.concatenate([-_WIDEST * std, *(prior.lower for prior in self.priors)])
        upper = np.concatenate([_WIDEST * std, *(prior.upper for prior in self.priors)])
        inside = np.clip(start, lower + 1e-6, upper - 1e-6)
        return least_squares(
            self.residuals, inside, jac=cast(Any, self.jacobian), bounds=(lower, upper), x_scale="jac", loss="soft_l1",
            max_nfev=_STEPS, xtol=1e-5, ftol=1e-5,
        ).x  # fmt: skip

    def cost(self, unknowns: np.ndarray) -> float:
        """The loss that `solved` minimizes."""
        return float((np.sqrt(1 + self.residuals(unknowns) ** 2) - 1).sum())

    def noise_at(self, unknowns: np.ndarray) -> np.ndarray:
        """Standard deviation of each channel's pixels about a solution."""
        lamp, waters = self._parts(unknowns)
        ways, (scatter, _) = self.few.ways(lamp), self.few.scatter(lamp, _beta_D(waters))
        parts = (self._direct(c, x, replace(ways, scatter=scatter[:, c])) for c, x in enumerate(waters))
        return np.stack([noise_by_light(off, light, self.settings.loss_scale) for light, off in parts])

    def redundancy_at(self, unknowns: np.ndarray) -> float:
        """By how much gradients of whole frames in the lamp scatter more than independent pixels would let them.

        That is along the direction they scatter most in: exposures of frames tell of beams across a strip, which its
        points hardly tell of.
        """
        here, rows = self.residuals(unknowns), self.jacobian(unknowns)
        count, frames = len(self.few.z), np.unique(self.few.frame, return_inverse=True)[1]
        gradient, information = np.zeros((frames.max() + 1, _SHARED)), np.zeros((_SHARED, _SHARED))
        each = (len(here) - _SHARED) // len(self.priors)
        for c in range(len(self.priors)):
            first = _SHARED + c * each
            off, of_lamp = here[first : first + count], rows[first : first + count, :_SHARED]
            weighted = of_lamp / np.sqrt(1 + off**2)[:, None]
            information += weighted.T @ of_lamp
            gradient += np.stack([np.bincount(frames, column * off) for column in weighted.T], -1)
        return self.redundancy * float(frame_scatter(information, gradient).max())

    def residuals(self, unknowns: np.ndarray) -> np.ndarray:
        """Everything in its own standard deviations: the lamp, then the channels one after another."""
        lamp, waters = self._parts(unknowns)
        ways, scatter = self.few.ways(lamp), self.few.scatter(lamp, _beta_D(waters))
        of_channels = [self._of_channel(c, x, lamp, ways, *(s[:, c] for s in scatter)) for c, x in enumerate(waters)]
        return np.concatenate([unknowns[:_SHARED] / _std(), *of_channels])

    def jacobian(self, unknowns: np.ndarray) -> np.ndarray:
        """By forward differences; the water of a channel moves its own rows alone."""
        here = self.residuals(unknowns)
        rows = np.zeros((len(here), len(unknowns)))
        for k in range(_SHARED):
            rows[:, k] = (self.residuals(unknowns + 1e-6 * np.eye(len(unknowns))[k]) - here) / 1e-6
        lamp, waters = self._parts(unknowns)
        ways, scatter = self.few.ways(lamp), self.few.scatter(lamp, _beta_D(waters))
        each = (len(here) - _SHARED) // len(waters)
        for c, x in enumerate(waters):
            mine = slice(_SHARED + c * each, _SHARED + (c + 1) * each)
            for k in range(len(x)):
                moved, seen = x + 1e-6 * np.eye(len(x))[k], [s[:, c] for s in scatter]
                if k in (LOG_BETA_D, SLOPE):
                    seen = [s[:, 0] for s in self.few.scatter(lamp, _beta_D(moved[None]))]
                of_channel = self._of_channel(c, moved, lamp, ways, *seen)
                rows[mine, _SHARED + c * len(x) + k] = (of_channel - here[mine]) / 1e-6
        return rows

    def _parts(self, unknowns: np.ndarray) -> tuple[Lamp, np.ndarray]:
        """The lamp, and the unknowns of each channel's water."""
        return _lamp(unknowns[:_SHARED], self.fall_off), unknowns[_SHARED:].reshape(len(self.priors), -1)

    def _direct(self, c: int, x: np.ndarray, ways: Ways) -> tuple[np.ndarray, np.ndarray]:
        """J T_D of pixels with the J of every point eliminated, and what they show beyond it and B."""
        T_D, B = attenuations(x, ways)
        direct = self.few.color[:, c] - B
        J = kernels.surface_colors(T_D, direct, self.noise[c] ** -2, self.point, int(self.point.max()) + 1, np.inf)
        light = J[self.point] * T_D
        return light, direct - light

    def _of_channel(
        self, c: int, x: np.ndarray, lamp: Lamp, ways: Ways, scatter: np.ndarray, scatter_of_water: np.ndarray
    ) -> np.ndarray:
        settings, water = self.settings, self.few.open_water[:, c]
        _, off = self._direct(c, x, replace(ways, scatter=scatter))
        off = off / (self.noise[c] * np.sqrt(settings.min_redundancy * self.few.grids * self.redundancy))
        shared = settings.open_water_std * np.sqrt(max(1.0, len(water) / _WATER_SHARED))
        of_water = (water - x[BINF] * scatter_of_water) / shared
        prior = self.priors[c].lit(np.log(lamp.strength))
        of_parts = self._of_parts(c, x, replace(ways, scatter=scatter)) / np.sqrt(len(self.priors))
        return np.concatenate([off, of_water, of_parts, prior_residuals(x, prior, settings)])

    def _of_parts(self, c: int, x: np.ndarray, ways: Ways) -> np.ndarray:
        """Average colors of the parts of the images about that of surfaces which reflect everywhere alike."""
        T_D, B = attenuations(x, ways)
        count = np.bincount(self.part)
        expected = np.exp(x[LOG_MEAN]) * np.bincount(self.part, T_D) / count
        off = np.bincount(self.part, self.few.color[:, c] - B) / count - expected
        return off / np.hypot(self.settings.average_std * expected, self.settings.dark_std)


def _beta_D(waters: np.ndarray) -> np.ndarray:
    """beta_D per median depth of the waters of some channels."""
    return np.exp(waters[:, LOG_BETA_D] + waters[:, SLOPE])


def _std() -> np.ndarray:
    """Standard deviations of the lamp's unknowns about 0, before anything is seen."""
    return np.repeat([_STRENGTH_STD, _BEAM_STD, _OFFSET_STD], [1, TERMS, 2])
