"""The scripts of benchmarks/ still run: what they call changes, and nobody runs them for months."""

import subprocess
import sys
from importlib.util import module_from_spec, spec_from_file_location
from pathlib import Path
from types import ModuleType

import numpy as np
import pytest

FOLDER = Path(__file__).parents[1] / "benchmarks"


def script(path: Path) -> ModuleType:
    spec = spec_from_file_location(f"benchmarks_{path.stem}", path)
    assert spec is not None
    assert spec.loader is not None
    module = module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def test_a_training_step_is_measured_part_by_part():
    command = [sys.executable, str(FOLDER / "train_step.py"), "--sizes", "XS", "--threads", "1", "--repeats", "1"]
    command += ["--lenses", "pinhole", "fisheye"]
    run = subprocess.run(command, capture_output=True, text=True, check=True)
    heads, *rows = (
        [cell.strip() for cell in line.strip("|").split("|")]
        for line in run.stdout.splitlines()
        if line.startswith(("| size", "| XS"))
    )
    assert [row[1] for row in rows] == ["pinhole", "fisheye"]
    assert all(len(heads) == len(row) for row in rows)
    assert all(float(cell) >= 0 for row in rows for cell in row[3:])


def test_every_script_loads_and_names_its_command(monkeypatch: pytest.MonkeyPatch):
    for path in sorted(FOLDER.rglob("*.py")):
        with monkeypatch.context() as beside:
            beside.syspath_prepend(path.parent)
            module = script(path)
        if "__main__" in path.read_text(encoding="utf-8"):  # others are read by those beside them
            assert f"python benchmarks/{path.relative_to(FOLDER)}" in (module.__doc__ or ""), path.name


def test_a_frame_is_drawn_only_where_it_shows_the_place():
    """Beyond its border an image is repeated, which is no frame's view."""
    attainable = script(FOLDER / "attainable.py")
    at = np.array([[[-0.5, 3.0], [0.0, 0.0], [7.0, 5.0], [7.5, 3.0], [3.0, 5.5], [np.nan, 0.0]]])
    assert attainable._within(at, (6, 8)).tolist() == [[False, True, True, False, False, False]]
