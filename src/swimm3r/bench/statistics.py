"""Means, spreads and paired differences of cells.

A pair is one method and the one it is compared with on the same scene with the same seed, so that neither the scene's
difficulty nor the seed's luck is in the difference. Its interval is Student's t over the pairs, 95 %. Seeds of one clip
are not clips: the interval says whether these clips' difference is more than chance, not what another clip would show.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass

from swimm3r.bench.cells import Result
from swimm3r.evaluate import NotComputed


@dataclass(frozen=True)
class Row:
    """One score of one method over all its cells."""

    method: str
    score: str
    cells: int
    mean: float
    spread: float  # standard deviation over seeds, pooled over scenes; NaN for a single seed
    difference: float  # mean of the paired differences from `against`; NaN without pairs
    half_width: float  # of their 95 % interval; NaN for fewer than 2 pairs
    pairs: int
    against: str


def rows(cells: Sequence[Result], against: str | None = None) -> list[Row]:
    """Every score of every method, in the order of the cells; differences are from `against`, else the first method.

    Where methods have two parts, "colmap / uwbs-static", `against` may be the last part alone: each is then compared
    with the one that shares its first part.
    """
    methods = list(dict.fromkeys(cell.method for cell in cells))
    scores = list(dict.fromkeys(name for cell in cells for name in cell.scores))
    found = []
    for score in scores:
        known = {(c.method, c.scene, c.seed): v for c in cells if (v := number(c, score)) is not None}
        for method in methods:
            mine = {key[1:]: value for key, value in known.items() if key[0] == method}
            if not mine:
                continue
            base = _compared_with(method, against or methods[0], methods)
            pairs = [v - known[base, *key] for key, v in mine.items() if (base, *key) in known]
            difference, half_width = mean_interval(pairs)
            mean = sum(mine.values()) / len(mine)
            spread = _pooled_spread(mine)
            found.append(Row(method, score, len(mine), mean, spread, difference, half_width, len(pairs), base))
    return found


def number(cell: Result, score: str) -> float | None:
    """The score where it was computed."""
    value = cell.scores.get(score)
    return None if isinstance(value, NotComputed) else value


def mean_interval(values: Sequence[float]) -> tuple[float, float]:
    """Mean and the half width of its 95 % interval (Student's t); NaN where there are too few values."""
    from scipy.stats import t as student

    n = len(values)
    mean = sum(values) / n if n else math.nan
    if n < 2:
        return mean, math.nan
    variance = sum((v - mean) ** 2 for v in values) / (n - 1)
    return mean, float(student.ppf(0.975, n - 1)) * math.sqrt(variance / n)


def _compared_with(method: str, against: str, methods: Sequence[str]) -> str:
    sibling = " / ".join([*method.split(" / ")[:-1], against])
    return sibling if sibling in methods else against


def _pooled_spread(values: dict[tuple[str, int], float]) -> float:
    squares, freedom = 0.0, 0
    for scene in {key[0] for key in values}:
        mine = [v for key, v in values.items() if key[0] == scene]
        mean = sum(mine) / len(mine)
        squares += sum((v - mean) ** 2 for v in mine)
        freedom += len(mine) - 1
    return math.sqrt(squares / freedom) if freedom else math.nan
