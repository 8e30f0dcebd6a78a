"""The water of a dive from its images and their ray depths, without weights (after Sea-Thru, Akkaynak 2019).

Per channel, an observation k of surface point t reads

    I_k = J_t exp(-beta_D(z_k) z_k) + Binf (1 - exp(-beta_B z_k)),   z = ray depth,

and one bounded least-squares problem finds Binf, beta_B and beta_D(z) = a exp(b z) from four kinds of evidence:

    tracks      the same point seen from several distances; J_t is eliminated in closed form (variable projection), so
                the decay of color *differences* gives beta_D without any guess about the illuminant
    dark        the darkest pixels of each range bin are B plus J' T_D with a small common J' (Sea-Thru's B(z)), those
                of guessed depth among them
    average     the average color of a range bin decays as T_D from 1 / f (local space average color, f = 2): decides
                only what the tracks leave open
    open water  pixels that look past every surface show Binf; without any, Binf is not far from what is farthest

Under a lamp on the camera (`least_squares/lamp_fit.py`), J_t is multiplied by its light, and the way from the lamp
attenuates, too.

`least_squares/channel_fit.py` holds the least squares. Depths enter in units of their median, so the fit commutes with
any rescaling of the scene.
"""

from dataclasses import replace

import numpy as np
import torch
from torch import Tensor

from swimm3r.errors import InputError
from swimm3r.imaging.clipped import clipped
from swimm3r.lamp import Light, rescaled_lamp
from swimm3r.medium import AttenuationCurve, Encoding, Medium, MediumFit, linear_from_srgb
from swimm3r.progress import Progress, silent
from swimm3r.scene.frames import Frames
from swimm3r.scene.reconstruction import Reconstruction
from swimm3r.sfm.medium.dense_tracks import fuse_depth
from swimm3r.sfm.medium.least_squares.channel_fit import (
    BINF,
    LOG_BETA_B,
    LOG_BETA_D,
    LOWER,
    SLOPE,
    ChannelFit,
    Observations,
    Pixels,
    attenuations,
    daylight,
    fit_channel,
)
from swimm3r.sfm.medium.least_squares.lamp_fit import (
    LampPixels,
    exponential_backscatter,
    fit_lamp,
    of_average_color,
    seen_nearby,
)
from swimm3r.sfm.medium.samples import WaterSamples, collect_samples
from swimm3r.sfm.medium.settings import SeathruSettings

_BACKSCATTER_FORM = 0.1  # standard deviation, relative, of beta_B under a lamp: maps' form of it is not exact
_DARKEST = 1e-3  # mean light of a channel: less says nothing of colors


def estimate_medium(
    rec: Reconstruction,
    frames: Frames,
    settings: SeathruSettings,
    encoding: Encoding,
    progress: Progress = silent,
) -> MediumFit:
    """The water of a reconstructed dive in one encoding; for both, collect samples once and call `fit_medium` twice."""
    tracks = fuse_depth(rec, frames, settings.tracks, progress)
    return fit_medium(collect_samples(rec, frames, tracks, settings, progress), settings, encoding)


