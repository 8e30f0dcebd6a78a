"""A procedural seafloor: a sandy terrace with dunes and ripples, outcrops, boulders, animals, and a drop-off around it.

World axes: x to the right, y ahead, z up, metres; the terrace is about 5 m in radius around CENTER and its sand lies
near z = 0. Past its rim the floor falls away, so a camera that looks over the rim sees open water.
"""

from dataclasses import dataclass
from typing import no_type_check

import numba
import numpy as np
from scipy import ndimage

from swimm3r.synthetic.noise import fractal
from swimm3r.synthetic.raycast import Heightfield, heightfield
from swimm3r.synthetic.season import algae_of, corals_of, planted, sand_shift
from swimm3r.synthetic.settings import Season

CELLS = 2048
EXTENT = 14.0  # m, side of the grid
CELL = EXTENT / CELLS
CENTER = (0.0, 2.6)  # of the terrace
RIM = 5.2  # m, its mean radius
SUN = np.array([-0.45, 0.35, 0.82])  # toward the sun; unit length to 1 %

STAR, URCHIN, SPONGE = 0, 1, 2
# kind, x, y, radius, height, angle, red, green, blue (linear albedo)
ANIMAL_FIELDS = 9
_STAR_COLORS = ((0.75, 0.06, 0.03), (0.85, 0.28, 0.03), (0.05, 0.12, 0.55), (0.45, 0.08, 0.35))
_SPONGE_COLORS = ((0.80, 0.30, 0.04), (0.70, 0.05, 0.05), (0.80, 0.60, 0.08), (0.35, 0.10, 0.45))


@dataclass(frozen=True)
class Seafloor:
    """The floor's shape and what lies on it."""

    surface: Heightfield
    shade: np.ndarray  # [n + 1, n + 1, 5] float32: dz/dx, dz/dy, share of sun, share of sky, rock rather than sand
    animals: np.ndarray  # [animals, 9] float64, see ANIMAL_FIELDS
    owner: np.ndarray  # [n, n] int16: the animal whose outline may reach this cell, -1 for none
    seed: int

    def around(self, x: float, y: float) -> "Seafloor":
        """The floor that a camera at a place sees: all of it."""
        return self


def make_seafloor(seed: int, corals: float = 0.0, season: Season = Season()) -> Seafloor:  # noqa: B008 - frozen
    """The terrace of a seed, after a season."""
    rng = np.random.default_rng(seed)
    x0, y0 = CENTER[0] - EXTENT / 2, CENTER[1] - EXTENT / 2
    sand, height = terrain(CELLS + 1, x0, y0, CELL, int(seed) * 7919 + 1, RIM + 1.2)
    for boulder in _boulders(rng):
        add_boulder(height, height, x0, y0, CELL, boulder, int(rng.integers(1 << 30)))
    rock = np.clip((height - sand) / 0.03, 0, 1)
    animals = _animals(rng, height, rock, x0, y0, CELL)
    squares = [
        (column, row)
        for row in range(-4, 9)
        for column in range(-6, 6)
        if np.hypot(column + 0.5 - CENTER[0], row + 0.5 - CENTER[1]) < RIM - 1
    ]
    height, rock = with_shifted_sand(height, rock, sand, x0, y0, season, seed)
    animals = with_corals(animals, squares, corals, season, seed)
    owner = with_animals(height, animals, x0, y0)
    _add_rim(height, x0, y0, CELL, int(seed) * 7919 + 5)
    return lit_floor(height, rock, animals, owner, x0, y0, seed)


def with_shifted_sand(
    height: np.ndarray, rock: np.ndarray, sand: np.ndarray, x0: float, y0: float, season: Season, seed: int
) -> tuple[np.ndarray, np.ndarray]:
    """Height and share of rock once the sand has shifted: over rock where it rises, and off what it covered."""
    if season.sand == 0:
        return height, rock
    x, y = x0 + CELL * np.arange(sand.shape[1])[None], y0 + CELL * np.arange(sand.shape[0])[:, None]
    later = sand + sand_shift(x, y, season, seed)
    shifted = np.maximum(np.where(height > sand, height, later), later)
    return shifted, np.clip((shifted - later) / 0.03, 0, 1)


def with_corals(
    animals: np.ndarray, squares: list[tuple[int, int]], density: float, season: Season, seed: int
) -> np.ndarray:
    """The animals, and the corals and algae of these squares after a season; those in their way are left out."""
    corals = [coral for column, row in squares for coral in corals_of(column, row, density, season, seed)]
    algae = [patch for column, row in squares for patch in algae_of(column, row, season, seed)]
    return np.array(planted(animals.tolist(), corals, algae), np.float64).reshape(-1, ANIMAL_FIELDS)


