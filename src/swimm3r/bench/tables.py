"""Cells as the paper's table: NAME.md, NAME.csv (a line per cell), NAME.json (cells and rows), NAME.tex.

A mean over fewer scenes than its neighbors' is no comparison, so the number of cells stands in each row; the
differences are taken over common scenes and seeds only.
"""

import csv
import io
import json
import math
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from pathlib import Path

from swimm3r.bench.cells import Result
from swimm3r.bench.scores import Column
from swimm3r.bench.statistics import Row, number, rows
from swimm3r.evaluate import NotComputed, summary_entries
from swimm3r.io.files.atomic import write_text

_ARROW = {"high": " ↑", "low": " ↓", "neither": ""}
_BY_SCENE = 3  # columns of the table by scene
_LATEX_ARROW = {"high": r"$\uparrow$", "low": r"$\downarrow$", "neither": ""}


@dataclass(frozen=True)
class Table:
    """A protocol's cells and how they are shown."""

    name: str  # of the files
    title: str
    cells: Sequence[Result]
    columns: Sequence[Column]
    against: str | None = None  # the method that differences are taken from; the first where none is named
    preset: str = ""  # that supplied the settings, and whether options changed them; none where no preset has a say

    @property
    def shown(self) -> list[Column]:
        """The columns that some cell has, or gives a reason for not having; all where no method was run."""
        found = [c for c in self.columns if any(c.score in cell.scores for cell in self.cells)]
        return found or list(self.columns)


def write(folder: Path, table: Table) -> str:
    """Write the four files; the Markdown is returned, too."""
    text = markdown(table)
    write_text(folder / f"{table.name}.md", text)
    write_text(folder / f"{table.name}.csv", _csv(table))
    write_text(folder / f"{table.name}.json", _json(table))
    write_text(folder / f"{table.name}.tex", latex(table))
    return text


def markdown(table: Table) -> str:
    """Means by method, by scene, paired differences, and in words what is missing and what the columns mean."""
    found = rows(table.cells, table.against)
    scenes, seeds = len({c.scene for c in table.cells}), len({c.seed for c in table.cells})
    facts = [_counted(scenes, "scene"), _counted(seeds, "seed"), *([f"preset {table.preset}"] if table.preset else [])]
    parts = [f"# {table.title}", f"{', '.join(facts)}."]
    parts.append(_means(table, found, seeds))
    if scenes > 1:
        parts.append(_by_scene(table))
    parts.append(_differences(table, found))
    parts += [_missing(table), _notes(table)]
    return "\n\n".join(part for part in parts if part) + "\n"


def latex(table: Table) -> str:
    """A tabular of the means, and where there are several scenes another of the first columns by scene, as the paper's.

    The best of each column is bold, among the means over the most cells; a mean over fewer has their number behind it.
    """
    shown = table.shown
    found = rows(table.cells, table.against)
    head = " & ".join(["Method", *(_latex_label(c) for c in shown)]) + r" \\"
    text = _tabular(table, [head], [(found, c) for c in shown])
    scenes = list(dict.fromkeys(c.scene for c in table.cells))
    if len(scenes) < 2:
        return text
    few = shown[:_BY_SCENE]
    parts = [rows([c for c in table.cells if c.scene == scene]) for scene in scenes]
    groups = [rf"\multicolumn{{{len(few)}}}{{c}}{{{_escaped(name)}}}" for name in (*scenes, "Average")]
    names = [_latex_label(c) for c in few] * (len(scenes) + 1)
    heads = [" & ".join(["", *groups]) + r" \\", " & ".join(["Method", *names]) + r" \\"]
    return text + "\n" + _tabular(table, heads, [(part, c) for part in (*parts, found) for c in few])


def _tabular(table: Table, heads: Sequence[str], columns: Sequence[tuple[Sequence[Row], Column]]) -> str:
    """One line per method, one column per rows and score."""
    lines = [
        f"% {table.title}" + (f" (preset {table.preset})" if table.preset else ""),
        r"\begin{tabular}{l|" + "c" * len(columns) + "}",
        *heads,
        r"\hline",
    ]
    printed = [_printed([r for r in found if r.score == c.score], c) for found, c in columns]
    for method in _methods(table.cells):
        lines.append(" & ".join([_escaped(method), *(values.get(method, "--") for values in printed)]) + r" \\")
    return "\n".join([*lines, r"\hline", r"\end{tabular}"]) + "\n"


def _printed(found: Sequence[Row], column: Column) -> dict[str, str]:
    """The means of a column by method; only those over the most cells compete for bold."""
    most = max((r.cells for r in found), default=0)
    winner = _best([r for r in found if r.cells == most], column)
    printed = {}
    for r in found:
        value = f"{r.mean:.{column.digits}f}"
        bold = rf"\textbf{{{value}}}" if value == winner else value
        printed[r.method] = f"{value} ({r.cells})" if r.cells < most else bold
    return printed


