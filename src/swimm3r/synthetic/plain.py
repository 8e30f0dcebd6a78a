"""A seafloor without end: square patches of a plain of sand, outcrops, boulders and animals, made as a camera comes by.

The terrain is a function of the place. Boulders and animals belong to squares of a lattice, one meter wide, and follow
from the seed and the square's numbers. Patches therefore agree where they overlap, but for a strip of BORDER along
their edges, where light and boulders of the neighbors are missing; no camera sees that strip (`REACH`).

Axes as on the terrace (`seafloor`): x to the right, y ahead, z up, metres; the sand lies near z = 0.
"""

from dataclasses import dataclass, field
from functools import lru_cache

import numpy as np

from swimm3r.synthetic.seafloor import (
    ANIMAL_FIELDS,
    CELL,
    CELLS,
    EXTENT,
    SPONGE,
    STAR,
    URCHIN,
    Seafloor,
    add_boulder,
    has_room,
    lit_floor,
    some_animal,
    some_boulder,
    terrain,
    with_animals,
    with_corals,
    with_shifted_sand,
)
from swimm3r.synthetic.settings import Season

STEP = 896  # cells between two patches: a multiple of the steps that wide blurs take (`seafloor`)
BORDER = 1.2  # m along a patch's edges that differ from patch to patch
REACH = EXTENT / 2 - STEP * CELL / 2 - BORDER  # m around a camera that its patch shows rightly
_BOULDERS = ((0.05, (0.30, 0.36)), (0.35, (0.12, 0.30)), (3.0, (0.03, 0.11)))  # per square meter, radius
_ANIMALS = {STAR: 0.8, URCHIN: 1.2, SPONGE: 1.0}  # tries per square meter
_KEPT = 3  # patches in memory, 170 MB each


@dataclass(frozen=True)
class Plain:
    """The plain of a seed."""

    seed: int
    corals: float = 0.0  # per square meter
    season: Season = field(default_factory=Season)

    def around(self, x: float, y: float) -> Seafloor:
        """The patch whose middle is nearest to a place, metres."""
        return _patch(self, round(x / (STEP * CELL)), round(y / (STEP * CELL)))


@lru_cache(maxsize=_KEPT)
def _patch(plain: Plain, i: int, j: int) -> Seafloor:
    """The patch in column i and row j."""
    seed = plain.seed
    x0, y0 = (i * STEP - CELLS // 2) * CELL, (j * STEP - CELLS // 2) * CELL
    sand, ground = terrain(CELLS + 1, x0, y0, CELL, seed * 7919 + 1, np.inf)
    squares = [
        (column, row, np.random.default_rng([seed, 4, column + (1 << 20), row + (1 << 20)]))
        for row in range(int(np.floor(y0)), int(np.ceil(y0 + EXTENT)))
        for column in range(int(np.floor(x0)), int(np.ceil(x0 + EXTENT)))
    ]
    height = ground.copy()
    for count, radius in _BOULDERS:  # large ones first, everywhere
        for column, row, rng in squares:
            for _ in range(rng.poisson(count)):
                boulder = some_boulder(rng, column + rng.random(), row + rng.random(), rng.uniform(*radius))
                add_boulder(height, ground, x0, y0, CELL, boulder, int(rng.integers(1 << 30)))
    rock = np.clip((height - sand) / 0.03, 0, 1)
    animals = [animal for square in squares for animal in _animals(*square, height, rock, x0, y0)]
    rows = np.array(animals, np.float64).reshape(-1, ANIMAL_FIELDS)
    height, rock = with_shifted_sand(height, rock, sand, x0, y0, plain.season, seed)
    within = [  # whole, wherever a season moves them
        (column, row)
        for column, row, _ in squares
        if min(column - x0, row - y0) >= 1 and max(column - x0, row - y0) <= EXTENT - 2
    ]
    rows = with_corals(rows, within, plain.corals, plain.season, seed)
    owner = with_animals(height, rows, x0, y0)
    return lit_floor(height, rock, rows, owner, x0, y0, seed)


def _animals(
    column: int, row: int, rng: np.random.Generator, height: np.ndarray, rock: np.ndarray, x0: float, y0: float
) -> list[list[float]]:
    """The animals of one square; they keep to its middle, away from those of its neighbors."""
    found: list[list[float]] = []
    for kind, count in _ANIMALS.items():
        for _ in range(rng.poisson(count)):
            x, y = column + rng.uniform(0.1, 0.9), row + rng.uniform(0.1, 0.9)
            animal = some_animal(rng, kind, x, y)
            at_x, at_y = int((x - x0) / CELL), int((y - y0) / CELL)
            inside = min(at_x, at_y) >= 32 and max(at_x, at_y) < CELLS - 32  # an animal and its surroundings
            if inside and has_room(kind, x, y, height, rock, at_y, at_x, found):
                found.append(animal)
    return found
