"""Means, spreads and paired differences of an ablation, as a table, CSV and JSON.

A pair is one variant and the first one on the same run with the same seed, so that neither the clip's difficulty nor
the seed's luck is in the difference. Its interval is Student's t over the pairs, 95 %. Seeds of one clip are not clips:
the interval says whether these clips' difference is more than chance, not what another clip would show.
"""

import csv
import io
import json
import math
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from pathlib import Path

from scipy.stats import t as student

from swimm3r.io.atomic import write_text


@dataclass(frozen=True)
class Cell:
    """One training and its scores; None where a score could not be computed."""

    run: str
    variant: str
    seed: int
    scores: dict[str, float | None]


@dataclass(frozen=True)
class Row:
    """One score of one variant over all its cells."""

    variant: str
    score: str
    cells: int
    mean: float
    spread: float  # standard deviation over seeds, pooled over runs; NaN for a single seed
    difference: float  # mean of the paired differences from the first variant
    half_width: float  # of their 95 % interval; NaN for fewer than 2 pairs


def rows(cells: Sequence[Cell]) -> list[Row]:
    """Every variant and score that could be computed, in the order of the cells; the first variant is the baseline."""
    variants = list(dict.fromkeys(cell.variant for cell in cells))
    scores = list(dict.fromkeys(name for cell in cells for name in cell.scores))
    found = []
    for score in scores:
        known = {(c.variant, c.run, c.seed): v for c in cells if (v := c.scores.get(score)) is not None}
        for variant in variants:
            mine = {key[1:]: value for key, value in known.items() if key[0] == variant}
            if not mine:
                continue
            pairs = [v - known[variants[0], *key] for key, v in mine.items() if (variants[0], *key) in known]
            difference, half_width = mean_interval(pairs)
            mean = sum(mine.values()) / len(mine)
            found.append(Row(variant, score, len(mine), mean, _pooled_spread(mine), difference, half_width))
    return found


def mean_interval(values: Sequence[float]) -> tuple[float, float]:
    """Mean and the half width of its 95 % interval (Student's t); NaN where there are too few values."""
    n = len(values)
    mean = sum(values) / n if n else math.nan
    if n < 2:
        return mean, math.nan
    variance = sum((v - mean) ** 2 for v in values) / (n - 1)
    return mean, float(student.ppf(0.975, n - 1)) * math.sqrt(variance / n)


def _pooled_spread(values: dict[tuple[str, int], float]) -> float:
    squares, freedom = 0.0, 0
    for run in {key[0] for key in values}:
        mine = [v for key, v in values.items() if key[0] == run]
        mean = sum(mine) / len(mine)
        squares += sum((v - mean) ** 2 for v in mine)
        freedom += len(mine) - 1
    return math.sqrt(squares / freedom) if freedom else math.nan


def table(cells: Sequence[Cell]) -> str:
    """Markdown: per variant and score mean, spread over seeds, paired difference and its interval."""
    runs, seeds = len({c.run for c in cells}), len({c.seed for c in cells})
    lines = [
        f"{runs} run{'s' * (runs != 1)} x {seeds} seed{'s' * (seeds != 1)}; differences are paired with the first row.",
        "",
        "| score | variant | mean | spread over seeds | difference | 95 % interval |",
        "| --- | --- | --- | --- | --- | --- |",
    ]
    for r in rows(cells):
        low, high = r.difference - r.half_width, r.difference + r.half_width
        interval = "-" if math.isnan(low) else f"{low:+.4f} .. {high:+.4f}"
        spread = "-" if math.isnan(r.spread) else f"{r.spread:.4f}"
        lines.append(f"| {r.score} | {r.variant} | {r.mean:.4f} | {spread} | {r.difference:+.4f} | {interval} |")
    return "\n".join(lines) + "\n"


def write_tables(folder: Path, cells: Sequence[Cell]) -> None:
    """ablation.csv (a line per cell), ablation.json (cells and rows) and ablation.md (the table)."""
    names = list(dict.fromkeys(name for cell in cells for name in cell.scores))
    text = io.StringIO()
    writer = csv.writer(text, lineterminator="\n")
    writer.writerow(["run", "variant", "seed", *names])
    for c in cells:
        writer.writerow([c.run, c.variant, c.seed, *("" if c.scores.get(n) is None else c.scores[n] for n in names)])
    write_text(folder / "ablation.csv", text.getvalue())
    plain = [
        {k: None if isinstance(v, float) and math.isnan(v) else v for k, v in asdict(r).items()} for r in rows(cells)
    ]
    document = {"schema": 1, "cells": [asdict(c) for c in cells], "rows": plain}
    write_text(folder / "ablation.json", json.dumps(document, indent=2) + "\n")
    write_text(folder / "ablation.md", table(cells))
