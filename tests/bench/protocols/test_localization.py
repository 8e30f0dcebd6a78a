"""Localization as a table: exact answers score full marks, lost frames are failures, runs of a clip are rows."""

import json
import shutil
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
import torch

from swimm3r.bench.protocols import localization
from swimm3r.bench.protocols.localization import localization_scores, localize, pose_scores
from swimm3r.bench.runs import SfmRun, clips_of
from swimm3r.errors import InputError, RegistrationError
from swimm3r.evaluate import NotComputed
from swimm3r.geometry import pose_from, so3_exp
from swimm3r.io.images import write_rgb
from swimm3r.localization.batch import Answer
from swimm3r.localization.localizer import Localization, Localizer
from swimm3r.localization.settings import LocalizationSettings
from swimm3r.pipeline.finished_sfm import open_finished_sfm
from swimm3r.scene.frame_changes import MovingMasks
from swimm3r.sfm.colmap import poses as colmap
from swimm3r.splat import train
from swimm3r.splat.settings import UwbsSettings


def answered(name: str, pose: torch.Tensor | None) -> Answer:
    if pose is None:
        return Answer(name, 0.0, None, "lost")
    seconds = {"retrieve": 0.1, "coarse": 0.1, "render": 0.1, "match": 0.1, "refine": 0.1}
    return Answer(name, 0.0, Localization(pose, "refined", (), 20, 30, 40, 0.5, None, seconds))


def test_exact_answers_score_full_marks_and_lost_frames_fail_their_pairs(run: Path):
    sfm = open_finished_sfm(run)
    truth = sfm.truth
    assert truth is not None
    queries = sfm.frames.test.names
    exact = {name: truth.cameras.cam2world[truth.names.index(name)] for name in queries}
    scores = pose_scores(sfm.rec, [answered(name, pose) for name, pose in exact.items()], truth)
    assert {scores[name] for name in scores if name.startswith(("rra", "rta"))} == {100.0}
    assert scores["rotation_median_deg"] == pytest.approx(0, abs=1e-4)
    assert scores["position_median_pct"] == pytest.approx(0, abs=1e-4)

    one_lost = [answered(queries[0], exact[queries[0]]), answered(queries[1], None)]
    scores = pose_scores(sfm.rec, one_lost, truth)
    assert scores["rra2_map"] == pytest.approx(50)
    assert scores["rra15_queries"] == 0
    assert localization_scores(one_lost)["located_pct"] == 50
    assert localization_scores(one_lost)["inlier_5px_pct"] == pytest.approx(37.5)
    assert localization_scores(one_lost)["fps_localize"] == pytest.approx(2)


def test_the_reference_may_lie_elsewhere_at_another_scale(run: Path):
    sfm = open_finished_sfm(run)
    truth = sfm.truth
    assert truth is not None
    turn = so3_exp(torch.tensor([0.3, -0.2, 0.9], dtype=torch.float64))
    poses = truth.cameras.cam2world.double()
    moved = pose_from(turn @ poses[:, :3, :3], 7 * (turn @ poses[:, :3, 3, None])[..., 0] + 5)
    elsewhere = replace(truth, cameras=replace(truth.cameras, cam2world=moved))
    off = so3_exp(torch.tensor([0.0, 0.0, 0.1], dtype=torch.float64))
    answers = []
    for name in sfm.frames.test.names:
        pose = poses[truth.names.index(name)].clone()
        pose[:3, :3] = pose[:3, :3] @ off
        answers.append(answered(name, pose))
    scores = pose_scores(sfm.rec, answers, elsewhere)
    assert scores["rotation_median_deg"] == pytest.approx(5.7296, abs=1e-3)
    assert scores["rra2_map"] == 0
    assert scores["rra15_map"] == 100


def test_without_a_reference_poses_are_not_scored(run: Path):
    scores = pose_scores(
        open_finished_sfm(run).rec, [answered("x", torch.eye(4).double())], NotComputed("nobody knows")
    )
    assert set(scores.values()) == {NotComputed("nobody knows")}


@pytest.mark.long
def test_runs_of_one_clip_are_rows_and_their_reference_is_made_once(
    run: Path, tmp_path: Path, tiny: UwbsSettings, monkeypatch: pytest.MonkeyPatch
):
    sfm = open_finished_sfm(run)
    truth = sfm.truth
    assert truth is not None
    runs = [tmp_path / "first", tmp_path / "second"]
    for folder in runs:
        shutil.copytree(run, folder)
        train(sfm.rec, sfm.frames, tiny, folder / "splat")
    made = []

    def all_frames(frames, settings, folder, progress, lens):
        assert (lens.K == sfm.rec.cameras[0].K).all()
        made.append((settings.mapping.method, frames.names, {f.split for f in frames}))
        order = [truth.names.index(name) for name in frames.names]
        return replace(sfm.rec, names=frames.names, cameras=truth.cameras[order])

    monkeypatch.setattr(colmap, "reconstruct", all_frames)
    table = localize(runs, tmp_path / "out", LocalizationSettings(matcher="sift"))
    assert made == [("auto", sfm.frames.names, {"train"})]
    assert [(c.scene, c.method) for c in table.cells] == [
        ("dive", "truth (first) / uwbs-static"),
        ("dive", "truth (second) / uwbs-static"),
    ]
    for cell in table.cells:
        assert isinstance(cell.scores["located_pct"], float)
        assert isinstance(cell.scores["peak_mb"], float | NotComputed)
        assert isinstance(cell.scores["rra2_map"], float)
    assert localize(runs, tmp_path / "out", LocalizationSettings(matcher="sift")).cells == table.cells
    assert len(made) == 1


def test_maps_are_searched_in_the_frames_that_localize_takes_without_what_moves(
    run: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
):
    sfm, given = open_finished_sfm(run), []
    name, masks = sfm.rec.names[0], MovingMasks(tmp_path / "masks")
    write_rgb(masks.path(name), np.zeros((sfm.frames.height, sfm.frames.width, 3)))
    moving = replace(sfm, rec=replace(sfm.rec, moving=masks))

    class Watched(Localizer):
        def __init__(self, scene, rec, frames, settings):
            given.append(frames)
            raise RegistrationError("enough was seen", cause="", hint="")

    monkeypatch.setattr(localization, "load_map", lambda path: SimpleNamespace(to=lambda device: path))
    monkeypatch.setattr(localization, "Localizer", Watched)
    monkeypatch.setattr(SfmRun, "open", lambda self: moving)
    (mapped,) = clips_of([run])[0].runs
    with pytest.raises(RegistrationError, match="enough was seen"):
        localization._scores(tmp_path, run=mapped, path=run, truth=NotComputed("none"), settings=LocalizationSettings())
    assert not given[0].mask(given[0].index(name)).any()
    assert given[0].mask(given[0].index(sfm.rec.names[1])).all()


def test_runs_with_other_frames_do_not_compare(run: Path, tmp_path: Path):
    other = tmp_path / "other"
    shutil.copytree(run, other)
    summary = json.loads((other / "summary.json").read_text())
    summary["stages"]["prepare"]["key"] = "another"
    (other / "summary.json").write_text(json.dumps(summary))
    with pytest.raises(InputError, match="took different frames"):
        clips_of([run, other])


def test_a_run_without_a_map_is_refused(run: Path, tmp_path: Path):
    with pytest.raises(InputError, match="there is no map"):
        localize([run], tmp_path)
