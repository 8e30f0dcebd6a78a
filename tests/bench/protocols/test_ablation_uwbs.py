"""The ablation: what it trains, and that what is there is not made again."""

import json
from dataclasses import replace
from pathlib import Path

import pytest

from swimm3r.bench import tables
from swimm3r.bench.protocols.ablation_uwbs import VARIANTS, ablate
from swimm3r.errors import InputError
from swimm3r.evaluate import NotComputed
from swimm3r.splat.settings import PoseRefinementSettings, UwbsSettings


@pytest.mark.long
def test_four_variants_are_trained_scored_and_not_made_again(
    run: Path, tmp_path: Path, tiny: UwbsSettings, quick: PoseRefinementSettings
):
    table = ablate([run], tmp_path, tiny, 2, quick)
    cells = list(table.cells)
    assert [(c.method, c.seed) for c in cells] == [(v.name, seed) for seed in (0, 1) for v in VARIANTS]
    psnr = [c.scores["psnr"] for c in cells]
    assert len(set(psnr)) == 8
    assert all(isinstance(value, float) and 5 < value < 60 for value in psnr)
    assert all(isinstance(c.scores["clear_psnr"], float) for c in cells)
    assert isinstance(cells[0].scores["lpips_vgg"], NotComputed)  # its weights are not ours to bring
    maps = {path: path.stat().st_mtime_ns for path in tmp_path.rglob("map.safetensors")}
    assert len(maps) == 8
    of_an_earlier_version = tmp_path / "run" / "plus-SGG" / "1" / "scores.json"
    of_an_earlier_version.write_text(json.dumps({"key": "another", "scores": {"psnr": 0.0}}))
    assert list(ablate([run], tmp_path, tiny, 2, quick).cells) == cells
    assert {path: path.stat().st_mtime_ns for path in tmp_path.rglob("map.safetensors")} == maps
    tables.write(tmp_path, table)
    assert len((tmp_path / "ablation.csv").read_text().splitlines()) == 9
    document = json.loads((tmp_path / "ablation.json").read_text())
    assert {row["method"] for row in document["rows"]} == {v.name for v in VARIANTS}
    assert "| psnr | + SGG |" in (tmp_path / "ablation.md").read_text()


def test_each_variant_lacks_exactly_its_parts(tiny: UwbsSettings):
    baseline, sgg, depth, full = (v.settings(tiny, 1) for v in VARIANTS)
    assert (baseline.sgg.enabled, baseline.weights.depth) == (False, 0)
    assert (sgg.sgg.enabled, sgg.weights.depth) == (True, 0)
    assert (depth.sgg.enabled, depth.weights.depth) == (False, tiny.weights.depth)
    assert replace(full, seed=tiny.seed) == tiny
    without = replace(tiny, sgg=replace(tiny.sgg, enabled=False))
    assert VARIANTS[3].settings(without, 0) == tiny
    assert baseline.seed == full.seed != VARIANTS[0].settings(tiny, 0).seed


def test_another_folder_is_refused(tmp_path: Path, tiny: UwbsSettings):
    with pytest.raises(InputError, match="is no run folder"):
        ablate([tmp_path], tmp_path / "out", tiny, 1)