def _means(table: Table, found: Sequence[Row], seeds: int) -> str:
    known, shown = {(r.method, r.score): r for r in found}, table.shown
    lines = [_line(["method", "cells", *(c.label + _ARROW[c.best] for c in shown)]), _rule(len(shown) + 2)]
    for method in _methods(table.cells):
        counted = sum(1 for cell in table.cells if cell.method == method and not cell.not_run)
        values = []
        for c in shown:
            row = known.get((method, c.score))
            spread = f" ± {row.spread:.{c.digits}f}" if row and seeds > 1 and not math.isnan(row.spread) else ""
            fewer = f" ({row.cells})" if row and row.cells < counted else ""
            values.append("-" if row is None else f"{row.mean:.{c.digits}f}{spread}{fewer}")
        lines.append(_line([method, f"{counted}" if counted else "not run", *values]))
    note = "± is the spread over seeds; a number in brackets counts the cells of a mean over fewer."
    return "\n".join([*lines, "", note] if seeds > 1 else lines)


def _by_scene(table: Table) -> str:
    shown = table.shown
    lines = [_line(["scene", "method", *(c.label + _ARROW[c.best] for c in shown)]), _rule(len(shown) + 2)]
    for scene in dict.fromkeys(c.scene for c in table.cells):
        mine = [c for c in table.cells if c.scene == scene]
        known = {(r.method, r.score): r for r in rows(mine)}
        for method in _methods(mine):
            values = [known.get((method, c.score)) for c in shown]
            texts = ["-" if r is None else f"{r.mean:.{c.digits}f}" for r, c in zip(values, shown, strict=True)]
            lines.append(_line([scene, method, *texts]))
    return "\n".join(["## By scene", "", *lines])


def _differences(table: Table, found: Sequence[Row]) -> str:
    digits = {c.score: c.digits + 2 for c in table.shown if c.best != "neither"}
    compared = [r for r in found if r.method != r.against and r.pairs and r.score in digits]
    if not compared:
        return ""
    lines = [_line(["score", "method", "from", "difference", "95 % interval", "pairs"]), _rule(6)]
    for r in compared:
        low, high = r.difference - r.half_width, r.difference + r.half_width
        d = min(digits[r.score], 4)
        interval = "-" if math.isnan(low) else f"{low:+.{d}f} .. {high:+.{d}f}"
        lines.append(_line([r.score, r.method, r.against, f"{r.difference:+.{d}f}", interval, f"{r.pairs}"]))
    return "\n".join(["## Paired differences", "", *lines])


def _missing(table: Table) -> str:
    lines = [f"- {c.scene}, {c.method}: not run: {c.not_run}" for c in table.cells if c.not_run]
    reasons: dict[tuple[str, str], list[str]] = {}
    for cell in table.cells:
        for score, value in cell.scores.items():
            if isinstance(value, NotComputed):
                reasons.setdefault((score, value.reason), []).append(f"{cell.scene}, {cell.method}")
    for (score, reason), where in reasons.items():
        more = f" and {len(where) - 1} more" if len(where) > 1 else ""
        lines.append(f"- {score} of {where[0]}{more}: {reason}")
    return "\n".join(["## Not computed", "", *lines]) if lines else ""


def _notes(table: Table) -> str:
    """The meaning of the columns; columns that differ only by a threshold share a line."""
    notes: dict[str, list[str]] = {}
    for c in table.shown:
        notes.setdefault(c.note, []).append(f"{c.label} (`{c.score}`)")
    lines = [f"- {', '.join(names)}: {note}" for note, names in notes.items() if note]
    return "\n".join(["## Columns", "", *lines])


def _csv(table: Table) -> str:
    names = list(dict.fromkeys(name for cell in table.cells for name in cell.scores))
    text = io.StringIO()
    writer = csv.writer(text, lineterminator="\n")
    writer.writerow(["scene", "method", "seed", *names, "not_run"])
    for cell in table.cells:
        values = (number(cell, name) for name in names)
        writer.writerow([cell.scene, cell.method, cell.seed, *("" if v is None else v for v in values), cell.not_run])
    return text.getvalue()


def _json(table: Table) -> str:
    plain = [
        {k: None if isinstance(v, float) and math.isnan(v) else v for k, v in asdict(r).items()}
        for r in rows(table.cells, table.against)
    ]
    cells = [
        {
            "scene": c.scene,
            "method": c.method,
            "seed": c.seed,
            "not_run": c.not_run or None,
            "scores": summary_entries(c.scores),
        }
        for c in table.cells
    ]
    notes = {c.score: c.note for c in table.shown}
    document = {"schema": 2, "protocol": table.name, "title": table.title, "preset": table.preset or None}
    document["variants"] = notes
    return json.dumps({**document, "cells": cells, "rows": plain}, indent=2) + "\n"


def _best(found: Sequence[Row], column: Column) -> str | None:
    """The best mean as it is printed, so that equal prints are equally bold; None where no value is better."""
    if column.best == "neither" or len(found) < 2:
        return None
    value = (max if column.best == "high" else min)(r.mean for r in found)
    return f"{value:.{column.digits}f}"


def _methods(cells: Sequence[Result]) -> list[str]:
    return list(dict.fromkeys(c.method for c in cells))


def _line(values: Sequence[str]) -> str:
    return "| " + " | ".join(values) + " |"


def _rule(count: int) -> str:
    return _line(["---"] * count)


def _counted(count: int, singular: str) -> str:
    return f"{count} {singular}{'s' * (count != 1)}"


def _latex_label(column: Column) -> str:
    return _escaped(column.label) + _LATEX_ARROW[column.best]


def _escaped(text: str) -> str:
    for sign in "&%_#":
        text = text.replace(sign, f"\\{sign}")
    return text.replace("δ<", r"$\delta<$")
