"""Sun or lamp: whether the light on a dive's surfaces stays with the world or with the camera.

Where the water of daylight is taken off, a point of surface keeps its light in every frame under the sun. Under a lamp
on the camera its light changes with its place in the image,

    ln (I - B) / T_D = ln J_t + h(z) + g . phi(d),

h being what the water's fit leaves over the distance z, and phi the pattern of `swimm3r.lamp`. Both models, with and
without phi, are fitted to half of the points and judged on the others, points that none was fitted to. Frames whose
exposure changes do not pass for either: they have gains of their own. A lens that darkens the corners, and local tone
mapping, make a pattern as well. They leave the power n of the distance that the direct light falls with,

    ln (I - B) = ln J_t - n ln z + g . phi(d),

which is that of attenuation alone under the sun, and at least a small lamp's under a lamp. Over level ground seen from
one height distances tell no power, or one that a few frames less change; there a pattern alone tells a lamp, if it is
strong.
"""

import numpy as np
import torch

from swimm3r.imaging.clipped import clipped
from swimm3r.lamp import TERMS, LightEvidence, pattern
from swimm3r.medium import MediumFit, backscatter, transmittances
from swimm3r.sfm.medium.samples import WaterSamples
from swimm3r.sfm.medium.settings import SeathruSettings

_LEAST_LIGHT, _LEAST_T_D = 0.02, 0.1  # direct light and T_D of channels whose logarithm tells something
_MOST = 60_000  # observations
_ROUNDS = 3  # of reweighting
_TELLING = 0.005  # spread of a point's distances over its frames, in logarithms, below which they tell no power
_GROUPS = 8  # of frames, each left out once for the standard error of the power


def judge_light(samples: WaterSamples, fit: MediumFit, settings: SeathruSettings) -> LightEvidence | None:
    """The light that the samples tell, given the water as fitted under the sun; None where too few points do."""
    if samples.direction is None:
        return None
    z = samples.ray_depth
    medium = fit.at(z)
    direct, T_D = samples.I - backscatter(z, medium), transmittances(z, medium)[0]
    exposed = (samples.I.amin(-1) > settings.black) & ~clipped(samples.I.amax(-1), settings.saturated)
    told = (direct > _LEAST_LIGHT) & (T_D > _LEAST_T_D)
    logs = torch.where(told, (direct.clamp(min=_LEAST_LIGHT) / T_D).log(), 0.0)
    channel = told.float().mean(0).argmax()  # one for all, as points differ in color
    rows = torch.nonzero((samples.track >= 0) & exposed & told[:, channel])[:, 0]
    points = torch.unique(samples.track[rows])
    if len(points) < settings.min_tracks:
        return None
    rows = _thinned(rows, samples.track)
    light, patterns = logs[rows, channel].double().numpy(), pattern_terms(samples.direction[rows].double())
    point, frame = (np.unique(of[rows].numpy(), return_inverse=True)[1] for of in (samples.track, samples.frame))
    unit = float(z[rows].median())
    far = (z[rows].double() / unit).numpy()
    distance = np.stack([far, np.log(far)], -1)
    held = point % 2 == 0
    spreads = []
    for terms in (distance, np.concatenate([distance, patterns], -1)):
        both = [_held_out(light, terms, point, frame, which) for which in (held, ~held)]
        spreads.append(float(np.mean([value**2 for value in both])))
    found = _fitted(light, np.concatenate([distance, patterns], -1), point, frame)[-TERMS:]
    alone = samples.direction[samples.track < 0]
    everywhere = alone if len(alone) else samples.direction
    change = float((pattern(everywhere.double(), torch.from_numpy(found))).std())
    explained = 1 - spreads[1] / max(spreads[0], 1e-12)
    fall_off, std = _fall_off(samples, direct, exposed, settings) or (None, None)
    lamp = explained >= share_to_explain(fall_off, std, settings) and change >= settings.lamp_change
    return LightEvidence("lamp" if lamp else "sun", explained, change, len(points), fall_off, std)


def share_to_explain(fall_off: float | None, std: float | None, settings: SeathruSettings) -> float:
    """Least share of variance that a pattern explains under a lamp, given the power of the distance and its error.

    A pattern alone tells a lamp where the power does not tell; infinite where the power is that of daylight.
    """
    if fall_off is None or std is None or abs(fall_off - settings.lamp_fall_off) < std:
        return settings.lamp_alone
    return settings.lamp_explained if fall_off > settings.lamp_fall_off else np.inf


