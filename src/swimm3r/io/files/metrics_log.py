"""A training's numbers in metrics.jsonl: one JSON object with its `step` per line, appended while the training runs.

A training that is killed may leave half a row at the end, and rows of steps after its last checkpoint.
"""

import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from swimm3r.io.files.atomic import write_text


def append_row(path: Path, row: Mapping[str, Any]) -> None:
    """Add a row; it holds its `step`."""
    with path.open("a", encoding="utf-8") as file:
        file.write(json.dumps(row) + "\n")


def read_rows(path: Path) -> list[dict[str, Any]]:
    """The whole rows in their order; none where there is no file. Lines that are no row are left out."""
    if not path.is_file():
        return []
    lines = path.read_text(encoding="utf-8", errors="replace").splitlines()
    return [row for row in map(_parsed, lines) if row is not None]


def drop_rows_after(path: Path, step: int) -> None:
    """Remove the rows of later steps, which are done again, and what is no whole row."""
    if path.is_file():
        write_text(path, "".join(json.dumps(row) + "\n" for row in read_rows(path) if row["step"] <= step))


def _parsed(line: str) -> dict[str, Any] | None:
    try:
        row = json.loads(line)
    except (ValueError, RecursionError):  # cut short, or never JSON
        return None
    is_row = isinstance(row, dict) and isinstance(row.get("step"), int) and not isinstance(row["step"], bool)
    return row if is_row else None