def fit_medium(samples: WaterSamples, settings: SeathruSettings, encoding: Encoding, light: Light = "sun") -> MediumFit:
    """The water that explains the samples, on values as stored ("srgb") or in linear light, under the sun or a lamp.

    Gray samples are one channel, which is fitted once and stands for all three. Raises InputError where fewer than
    `settings.min_samples` pixels have a depth, and under a lamp where too few points are seen by several frames.
    """
    measured = samples.measured.numpy()
    n = int(measured.sum())
    if n < settings.min_samples:
        raise InputError(
            f"the water cannot be estimated from {n} pixels with known depth",
            cause="the dense depth stage found almost no surface",
            hint=f"use clearer or slower footage; at least {settings.min_samples} pixels are needed",
        )
    if light == "lamp":
        settings = replace(settings, slope_std=settings.lamp_slope_std)
    color, open_water = encoded(samples, encoding)
    ray_depth = samples.ray_depth.double().numpy()
    unit = float(np.median(ray_depth[measured]))
    z = ray_depth / unit
    frame = np.unique(samples.frame.numpy(), return_inverse=True)[1]
    chosen = telling_rows(samples, z, settings) if light == "sun" else _lit_rows(samples, z, settings)
    if light == "lamp":
        if chosen is None:
            raise _too_little_for_a_lamp()
        lit = _lit(samples, color, z, frame, open_water)
        lamp, beta_D = fit_lamp(lit, *chosen, settings, encoding)
        scatter = lit.scatter(lamp, beta_D)
        every = [lit.of_channel(c, lamp, scatter) for c in range(color.shape[1])]
    else:
        lamp, ways = None, daylight(z)
        every = [Pixels(color[:, c], ways, frame, open_water[:, c], measured) for c in range(color.shape[1])]
    channels = []
    for pixels in every:
        observations = None
        if chosen is not None:
            rows, point = chosen
            observations = Observations(rows, pixels.ways.rows(rows), point, frame[rows], pixels.I[rows], samples.grids)
        channels.append(fit_channel(pixels, observations, settings))
    fit = _medium_fit(channels * (3 // len(channels)), unit, ray_depth[measured], settings, encoding)
    if lamp is None:
        return fit
    log_means = np.array([_log_mean_color(c, pixels) for c, pixels in zip(channels, every, strict=True)])
    lamp = of_average_color(lamp, log_means, settings)
    Binf, beta_D = fit.Binf.double().numpy(), fit.beta_D.double().numpy() * unit
    veil, beta_B = exponential_backscatter(lit, lamp, Binf, beta_D)
    beta = torch.from_numpy(beta_B / unit).float()
    std = replace(fit.std, beta_B=_BACKSCATTER_FORM * beta)
    return replace(fit, beta_B=beta, std=std, lamp=rescaled_lamp(replace(lamp, veil=veil), unit))


def _log_mean_color(fit: ChannelFit, pixels: Pixels) -> float:
    """Logarithm of a channel's mean clear color over the pixels, weighted by the share of light that arrives."""
    pixels = pixels.of_measured_depth()
    T_D, B = attenuations(fit.x, pixels.ways)
    return float(np.log(max(np.mean(pixels.I - B), _DARKEST) / np.mean(T_D)))


def encoded(samples: WaterSamples, encoding: Encoding) -> tuple[np.ndarray, np.ndarray]:
    """Colors of samples and of open water in an encoding; of gray frames in one channel."""
    values = [samples.I.double(), samples.open_water.double()]
    if encoding == "linear":
        values = [linear_from_srgb(v) for v in values]
    if samples.gray:
        values = [v.mean(1, keepdim=True) for v in values]
    return values[0].numpy(), values[1].numpy()


def _lit(
    samples: WaterSamples, color: np.ndarray, z: np.ndarray, frame: np.ndarray, open_water: np.ndarray
) -> LampPixels:
    if samples.direction is None or samples.water_direction is None:
        raise ValueError("a lamp's light is told by the directions of pixels, and these samples have none")
    directions = (values.double().numpy() for values in (samples.direction, samples.water_direction))
    direction, toward_water = directions
    return LampPixels(color, z, direction, frame, open_water, toward_water, samples.measured.numpy(), samples.grids)


def _lit_rows(samples: WaterSamples, z: np.ndarray, settings: SeathruSettings) -> tuple[np.ndarray, np.ndarray] | None:
    """Rows and point numbers of what tells of a lamp: points that a frame sees from near; None for too few.

    Level ground filmed from one height has hardly any point with distances that differ. Its points move through the
    beam all the same, and then all of them count: the beam is known, and attenuation hardly.
    """
    for least in (settings.min_depth_ratio, 1.0):
        chosen = telling_rows(samples, z, replace(settings, min_depth_ratio=least))
        near = None if chosen is None else seen_nearby(*chosen, z)
        if near is not None and len(np.unique(near[1])) >= settings.min_tracks:
            return near
    return None


def _too_little_for_a_lamp() -> InputError:
    return InputError(
        "the light of a lamp cannot be told from these frames",
        cause="too few points of the scene are seen by several frames and from nearby",
        hint="footage that comes nearer to what it shows; or --light sun",
    )


def telling_rows(
    samples: WaterSamples, z: np.ndarray, settings: SeathruSettings
) -> tuple[np.ndarray, np.ndarray] | None:
    """Rows and point numbers of the points with the largest ratio of depths, at most `max_observations` rows."""
    track = samples.track.numpy()
    exposed = ((samples.I.amin(-1) > settings.black) & ~clipped(samples.I.amax(-1), settings.saturated)).numpy()
    rows = np.flatnonzero((track >= 0) & exposed)
    if len(rows) == 0:
        return None
    _, point = np.unique(track[rows], return_inverse=True)
    log_z = np.log(z[rows])
    near, far = np.full(point.max() + 1, np.inf), np.full(point.max() + 1, -np.inf)
    np.minimum.at(near, point, log_z)
    np.maximum.at(far, point, log_z)
    spread = far - near
    order = np.argsort(-spread, kind="stable")
    count = np.bincount(point)[order].cumsum()
    chosen = np.zeros(len(order), dtype=bool)
    chosen[order[(count <= settings.max_observations) & (spread[order] > np.log(settings.min_depth_ratio))]] = True
    rows = rows[chosen[point]]
    if chosen.sum() < settings.min_tracks:
        return None
    _, point = np.unique(track[rows], return_inverse=True)
    return rows, point


def _medium_fit(
    channels: list[ChannelFit], unit: float, ray_depth: np.ndarray, settings: SeathruSettings, encoding: Encoding
) -> MediumFit:
    """From medians back to the scene's unit, with the flags."""
    x = np.stack([c.x for c in channels])
    std = settings.std_inflation * np.stack([np.sqrt(np.diag(c.covariance).clip(0)) for c in channels])
    z_range = np.quantile(ray_depth, [0.002, 0.998])
    beta_B = np.exp(x[:, LOG_BETA_B])
    beta_D = np.exp(x[:, LOG_BETA_D] + x[:, SLOPE])  # at the median depth, 1 in these units
    at_median = np.array([0, 0, 1.0, 1.0, 0, 0])
    relative_D = settings.std_inflation * np.sqrt(
        np.array([max(0.0, at_median @ c.covariance @ at_median) for c in channels])
    )
    relative = {
        "Binf": std[:, BINF] / x[:, BINF].clip(1e-6),
        "beta_D": relative_D,
        "beta_B": std[:, LOG_BETA_B],
    }
    inside = (x[:, [BINF, LOG_BETA_B, LOG_BETA_D]] > LOWER[[BINF, LOG_BETA_B, LOG_BETA_D]] + 1e-3).all(-1)

    def tensor(value: np.ndarray) -> Tensor:
        return torch.from_numpy(np.asarray(value, dtype=np.float32))

    return MediumFit(
        Binf=tensor(x[:, BINF]),
        beta_D=tensor(beta_D / unit),
        beta_B=tensor(beta_B / unit),
        curve=AttenuationCurve(
            tensor(np.exp(x[:, LOG_BETA_D]) / unit), tensor(x[:, SLOPE] / unit), torch.zeros(3), torch.zeros(3)
        ),
        std=Medium(
            tensor(std[:, BINF]), tensor(relative_D * beta_D / unit), tensor(std[:, LOG_BETA_B] * beta_B / unit)
        ),
        identifiable={
            name: torch.from_numpy((value < settings.identifiable_std) & inside) for name, value in relative.items()
        },
        z_range=(float(z_range[0]), float(z_range[1])),
        encoding=encoding,
    )