def with_animals(height: np.ndarray, animals: np.ndarray, x0: float, y0: float) -> np.ndarray:
    """The owner of every cell; the animals are added to `height`."""
    owner = np.full((CELLS, CELLS), -1, np.int16)
    for number, animal in enumerate(animals):
        _add_animal(height, owner, x0, y0, CELL, animal, number)
    return owner


def lit_floor(
    height: np.ndarray, rock: np.ndarray, animals: np.ndarray, owner: np.ndarray, x0: float, y0: float, seed: int
) -> Seafloor:
    """A floor of this shape with its slopes and its light."""
    cell = CELL
    smooth = ndimage.gaussian_filter(height, 0.7)
    slope_y, slope_x = np.gradient(smooth, cell)
    sun = _sun_share(height, cell, SUN)
    sky = np.ones_like(height)
    for sigma in (0.03, 0.12, 0.4):
        hollow = _blurred(height, sigma / cell) - height
        sky *= np.clip(1 - 1.1 * hollow / sigma, 0.25, 1.15)
    shade = np.stack([slope_x, slope_y, sun, sky, rock], -1).astype(np.float32)
    return Seafloor(heightfield(height, x0, y0, cell), shade, animals, owner, seed)


def height_at(floor: Seafloor, x: np.ndarray, y: np.ndarray) -> np.ndarray:
    """Height of the surface at places inside the grid, metres."""
    s = floor.surface
    return ndimage.map_coordinates(s.height, [(y - s.y0) / s.cell, (x - s.x0) / s.cell], order=1, mode="nearest")


def _blurred(grid: np.ndarray, sigma: float) -> np.ndarray:
    """A Gaussian blur; wide ones work on every k-th node, which they cannot tell from all."""
    k = max(int(sigma / 4), 1)
    coarse = ndimage.gaussian_filter(grid[::k, ::k], sigma / k, truncate=2.0)
    if k == 1:
        return coarse
    at = np.arange(grid.shape[0]) / k
    rows = np.minimum(at.astype(int), coarse.shape[0] - 2)
    share = (at - rows)[:, None]
    tall = coarse[rows] * (1 - share) + coarse[rows + 1] * share
    return tall[:, rows] * (1 - share.T) + tall[:, rows + 1] * share.T


@numba.njit(cache=True)
@no_type_check
def terrain(nodes: int, x0: float, y0: float, cell: float, seed: int, radius: float) -> tuple[np.ndarray, np.ndarray]:
    """Sand (dunes and ripples) and sand with outcrops, before boulders and the rim; flat beyond `radius` of CENTER."""
    sand = np.empty((nodes, nodes))
    height = np.empty((nodes, nodes))
    for row in range(nodes):
        y = y0 + row * cell
        for column in range(nodes):
            x = x0 + column * cell
            if np.hypot(x - CENTER[0], y - CENTER[1]) > radius:  # out of sight
                sand[row, column] = height[row, column] = 0.0
                continue
            dune = 0.16 * fractal(x, y, 0.0, 2.6, 3, 0.45, 0.0, seed)
            warp = 0.11 * fractal(x, y, 0.0, 0.9, 2, 0.5, 0.0, seed + 11)
            crest = np.sin(2 * np.pi * (0.35 * x + 0.94 * y + warp) / 0.17)
            sand[row, column] = dune + 0.008 * (crest - 0.3 * crest * crest)
            lump = fractal(x, y, 0.0, 1.9, 2, 0.5, 0.0, seed + 23) - 0.08
            outcrop = -1.0
            if lump > -0.1:
                ridge = 0.0
                amplitude = 1.0
                for octave in range(4):
                    wavelength = 0.55 / (1 << octave)
                    ridge += amplitude * (0.5 - abs(fractal(x, y, 0.0, wavelength, 1, 0.5, 0.0, seed + 31 + octave)))
                    amplitude *= 0.5
                step = min(max(lump / 0.16, -0.4), 1.0)
                solid = 0.40 * step * (0.5 + 0.55 * ridge)
                # layers of rock that dip to one side weather into ledges
                layer = (solid + 0.12 * x - 0.07 * y + 0.05 * fractal(x, y, 0.0, 0.8, 3, 0.5, 0.0, seed + 41)) / 0.10
                within = layer - np.floor(layer)
                ledge = 0.10 * (min(within * 1.1, 1.0) ** 4 - within)
                rough = 0.02 * fractal(x, y, 0.0, 0.2, 4, 0.65, 0.0, seed + 47)
                outcrop = solid + 0.8 * ledge * min(max(step * 3, 0.0), 1.0) + rough + dune
            height[row, column] = max(sand[row, column], outcrop)
    return sand, height


