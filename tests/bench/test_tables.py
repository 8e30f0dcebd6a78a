"""Means, paired differences and their interval, and what the four files say."""

import json
import math
from pathlib import Path

import pytest

from swimm3r.bench.cells import Result
from swimm3r.bench.scores import COLUMNS, columns
from swimm3r.bench.statistics import mean_interval, rows
from swimm3r.bench.tables import Table, latex, markdown, write
from swimm3r.evaluate import NotComputed

BASE = {("a", 0): 20.0, ("a", 1): 21.0, ("b", 0): 30.0, ("b", 1): 31.0}
MISSING = NotComputed("no weights")


def cells_with_a_gain(gain: float) -> list[Result]:
    cells = [Result(scene, "peer", seed, {"psnr": v, "lpips_vgg": MISSING}) for (scene, seed), v in BASE.items()]
    return cells + [Result(s, "ours", seed, {"psnr": v + gain, "lpips_vgg": MISSING}) for (s, seed), v in BASE.items()]


def test_differences_are_paired_by_scene_and_seed():
    """Scenes that differ by 10 dB and seeds by 1 hide nothing of a gain of 0.1 that is the same in every pair."""
    first, second = rows(cells_with_a_gain(0.1))
    assert (first.mean, first.difference, first.half_width) == pytest.approx((25.5, 0, 0))
    assert (second.difference, second.half_width, second.pairs) == pytest.approx((0.1, 0, 4), abs=1e-9)
    assert second.spread == pytest.approx(math.sqrt(0.5))


def test_differences_are_from_the_method_that_is_named():
    first, second = rows(cells_with_a_gain(0.1), against="ours")
    assert (first.difference, second.difference) == pytest.approx((-0.1, 0))


def test_the_interval_is_students():
    mean, half = mean_interval([1.0, 2.0, 3.0])
    assert mean == 2
    assert half == pytest.approx(4.302653 / math.sqrt(3))
    assert math.isnan(mean_interval([1.0])[1])


def test_what_is_missing_is_told_with_its_reason():
    cells = [*cells_with_a_gain(0.1), Result("a", "mast3r", 0, {}, "its weights are not here")]
    text = markdown(Table("t", "T", cells, columns("psnr", "lpips_vgg")))
    assert "| mast3r | not run |" in text
    assert "- a, mast3r: not run: its weights are not here" in text
    assert "- lpips_vgg of a, peer and 7 more: no weights" in text
    assert "LPIPS ↓" in text
    assert "SSIM" not in text
    assert "(`psnr`): dB" in text


def test_a_table_names_its_preset_wherever_one_has_a_say():
    cells = cells_with_a_gain(0.1)
    named = Table("t", "T", cells, columns("psnr"), preset="fast, changed by options")
    assert "2 scenes, 2 seeds, preset fast, changed by options." in markdown(named)
    assert latex(named).startswith("% T (preset fast, changed by options)")
    assert "preset" not in markdown(Table("t", "T", cells, columns("psnr")))


def test_a_table_of_methods_that_were_not_run_still_has_its_columns():
    text = markdown(Table("t", "T", [Result("a", "mast3r", 0, {}, "no weights")], columns("psnr")))
    assert "| method | cells | PSNR ↑ |" in text
    assert "| mast3r | not run | - |" in text


def test_a_mean_over_fewer_cells_says_so():
    cells = [*cells_with_a_gain(0.1), Result("c", "ours", 0, {"psnr": MISSING})]
    assert "(4)" in next(
        line for line in markdown(Table("t", "T", cells, columns("psnr"))).splitlines() if "| ours | 5" in line
    )


def test_latex_prints_the_best_of_each_column_in_bold():
    text = latex(Table("t", "T", cells_with_a_gain(0.1), columns("psnr", "lpips_vgg")))
    assert r"ours & \textbf{25.60} & -- \\" in text
    assert r"peer & 25.50 & -- \\" in text
    assert r"PSNR$\uparrow$" in text
    by_scene = text.split(r"\end{tabular}")[1]
    assert r" & \multicolumn{2}{c}{a} & \multicolumn{2}{c}{b} & \multicolumn{2}{c}{Average} \\" in by_scene
    assert r"peer & 20.50 & -- & 30.50 & -- & 25.50 & -- \\" in by_scene


def test_latex_prints_no_mean_over_easier_scenes_in_bold():
    """A method that fails on the hard scene is not the best for it."""
    cells = [Result("easy", "peer", 0, {"psnr": 30.0}), Result("hard", "peer", 0, {"psnr": 20.0})]
    cells += [Result("easy", "ours", 0, {"psnr": 29.0}), Result("hard", "ours", 0, {"psnr": NotComputed("lost")})]
    cells += [Result("easy", "third", 0, {"psnr": 28.0}), Result("hard", "third", 0, {"psnr": 19.0})]
    text = latex(Table("t", "T", cells, columns("psnr")))
    assert r"peer & \textbf{25.00} \\" in text
    assert r"ours & 29.00 (1) \\" in text
    by_scene = text.split(r"\end{tabular}")[1]
    assert r"peer & \textbf{30.00} & \textbf{20.00} & \textbf{25.00} \\" in by_scene
    assert r"ours & 29.00 & -- & 29.00 (1) \\" in by_scene


def test_csv_and_json_hold_every_cell(tmp_path: Path):
    write(tmp_path, Table("t", "T", cells_with_a_gain(0.1), columns("psnr")))
    lines = (tmp_path / "t.csv").read_text().splitlines()
    assert lines[0] == "scene,method,seed,psnr,lpips_vgg,not_run"
    assert lines[1] == "a,peer,0,20.0,,"
    assert len(lines) == 9
    document = json.loads((tmp_path / "t.json").read_text())
    assert document["cells"][0]["scores"] == {"psnr": 20.0, "lpips_vgg": None, "lpips_vgg_reason": "no weights"}
    assert document["variants"]["psnr"].startswith("dB")


def test_no_two_columns_share_a_name():
    assert len({c.score for c in COLUMNS}) == len(COLUMNS)
