"""The dives of repeat visits: pairs of waters, each over a seafloor whose season shows on ground that both visits film.

Pair k has the first of the seeds s + k, s + k + 4, s + k + 8, ... at which both visits film enough corals of each fate
of `LEAST` whole: their outlines before and after the season, on the plane z = 0, in `VIEWS` frames of each visit. This
is decided by the truth alone, by paths, lens and the lattice of the corals; nothing is rendered.
"""

from collections import Counter
from typing import Literal

import numpy as np
import torch
from jaxtyping import Float, Int

from swimm3r.bench.settings import RevisitSettings
from swimm3r.cameras import Cameras, project
from swimm3r.errors import UsageError
from swimm3r.synthetic import DiveSettings, make_dive
from swimm3r.synthetic.season import Coral, Fate, corals_of
from swimm3r.synthetic.settings import Season

Family = Literal["cyan", "teal", "green", "warm"]
WATERS: tuple[tuple[Family, Family], ...] = (("cyan", "green"), ("teal", "cyan"), ("green", "warm"), ("warm", "teal"))
SEASON = Season(grown=0.25, bleached=0.25, broken=0.15, moved=0.15, algae=0.2, sand=0.12)
LEAST: dict[Fate, int] = {"bleached": 2, "grown": 1, "moved": 1}  # corals on the common ground
VIEWS = 3  # of each visit that show a coral whole: as many as a depth map is confirmed by
_LIGHT = (0.8, 0.9, 1.0)  # of the later visit
_SEEDS = 100  # that are tried
_BORDER = 0.05  # of the image's sides, which a coral keeps clear of
_AROUND = 8  # points of an outline
_BESIDE = 2  # m around the camera's path where corals are looked for


def pair_of_dives(number: int, revisits: RevisitSettings) -> tuple[DiveSettings, DiveSettings, DiveSettings]:
    """A first visit, a visit after a season, and one after none, in the waters of a number.

    Raises UsageError where no seed has a season that both visits film.
    """
    first_seed = revisits.seed + number
    for seed in range(first_seed, first_seed + _SEEDS * len(WATERS), len(WATERS)):
        first, later, same = (_dive(number, seed, visit, revisits) for visit in range(3))
        filmed = filmed_by_both(first, later)
        if all(filmed[fate] >= count for fate, count in LEAST.items()):
            return first, later, same
    wanted = ", ".join(f"{count} {fate}" for fate, count in LEAST.items())
    raise UsageError(
        f"none of {_SEEDS} seafloors has corals of each kind ({wanted}) that both visits film",
        cause=f"a path of {revisits.path_length:g} m at {revisits.width}x{revisits.height} shows too little ground",
        hint="--path-length 10, or wider frames",
    )


def filmed_by_both(first: DiveSettings, later: DiveSettings) -> Counter[Fate]:
    """The number of corals of each fate that both visits film whole, by `later`'s season."""
    cameras = [make_dive(dive).cameras for dive in (first, later)]
    path = cameras[0].centers[:, :2].numpy()
    low, high = np.floor(path.min(0)).astype(int) - _BESIDE, np.ceil(path.max(0)).astype(int) + _BESIDE
    found: Counter[Fate] = Counter()
    for column in range(int(low[0]), int(high[0])):
        for row in range(int(low[1]), int(high[1])):
            for coral in corals_of(column, row, later.corals, later.season, later.seed):
                found[coral.fate] += all(_whole_views(each, coral) >= VIEWS for each in cameras)
    return found


def _dive(number: int, seed: int, visit: int, revisits: RevisitSettings) -> DiveSettings:
    """The dive of a visit: 0 is the first one, 1 has a season behind it, 2 has none."""
    return DiveSettings(
        path="lawnmower", length=revisits.path_length, speed=0.25, fps=1,
        width=revisits.width, height=revisits.height,
        seed=seed, corals=0.7, family=WATERS[number % len(WATERS)][min(visit, 1)], visit=visit,
        season=SEASON if visit == 1 else Season(), daylight=_LIGHT if visit else (1.0, 1.0, 1.0),
    )  # fmt: skip


def _whole_views(cameras: Cameras, coral: Coral) -> int:
    """The number of images that hold the outlines of a coral before and after the season."""
    turn = np.linspace(0, 2 * np.pi, _AROUND, endpoint=False)
    outlines = [
        np.stack([x + radius * np.cos(turn), y + radius * np.sin(turn), np.zeros_like(turn)], -1)
        for _, x, y, radius, *_ in (coral.before, coral.after)
    ]
    return int(_images_with(cameras, np.concatenate(outlines)).sum())


def _images_with(cameras: Cameras, points: Float[np.ndarray, "n 3"]) -> Int[np.ndarray, " c"]:
    """1 for each image that holds all of the points, else 0."""
    pixels, z = project(cameras, torch.from_numpy(points).expand(len(cameras), -1, -1))
    size = torch.tensor([cameras.width, cameras.height]).double()
    inside = (pixels > _BORDER * size) & (pixels < (1 - _BORDER) * size) & (z[..., None] > 0)
    return inside.all(-1).all(-1).int().numpy()