def _boulders(rng: np.random.Generator) -> list[np.ndarray]:
    """x, y, two radii, height, angle of each: a few large ones ahead of the path, many small ones everywhere."""
    boulders = []
    for count, radius, nearest in ((9, (0.38, 0.75), 1.15), (40, (0.14, 0.32), 0.35), (260, (0.03, 0.11), 0.0)):
        placed = 0
        while placed < count:
            distance, angle = RIM * 0.97 * np.sqrt(rng.random()), rng.uniform(0, 2 * np.pi)
            x, y = CENTER[0] + distance * np.cos(angle), CENTER[1] + distance * np.sin(angle)
            if np.hypot(x, y - 0.6) < nearest + 0.6 * (nearest > 1):  # large ones leave room for the camera
                continue
            r = rng.uniform(*radius)
            boulders.append(some_boulder(rng, x, y, r))
            placed += 1
    return boulders


def some_boulder(rng: np.random.Generator, x: float, y: float, r: float) -> np.ndarray:
    """x, y, two radii, height and angle of a boulder of radius `r`."""
    return np.array([x, y, r, r * rng.uniform(0.6, 1.0), r * rng.uniform(0.65, 1.25), rng.uniform(0, np.pi)])


@numba.njit(cache=True)
@no_type_check
def add_boulder(
    height: np.ndarray, ground: np.ndarray, x0: float, y0: float, cell: float, boulder: np.ndarray, seed: int
) -> None:
    """Add a boulder that stands on `ground` to `height`."""
    x, y, a, b, top, angle = boulder
    reach = int(1.4 * max(a, b) / cell) + 1
    column0, row0 = int((x - x0) / cell), int((y - y0) / cell)
    if not (0 <= row0 < height.shape[0] and 0 <= column0 < height.shape[1]):
        return
    base = ground[row0, column0] - 0.18 * top
    cos, sin = np.cos(angle), np.sin(angle)
    for row in range(max(row0 - reach, 0), min(row0 + reach + 1, height.shape[0])):
        for column in range(max(column0 - reach, 0), min(column0 + reach + 1, height.shape[1])):
            dx, dy = x0 + column * cell - x, y0 + row * cell - y
            px, py = dx / a, dy / a
            bend = 0.26 * fractal(px, py, 0.0, 1.1, 3, 0.5, 0.0, seed)
            r = np.hypot((cos * dx + sin * dy) / a, (cos * dy - sin * dx) / b) * (1 + bend)
            if r >= 1:
                continue
            dome = (1 - r**2.6) ** 0.62
            crack = abs(fractal(px, py, 0.0, 0.8, 4, 0.6, 0.0, seed + 7))
            facet = fractal(px, py, 0.0, 1.3, 2, 0.5, 0.0, seed + 13)
            grit = fractal(dx, dy, 0.0, 0.16, 4, 0.6, 0.0, seed + 17)
            rough = 1 + 0.25 * facet - 0.10 * max(0.0, 0.2 - crack) / 0.2 - 0.1 * crack + 0.02 * grit / top
            height[row, column] = max(height[row, column], base + top * 1.18 * dome * rough)


def _animals(
    rng: np.random.Generator, height: np.ndarray, rock: np.ndarray, x0: float, y0: float, cell: float
) -> np.ndarray:
    """Sea stars and urchins everywhere, sponges on rock: bright colors and near-black at every distance."""
    rows = []
    wanted = {STAR: 70, URCHIN: 110, SPONGE: 90}
    while any(wanted.values()):
        kind = int(rng.choice([kind for kind, left in wanted.items() if left]))
        distance, angle = RIM * 0.98 * np.sqrt(rng.random()), rng.uniform(0, 2 * np.pi)
        x, y = CENTER[0] + distance * np.cos(angle), CENTER[1] + distance * np.sin(angle)
        row, column = int((y - y0) / cell), int((x - x0) / cell)
        if not has_room(kind, x, y, height, rock, row, column, rows):
            continue
        rows.append(some_animal(rng, kind, x, y))
        wanted[kind] -= 1
    return np.array(rows)


