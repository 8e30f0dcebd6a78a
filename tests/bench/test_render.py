"""Recipes on one reconstruction: one start for all, the block with refined poses, pictures side by side."""

import json
import shutil
from dataclasses import replace
from pathlib import Path

import pytest
import torch

from swimm3r import held_out
from swimm3r.bench import reference, tables
from swimm3r.bench.localisation import maps_of
from swimm3r.bench.render import compare_renderers, settings_for
from swimm3r.bench.runs import clips_of, made_runs
from swimm3r.errors import InputError
from swimm3r.evaluate import NotComputed
from swimm3r.io.images import read_rgb
from swimm3r.presets import RunSettings
from swimm3r.run import open_finished_sfm
from swimm3r.sfm.settings import ColmapSettings, PlaneSweepSettings
from swimm3r.splat.settings import RECIPES, PoseRefinementSettings, UwbsSettings


def test_every_recipe_starts_from_the_same_poses_of_the_whole_clip(
    run: Path, tmp_path: Path, tiny: UwbsSettings, quick: PoseRefinementSettings, monkeypatch: pytest.MonkeyPatch
):
    truth = open_finished_sfm(run).truth
    monkeypatch.setattr(reference, "of_clip", lambda *_: truth)
    starts, score_views = [], held_out.score_views

    def watched(scene, rec, frames, poses, *rest):
        starts.append(poses)
        return score_views(scene, rec, frames, poses, *rest)

    monkeypatch.setattr(held_out, "score_views", watched)
    held = replace(tiny, poses=replace(tiny.poses, enabled=False))
    table = compare_renderers([run], tmp_path, ("uwbs-static", "ubs", "threers_gs"), held, 1, True, quick)
    recipes = ("uwbs-static", "ubs", "threers_gs")
    assert [c.method for c in table.cells] == [f"truth{block} / {r}" for block in ("", " + poses") for r in recipes]
    assert len(starts) == 5  # 3R-GS refines poses of its own accord and is not trained twice
    assert table.cells[5].scores == table.cells[2].scores
    first, second = starts[:2]
    assert {name: pose.source for name, pose in first.items()} == dict.fromkeys(first, "reference")
    assert all((first[name].cam2world == second[name].cam2world).all() for name in first)
    for cell in table.cells:
        assert isinstance(cell.scores["psnr"], float)
        assert cell.scores["from_reference_pct"] == 100
        assert all(isinstance(cell.scores[name], float) for name in ("clear_psnr", "T_D_abs", "B_abs"))
    text = tables.write(tmp_path, table)
    assert "| psnr | truth + poses / ubs | truth + poses / uwbs-static |" in text
    pictures = sorted((tmp_path / "pictures" / "dive").glob("*.png"))
    assert len(pictures) == 2
    assert read_rgb(pictures[0]).shape[0] == 2 * (240 + 22 + 4)
    found = maps_of(clips_of([run])[0].runs[0], tmp_path)
    assert {m.method for m in found} == {c.method for c in table.cells[:5]}


def test_the_block_with_poses_refines_them_in_every_recipe(tiny: UwbsSettings):
    held = replace(tiny, poses=replace(tiny.poses, enabled=False))
    assert not settings_for(held, "ubs", False, 0).poses.enabled
    for recipe in RECIPES:
        refined = settings_for(held, recipe, True, 0)
        assert refined.poses.enabled
        hash(refined)  # by which a recipe that refines poses of its own accord is known
    assert settings_for(held, "uwbs-dynamic", True, 1).seed != held.seed


def test_clips_are_reconstructed_once_and_runs_are_taken_as_they_are(
    run: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
):
    made = []

    def run_pipeline(source, folder, settings, *, last_stage, progress):
        made.append((source, folder, last_stage))

    monkeypatch.setattr("swimm3r.bench.runs.run_pipeline", run_pipeline)
    clip = tmp_path / "dive.mp4"
    assert made_runs([run, clip], tmp_path, RunSettings()) == (run, tmp_path / "runs" / "dive")
    assert made == [(clip, tmp_path / "runs" / "dive", "sfm")]


def test_a_scene_with_a_model_lends_its_poses_where_asked(run: Path, tmp_path: Path):
    scene = tmp_path / "Curasao"
    shutil.copytree(run.parent / "dive" / "images", scene / "Images_wb")
    shutil.copytree(run / "sfm" / "sparse", scene / "sparse" / "0")
    quick_depth = PlaneSweepSettings(long_side=64, sources=1, rounds=1)
    settings = RunSettings(sfm=ColmapSettings(depth=quick_depth))
    (made,) = made_runs([scene], tmp_path / "out", settings, given_poses=True)
    (clip,) = clips_of([made])
    assert (clip.name, clip.runs[0].sfm) == ("Curasao", "COLMAP model (sparse)")
    sfm, known = clip.runs[0].open(), open_finished_sfm(run).rec
    assert sfm.rec.names == known.names
    torch.testing.assert_close(sfm.rec.cameras.cam2world, known.cameras.cam2world)
    with pytest.raises(InputError, match="no folder of pictures with their COLMAP model"):
        made_runs([run.parent / "dive"], tmp_path / "out", settings, given_poses=True)


def test_a_clip_that_cannot_be_placed_as_a_whole_is_remembered(run: Path, tmp_path: Path):
    sfm = open_finished_sfm(run)
    few = replace(sfm.frames, frames=sfm.frames.frames[:8:7])
    found = reference.of_clip(replace(sfm, frames=few), tmp_path)
    assert isinstance(found, NotComputed)
    assert json.loads((tmp_path / "reference.json").read_text())["failed"] == found.reason
    assert reference.of_clip(replace(sfm, frames=few), tmp_path) == found