def _fall_off(
    samples: WaterSamples, direct: torch.Tensor, exposed: torch.Tensor, settings: SeathruSettings
) -> tuple[float, float] | None:
    """n of the median channel among those that enough points tell, seen from several distances; None without any.

    With it comes its standard error, by a jackknife over groups of frames.
    """
    assert samples.direction is not None
    powers = []
    for c in range(1 if samples.gray else direct.shape[-1]):
        rows = torch.nonzero((samples.track >= 0) & exposed & (direct[:, c] > _LEAST_LIGHT))[:, 0]
        if len(torch.unique(samples.track[rows])) < settings.min_tracks:
            continue
        rows = _thinned(rows, samples.track)
        point, frame = (np.unique(of[rows].numpy(), return_inverse=True)[1] for of in (samples.track, samples.frame))
        distance = samples.ray_depth[rows, None].double().log().numpy()
        if frame.max() < 2 or _without_groups(distance, point, frame, np.ones(len(rows))).std() < _TELLING:
            continue  # two frames, one left out, tell no error
        terms = np.concatenate([distance, pattern_terms(samples.direction[rows].double())], -1)
        light = direct[rows, c].double().log().numpy()
        without = []
        for group in range(groups := min(_GROUPS, int(frame.max()) + 1)):
            kept = frame % groups != group
            without.append(_fitted(light[kept], terms[kept], point[kept], frame[kept])[0])
        std = float(np.std(without)) * (groups - 1) ** 0.5
        powers.append((-float(_fitted(light, terms, point, frame)[0]), std))
    return sorted(powers)[(len(powers) - 1) // 2] if powers else None


def _thinned(rows: torch.Tensor, track: torch.Tensor) -> torch.Tensor:
    """The observations of some points, all of them of each."""
    step = -(-len(rows) // _MOST)
    return rows[track[rows] % step == 0] if step > 1 else rows


def pattern_terms(direction: torch.Tensor) -> np.ndarray:
    """phi of unit directions, [n, 6]."""
    return torch.stack([pattern(direction, one) for one in torch.eye(TERMS, dtype=torch.float64)], -1).numpy()


def _centered(values: np.ndarray, group: np.ndarray, weight: np.ndarray) -> np.ndarray:
    """Values less the weighted mean of their group."""
    total = np.bincount(group, weight).clip(1e-12)
    columns = values.reshape(len(values), -1).T
    means = np.stack([np.bincount(group, weight * column) / total for column in columns], -1)[group]
    return (values.reshape(len(values), -1) - means).reshape(values.shape)


def _without_groups(values: np.ndarray, point: np.ndarray, frame: np.ndarray, weight: np.ndarray) -> np.ndarray:
    """Values less what is common to a point and what is common to a frame, by turns."""
    for _ in range(4):
        values = _centered(_centered(values, frame, weight), point, weight)
    return values


def _fitted(light: np.ndarray, terms: np.ndarray, point: np.ndarray, frame: np.ndarray) -> np.ndarray:
    """Coefficients of the terms by reweighted least squares; every point and every frame has a level of its own."""
    weight = np.ones(len(light))
    found = np.zeros(terms.shape[1])
    for _ in range(_ROUNDS):
        x, y = (_without_groups(values, point, frame, weight) for values in (terms, light))
        information = (x * weight[:, None]).T @ x
        found = np.linalg.solve(information + 1e-6 * len(x) * np.eye(len(found)), x.T @ (weight * y))
        off = y - x @ found
        scale = 1.4826 * np.median(np.abs(off)) + 1e-6
        weight = 1 / (1 + (off / (2 * scale)) ** 2)
    return found


def _held_out(light: np.ndarray, terms: np.ndarray, point: np.ndarray, frame: np.ndarray, held: np.ndarray) -> float:
    """Robust spread of the light of held-out points about what the terms, fitted to the others, say of it."""
    found = _fitted(light[~held], terms[~held], point[~held], frame[~held])
    even = np.ones(int(held.sum()))
    off = _without_groups(light[held] - terms[held] @ found, point[held], frame[held], even)
    return 1.4826 * float(np.median(np.abs(off)))