def has_room(
    kind: int,
    x: float,
    y: float,
    height: np.ndarray,
    rock: np.ndarray,
    row: int,
    column: int,
    others: list[list[float]],
) -> bool:
    """Return whether an animal fits at a place: the ground is even, of its kind, and no other animal is near."""
    patch = height[row - 6 : row + 7, column - 6 : column + 7]
    if np.ptp(patch) > 0.09 or (kind == SPONGE and rock[row, column] < 0.9):
        return False
    return not any(np.hypot(x - other[1], y - other[2]) < 0.14 for other in others)


def some_animal(rng: np.random.Generator, kind: int, x: float, y: float) -> list[float]:
    """The fields of an animal, see ANIMAL_FIELDS."""
    if kind == STAR:
        r, top, color = rng.uniform(0.06, 0.12), 0.012, _STAR_COLORS[rng.integers(4)]
    elif kind == URCHIN:
        r, top, color = rng.uniform(0.045, 0.08), 0.035, (0.002, 0.0016, 0.002)
    else:
        r, top, color = rng.uniform(0.03, 0.075), rng.uniform(0.03, 0.08), _SPONGE_COLORS[rng.integers(4)]
    return [kind, x, y, r, top, rng.uniform(0, 2 * np.pi), *(np.array(color) * rng.uniform(0.75, 1.1))]


@numba.njit(cache=True, inline="always")
@no_type_check
def outline(animal: np.ndarray, dx: float, dy: float) -> float:
    """Distance from an animal's middle in units of its outline: below 1 inside."""
    r = np.hypot(dx, dy) / animal[3]
    phi = np.arctan2(dy, dx) + animal[5]
    if animal[0] == STAR:
        arm = abs(((phi * 5 / (2 * np.pi)) % 1.0) - 0.5) * 2  # 0 between two arms, 1 along an arm
        return r / (0.32 + 0.68 * arm**2.2)
    if animal[0] == URCHIN:
        return r / (0.72 + 0.28 * abs(np.sin(phi * 11)))
    return r / (0.9 + 0.1 * np.sin(3 * phi))


@numba.njit(cache=True)
@no_type_check
def _add_animal(
    height: np.ndarray, owner: np.ndarray, x0: float, y0: float, cell: float, animal: np.ndarray, number: int
) -> None:
    x, y = animal[1], animal[2]
    reach = int(1.1 * animal[3] / cell) + 2
    column0, row0 = int((x - x0) / cell), int((y - y0) / cell)
    for row in range(row0 - reach, row0 + reach + 1):
        for column in range(column0 - reach, column0 + reach + 1):
            r = outline(animal, x0 + column * cell - x, y0 + row * cell - y)
            owner[row, column] = number
            if r < 1:
                height[row, column] += animal[4] * (1 - r * r) ** 0.6


@numba.njit(cache=True)
@no_type_check
def _add_rim(height: np.ndarray, x0: float, y0: float, cell: float, seed: int) -> None:
    """Let the floor fall away, steeper than any ray of a camera on the terrace, past the rim."""
    for row in range(height.shape[0]):
        y = y0 + row * cell
        for column in range(height.shape[1]):
            x = x0 + column * cell
            dx, dy = x - CENTER[0], y - CENTER[1]
            past = np.hypot(dx, dy) - RIM - 0.7 * fractal(x, y, 0.0, 3.0, 3, 0.5, 0.0, seed)
            if past > 0:
                height[row, column] -= 1.4 * past * past / (past + 0.25)


@numba.njit(cache=True)
@no_type_check
def _sun_share(height: np.ndarray, cell: float, sun: np.ndarray) -> np.ndarray:
    """Share of the sun's disc that each node sees, 0..1: light under water is diffuse, so shadows are soft."""
    n = height.shape[0]
    share = np.ones((n, n), np.float64)
    horizontal = np.hypot(sun[0], sun[1])
    ux, uy, rise = sun[0] / horizontal, sun[1] / horizontal, sun[2] / horizontal
    for row in range(n):
        for column in range(n):
            distance = 1.5 * cell
            lit = 1.0
            while distance < 0.7:
                x, y = column + ux * distance / cell, row + uy * distance / cell
                i, j = int(x), int(y)
                if i < 0 or j < 0 or i >= n or j >= n:
                    break
                clear = height[row, column] + rise * distance - height[j, i]
                lit = min(lit, 0.5 + 3.0 * clear / distance)
                if lit <= 0:
                    lit = 0.0
                    break
                distance *= 1.25
            share[row, column] = lit
    return share
