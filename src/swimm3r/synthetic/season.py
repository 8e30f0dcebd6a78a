"""Massive corals of the seafloor, and a season's changes: corals grown, bleached, broken or moved, algae, shifted sand.

Corals belong to squares of a lattice, one meter wide, at most one to a square, and follow from the seed and the
square's numbers, as do their fates. A coral is a dome over an outline (`seafloor.outline`):

    h(r) = top (1 - r^2)^0.6,    volume = top radius^2 pi / 1.6 mean(outline^2)
"""

from dataclasses import dataclass
from typing import Literal, no_type_check

import numba
import numpy as np
from jaxtyping import Float

from swimm3r.synthetic.noise import fractal
from swimm3r.synthetic.settings import Season

Fate = Literal["unchanged", "grown", "bleached", "broken", "moved"]

CORAL, ALGAE = 3, 4  # kinds of animals, beside those of the seafloor
_MIDDLE = (0.4, 0.6)  # of a square, where corals stand
_RADIUS = (0.12, 0.17)  # m
_HEIGHT = (0.55, 0.8)  # of the radius
_COLORS = ((0.22, 0.12, 0.035), (0.16, 0.14, 0.04), (0.24, 0.10, 0.07))  # linear albedo
_BLEACHED = (0.66, 0.63, 0.55)
_ALGAE = (0.035, 0.075, 0.02)
_GROWN = (1.3, 1.5)  # radius and height by those before
_BROKEN = 0.3  # of the height is left
_MOVED = 0.42  # m to the right, onto the border of the square
_ALGAE_RADIUS = (0.12, 0.16)  # m, on the border ahead
_ROOM = 0.12  # m between a coral's outline and the middle of the next animal
_OUTLINE = 0.9**2 + 0.1**2 / 2  # mean square of 0.9 + 0.1 sin(3 phi)
_WAVE = 2.4  # m, of the sand's changes
_STILL = 0.18  # level of the noise below which sand stays


@dataclass(frozen=True)
class Coral:
    """A coral at the first visit and after a season, as fields of an animal (`seafloor.ANIMAL_FIELDS`)."""

    fate: Fate
    before: tuple[float, ...]
    after: tuple[float, ...]


def corals_of(column: int, row: int, density: float, season: Season, seed: int) -> list[Coral]:
    """The corals of a square: one or none."""
    rng = np.random.default_rng([seed, 8, column + (1 << 20), row + (1 << 20)])
    if rng.random() >= density:
        return []
    x, y, radius = column + rng.uniform(*_MIDDLE), row + rng.uniform(*_MIDDLE), rng.uniform(*_RADIUS)
    top, angle = radius * rng.uniform(*_HEIGHT), rng.uniform(0, 2 * np.pi)
    color = tuple(float(c) for c in np.array(_COLORS[rng.integers(len(_COLORS))]) * rng.uniform(0.85, 1.15))
    before = (float(CORAL), x, y, radius, top, angle, *color)
    fate = _fate(float(rng.random()), season)
    match fate:
        case "grown":
            after = (float(CORAL), x, y, _GROWN[0] * radius, _GROWN[1] * top, angle, *color)
        case "bleached":
            after = (*before[:6], *_BLEACHED)
        case "broken":
            after = (float(CORAL), x, y, radius, _BROKEN * top, angle, *color)
        case "moved":
            after = (float(CORAL), x + _MOVED, y, radius, top, angle, *color)
        case "unchanged":
            after = before
    return [Coral(fate, before, after)]


def algae_of(column: int, row: int, season: Season, seed: int) -> list[tuple[float, ...]]:
    """The patch of algae that has grown in a square, as fields of an animal without height; one or none."""
    rng = np.random.default_rng([seed, 9, column + (1 << 20), row + (1 << 20)])
    if rng.random() >= season.algae:
        return []
    x, y, radius = column + rng.uniform(*_MIDDLE), row + rng.uniform(0.95, 1.05), rng.uniform(*_ALGAE_RADIUS)
    return [(float(ALGAE), x, y, radius, 0.0, float(rng.uniform(0, 2 * np.pi)), *_ALGAE)]


def planted(animals: list[list[float]], corals: list[Coral], algae: list[tuple[float, ...]]) -> list[list[float]]:
    """The animals after a season, corals, and algae; animals keep clear of all that any season makes of a coral."""
    reach = _GROWN[0] * _RADIUS[1] + _ROOM
    taken = [(coral.before[1] + aside, coral.before[2]) for coral in corals for aside in (0.0, _MOVED)]
    clear = [a for a in animals if all(np.hypot(a[1] - x, a[2] - y) > reach for x, y in taken)]
    return clear + [list(coral.after) for coral in corals] + [list(patch) for patch in algae]


def volume(fields: tuple[float, ...]) -> float:
    """Volume of a coral above the ground that it stands on, m^3."""
    return fields[4] * fields[3] ** 2 * np.pi / 1.6 * _OUTLINE


def sand_shift(
    x: Float[np.ndarray, "*#n"], y: Float[np.ndarray, "*#n"], season: Season, seed: int
) -> Float[np.ndarray, "*n"]:
    """Change of the sand's height at places, m: banks and hollows with still sand between them."""
    if season.sand == 0:
        return np.zeros(np.broadcast(x, y).shape)
    wide_x, wide_y = np.broadcast_arrays(x, y)
    return season.sand * _banks(wide_x.ravel(), wide_y.ravel(), seed * 7919 + 71).reshape(wide_x.shape)


def _fate(share: float, season: Season) -> Fate:
    fates: tuple[tuple[Fate, float], ...] = (
        ("grown", season.grown), ("bleached", season.bleached), ("broken", season.broken), ("moved", season.moved),
    )  # fmt: skip
    for fate, part in fates:
        if share < part:
            return fate
        share -= part
    return "unchanged"


@numba.njit(cache=True)
@no_type_check
def _banks(x: np.ndarray, y: np.ndarray, seed: int) -> np.ndarray:
    """Banks and hollows, -1..1, smooth where they begin."""
    out = np.zeros(len(x))
    for k in range(len(x)):
        level = fractal(x[k], y[k], 0.0, _WAVE, 1, 0.5, 0.0, seed)
        past = min(max((abs(level) - _STILL) / (0.5 - _STILL), 0.0), 1.0)
        out[k] = np.sign(level) * past * past * (3 - 2 * past)
    return out
