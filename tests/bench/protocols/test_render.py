"""Recipes on one reconstruction: one start for all, the block with refined poses, images side by side."""

import json
import shutil
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from tests.rig_scene import reconstruction as rig_reconstruction
from tests.rig_scene import stereo

from swimm3r.bench import map_scores, reference, tables
from swimm3r.bench.cells import Result
from swimm3r.bench.protocols import render
from swimm3r.bench.protocols.localization import maps_of
from swimm3r.bench.protocols.render import compare_renderers, settings_for
from swimm3r.bench.runs import clips_of, made_runs
from swimm3r.errors import InputError, UsageError
from swimm3r.evaluate import NotComputed
from swimm3r.io.images import read_rgb, write_rgb
from swimm3r.pipeline.finished_sfm import FinishedSfm, open_finished_sfm
from swimm3r.pipeline.presets import RunSettings
from swimm3r.pipeline.scores import held_out
from swimm3r.sfm.plane_sweep.settings import PlaneSweepSettings
from swimm3r.sfm.settings import ColmapSettings
from swimm3r.splat.settings import RECIPES, PoseRefinementSettings, UwbsSettings


@pytest.mark.long
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
    images = sorted((tmp_path / "images" / "dive").glob("*.png"))
    assert len(images) == 2
    assert read_rgb(images[0]).shape[0] == 2 * (240 + 22 + 4)
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

    def run_pipeline(source, folder, settings, *, redo, last_stage, progress):
        made.append((source, folder, last_stage))

    monkeypatch.setattr("swimm3r.bench.runs.run_pipeline", run_pipeline)
    clip = tmp_path / "dive.mp4"
    assert made_runs([run, clip], tmp_path, RunSettings()) == (run, tmp_path / "runs" / "dive")
    assert made == [(clip, tmp_path / "runs" / "dive", "sfm")]


def test_clips_in_folders_called_images_are_told_apart_and_two_of_one_name_are_refused(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
):
    monkeypatch.setattr("swimm3r.bench.runs.run_pipeline", lambda *_, **__: None)
    clips = [tmp_path / "reef" / "images", tmp_path / "wreck" / "images", tmp_path / "dive.1", tmp_path / "dive.2"]
    for clip in clips:
        clip.mkdir(parents=True)
    made = made_runs(clips, tmp_path, RunSettings())
    assert [run.name for run in made] == ["reef", "wreck", "dive.1", "dive.2"]
    with pytest.raises(InputError, match="two of the clips have one name: reef"):
        made_runs([*clips, tmp_path / "other" / "reef"], tmp_path, RunSettings())


def test_a_rig_of_several_lenses_has_no_reference_of_one_lens(tmp_path: Path):
    poses, frames = stereo(count=6)
    rec = rig_reconstruction(poses, frames)
    sides = torch.tensor([500.0, 650.0]).double().repeat(6)
    K = rec.cameras.K.clone()
    K[:, 0, 0] = K[:, 1, 1] = sides
    rec = replace(rec, cameras=replace(rec.cameras, K=K))
    found = reference.of_clip(FinishedSfm(tmp_path, frames, rec, RunSettings(), None, ""), tmp_path)
    assert isinstance(found, NotComputed)
    assert "different lenses" in found.reason


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
    with pytest.raises(InputError, match="no folder of images with their COLMAP model"):
        made_runs([run.parent / "dive"], tmp_path / "out", settings, given_poses=True)


def test_a_clip_that_cannot_be_placed_as_a_whole_is_remembered(run: Path, tmp_path: Path):
    sfm = open_finished_sfm(run)
    first, second = sfm.frames.frames[:2]
    elsewhere = tmp_path / second.path.name
    write_rgb(elsewhere, np.random.default_rng(0).random((sfm.frames.height, sfm.frames.width, 3)))
    few = replace(sfm.frames, frames=(first, replace(second, path=elsewhere)))
    found = reference.of_clip(replace(sfm, frames=few), tmp_path)
    assert isinstance(found, NotComputed)
    assert json.loads((tmp_path / "reference.json").read_text())["failed"] == found.reason
    assert reference.of_clip(replace(sfm, frames=few), tmp_path) == found


def test_turned_test_frames_are_not_placed_as_if_exposed_at_once(run: Path, tmp_path: Path):
    sfm = open_finished_sfm(run)
    turned = replace(sfm.frames, rows_rectified=True)
    found = reference.of_clip(replace(sfm, frames=turned), tmp_path)
    assert isinstance(found, NotComputed)
    assert "turned within exposures" in found.reason
    assert list(tmp_path.iterdir()) == []  # which takes no structure from motion to find out


@pytest.mark.parametrize(
    ("recipes", "seeds", "against"),
    [(("ubs",), 1, "uwbs-static"), ((), 1, None), (("ubs",), 0, None), (("ubs",), -1, None)],
)
def test_what_cannot_be_compared_is_refused_before_anything_is_trained(
    run: Path, tmp_path: Path, tiny: UwbsSettings, recipes: tuple, seeds: int, against: str | None
):
    with pytest.raises(UsageError):
        compare_renderers([run], tmp_path / "out", recipes, tiny, seeds, against=against)
    assert not (tmp_path / "out").exists()


def test_poses_that_somebody_else_found_take_the_references_place(
    run: Path, tmp_path: Path, tiny: UwbsSettings, quick: PoseRefinementSettings, monkeypatch: pytest.MonkeyPatch
):
    monkeypatch.setattr(reference, "of_clip", lambda *_: pytest.fail("they are given"))
    shutil.copy(run.parent / "dive" / "truth" / "cameras.json", tmp_path / "dive.json")
    table = compare_renderers([run], tmp_path / "out", ("ubs",), tiny, test=quick, references=tmp_path)
    assert table.cells[0].scores["from_reference_pct"] == 100
    (tmp_path / "dive.json").unlink()
    with pytest.raises(InputError, match="no reference poses of dive"):
        compare_renderers([run], tmp_path / "out", ("ubs",), tiny, test=quick, references=tmp_path)
    with pytest.raises(InputError, match="is no folder"):
        compare_renderers([run], tmp_path / "out", ("ubs",), tiny, test=quick, references=tmp_path / "none")


def test_weights_that_arrive_fill_the_scores_that_lacked_them(
    run: Path, tmp_path: Path, tiny: UwbsSettings, quick: PoseRefinementSettings, monkeypatch: pytest.MonkeyPatch
):
    monkeypatch.setenv("SWIMM3R_WEIGHTS_DIR", str(tmp_path / "weights"))
    monkeypatch.setenv("SWIMM3R_CACHE", str(tmp_path / "cache"))
    monkeypatch.setattr(reference, "of_clip", lambda *_: open_finished_sfm(run).truth)

    def compared() -> Result:
        return compare_renderers([run], tmp_path / "out", ("ubs",), tiny, test=quick).cells[0]

    trainings, train = [], map_scores.train
    monkeypatch.setattr(map_scores, "train", lambda *given: trainings.append(1) or train(*given))
    assert isinstance(compared().scores["lpips_vgg"], NotComputed)
    (tmp_path / "weights").mkdir()
    monkeypatch.setattr(render, "lpips_weights", lambda: ["trunk", "heads"])
    mean_scores = held_out.mean_scores
    monkeypatch.setattr(held_out, "mean_scores", lambda views: mean_scores(views) | {"lpips": 0.25})
    assert compared().scores["lpips_vgg"] == 0.25
    assert trainings == [1]
