"""The ablation: what it trains, that it goes on, and that its statistics are right."""

import json
import math
from dataclasses import replace
from pathlib import Path

import pytest
import torch

from swimm3r import reconstruction
from swimm3r.bench.ablation import VARIANTS, ablate
from swimm3r.bench.statistics import Cell, mean_interval, rows, table, write_tables
from swimm3r.cameras import pixel_grid, unproject
from swimm3r.errors import InputError
from swimm3r.frame_settings import FrameSettings
from swimm3r.ground_truth import FOLDER, read_ground_truth
from swimm3r.prepare import read_frames
from swimm3r.presets import PRESETS, to_yaml
from swimm3r.reconstruction import DepthMap, DepthMaps, Matches, Points, Reconstruction, Tracks
from swimm3r.splat.settings import (
    DensifySettings,
    InitialSettings,
    MediumFieldSettings,
    PoseRefinementSettings,
    UwbsSettings,
)
from swimm3r.synthetic import write_dive
from swimm3r.synthetic.settings import DiveSettings


@pytest.fixture(scope="module")
def run(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A run folder of a small dive whose structure from motion is the truth."""
    folder = tmp_path_factory.mktemp("ablation")
    write_dive(DiveSettings(frames=9, width=96, height=64), folder / "dive")
    truth, out = read_ground_truth(folder / "dive" / FOLDER), folder / "run"
    frames = read_frames(folder / "dive", FrameSettings(), out / "prepare")
    names = frames.train.names
    rows_of = [truth.names.index(name) for name in names]
    cameras, depth, points, colours = truth.cameras[rows_of], DepthMaps(out / "sfm" / "z_depth"), [], []
    for k, name in enumerate(names):
        z = truth.z_depth(name)
        depth.write(name, DepthMap(z, (z > 0).float()))
        sample = torch.arange(0, z.numel(), 37)
        xyz = unproject(cameras[k], pixel_grid(64, 96).reshape(-1, 2)[None, sample], z.flatten()[None, sample])[0]
        points.append(xyz[z.flatten()[sample] > 0])
        colours.append(frames.train.image(k).reshape(-1, 3)[sample][z.flatten()[sample] > 0])
    xyz, none = torch.cat(points).double(), torch.zeros(0, dtype=torch.int64)
    rec = Reconstruction(
        names, cameras, Points(xyz, torch.cat(colours), torch.zeros(len(xyz), dtype=torch.float64)),
        Tracks(none, none, torch.zeros(0, 2, dtype=torch.float64)),
        Matches(none, none, torch.zeros(0, 2), torch.zeros(0, 2), torch.zeros(0)), depth, "truth", metric=True,
    )  # fmt: skip
    reconstruction.save(rec, out / "sfm")
    about = {"input": {"path": str(folder / "dive")}, "stages": {"sfm": {"status": "done", "key": "k"}}}
    (out / "summary.json").write_text(json.dumps(about))
    (out / "settings.yaml").write_text(to_yaml(PRESETS["fast"]))
    return out


TINY = UwbsSettings(
    iterations=8,
    long_side=48,
    initial=InitialSettings(primitives=200),
    densify=DensifySettings(max_primitives=220),
    medium=MediumFieldSettings(hidden=8),
)


QUICK = PoseRefinementSettings(steps=1, long_side=48)


def test_four_variants_are_trained_scored_and_not_made_again(run: Path, tmp_path: Path):
    cells = ablate([run], tmp_path, TINY, 2, QUICK)
    assert [(c.variant, c.seed) for c in cells] == [(v.name, seed) for seed in (0, 1) for v in VARIANTS]
    psnr = [c.scores["psnr"] for c in cells]
    assert len(set(psnr)) == 8
    assert all(5 < value < 60 for value in psnr)
    maps = {path: path.stat().st_mtime_ns for path in tmp_path.rglob("map.safetensors")}
    assert len(maps) == 8
    again = ablate([run], tmp_path, TINY, 2, QUICK)
    assert again == cells
    assert {path: path.stat().st_mtime_ns for path in tmp_path.rglob("map.safetensors")} == maps
    write_tables(tmp_path, cells)
    assert len((tmp_path / "ablation.csv").read_text().splitlines()) == 9
    document = json.loads((tmp_path / "ablation.json").read_text())
    assert {row["variant"] for row in document["rows"]} == {v.name for v in VARIANTS}
    assert "| psnr | + SGG |" in (tmp_path / "ablation.md").read_text()


def test_each_variant_lacks_exactly_its_parts():
    baseline, sgg, depth, full = (v.settings(TINY, 1) for v in VARIANTS)
    assert (baseline.sgg.enabled, baseline.weights.depth) == (False, 0)
    assert (sgg.sgg.enabled, sgg.weights.depth) == (True, 0)
    assert (depth.sgg.enabled, depth.weights.depth) == (False, TINY.weights.depth)
    assert replace(full, seed=TINY.seed) == TINY
    without = replace(TINY, sgg=replace(TINY.sgg, enabled=False))
    assert VARIANTS[3].settings(without, 0) == TINY
    assert baseline.seed == full.seed != VARIANTS[0].settings(TINY, 0).seed


def test_a_folder_without_structure_from_motion_is_refused(tmp_path: Path):
    with pytest.raises(InputError, match="no finished structure from motion"):
        ablate([tmp_path], tmp_path / "out", TINY, 1)


def test_differences_are_paired_by_run_and_seed():
    """Runs that differ by 10 dB and seeds by 1 hide nothing of a gain of 0.1 that is the same in every pair."""
    base = {("a", 0): 20.0, ("a", 1): 21.0, ("b", 0): 30.0, ("b", 1): 31.0}
    cells = [Cell(run, "baseline", seed, {"psnr": v, "lpips": None}) for (run, seed), v in base.items()]
    cells += [Cell(run, "full", seed, {"psnr": v + 0.1, "lpips": None}) for (run, seed), v in base.items()]
    first, second = rows(cells)
    assert (first.mean, first.difference, first.half_width) == pytest.approx((25.5, 0, 0))
    assert (second.difference, second.half_width) == pytest.approx((0.1, 0), abs=1e-9)
    assert second.spread == pytest.approx(math.sqrt(0.5))
    assert "lpips" not in table(cells)


def test_the_interval_is_students():
    mean, half = mean_interval([1.0, 2.0, 3.0])
    assert mean == 2
    assert half == pytest.approx(4.302653 / math.sqrt(3))
    assert math.isnan(mean_interval([1.0])[1])
