"""Files that settings name belong to what a stage was made from: by their content, where they are on this computer."""

import json
import os
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch

from swimm3r.errors import UsageError
from swimm3r.io import images
from swimm3r.pipeline.presets import MAST3R_PRESETS, PRESETS, RunSettings
from swimm3r.pipeline.run import run_pipeline
from swimm3r.pipeline.run_record import open_record
from swimm3r.pipeline.stage_keys import StageKey, stage_keys
from swimm3r.progress import silent
from swimm3r.scene.run_folder import STAGES, StageRecord, read_run
from swimm3r.selftest.scenes import turned_camera
from swimm3r.sfm.settings import ColmapModelSettings

FAST = PRESETS["fast"]


def record_of(key: StageKey) -> StageRecord:
    return StageRecord("done", key.key, files=dict(key.files))


def changed(before: dict[str, StageKey], after: dict[str, StageKey]) -> list[str]:
    """The stages that are to be made again."""
    return [stage for stage in STAGES if not after[stage].is_of(record_of(before[stage]))]


def later_stages(stage: str) -> list[str]:
    return list(STAGES[STAGES.index(stage) :])


@pytest.mark.parametrize(
    ("stage", "settings"),
    [
        ("prepare", lambda path: replace(FAST, frames=replace(FAST.frames, rig_calibration=path))),
        ("sfm", lambda path: replace(FAST, sfm=replace(MAST3R_PRESETS["default"], adapter=path))),
        ("sfm", lambda path: replace(FAST, sfm=replace(FAST.sfm, calibration=path))),
        ("sfm", lambda path: replace(FAST, sfm=ColmapModelSettings(path))),
        ("sfm", lambda path: replace(FAST, scale=replace(FAST.scale, nav=path))),
    ],
    ids=["rig calibration", "adapter", "calibration", "model", "navigation of mapping"],
)
def test_another_content_of_a_file_is_another_key_of_its_stage_and_those_after_it(stage: str, settings, tmp_path: Path):
    path = tmp_path / "file"
    path.write_text("one")
    before = stage_keys("f", settings(path), None)
    os.utime(path, (0, 0))  # the time of a copy
    assert changed(before, stage_keys("f", settings(path), None)) == []
    path.write_text("two")
    assert changed(before, stage_keys("f", settings(path), None)) == later_stages(stage)


def test_an_edited_reference_is_another_key_of_the_scores(tmp_path: Path):
    path = tmp_path / "cameras.json"
    path.write_text("one")
    before = stage_keys("f", FAST, path)
    path.write_text("two")
    assert changed(before, stage_keys("f", FAST, path)) == ["eval"]


def test_of_a_folder_with_a_model_only_the_model_counts(tmp_path: Path):
    model = tmp_path / "sparse" / "0"
    model.mkdir(parents=True)
    for name in ("cameras", "images", "points3D"):
        (model / f"{name}.bin").write_text(name)
    settings = RunSettings(sfm=ColmapModelSettings(tmp_path))
    before = stage_keys("f", settings, None)
    (tmp_path / "database.db").write_text("COLMAP's own")
    assert changed(before, stage_keys("f", settings, None)) == []
    (model / "images.bin").write_text("others")
    assert changed(before, stage_keys("f", settings, None)) == later_stages("sfm")


def test_a_lens_from_another_run_is_known_by_the_lens(tmp_path: Path):
    settings, camera = RunSettings(sfm=replace(FAST.sfm, lens_from=tmp_path)), turned_camera()
    camera.save(tmp_path / "sfm" / "cameras.json", ("a.png",))
    before = stage_keys("f", settings, None)
    assert before["sfm"].files.keys() == {"sfm.lens_from"}
    pose = camera.cam2world.clone()
    pose[:, :3, 3] *= 2  # as where that run was given metres
    replace(camera, cam2world=pose).save(tmp_path / "sfm" / "cameras.json", ("a.png",))
    assert changed(before, stage_keys("f", settings, None)) == []
    replace(camera, K=camera.K * torch.tensor([[1.01], [1.01], [1]])).save(
        tmp_path / "sfm" / "cameras.json", ("a.png",)
    )
    assert changed(before, stage_keys("f", settings, None)) == later_stages("sfm")


def test_a_folder_for_results_that_runs_share_is_no_input(tmp_path: Path):
    settings = RunSettings(sfm=replace(MAST3R_PRESETS["default"], cache=tmp_path))
    assert stage_keys("f", settings, None)["eval"].files == {}


@pytest.fixture
def clip(tmp_path: Path) -> Path:
    rng = np.random.default_rng(0)
    for i in range(3):
        images.write_rgb(tmp_path / "clip" / f"{i}.png", rng.random((48, 64, 3)))
    return tmp_path / "clip"


@pytest.fixture
def masked(tmp_path: Path) -> RunSettings:
    """The settings of a run with a mask of the first frame, in a folder of its own."""
    images.write_mask(tmp_path / "masks" / "0.png", np.ones((48, 64), bool))
    return replace(FAST, frames=replace(FAST.frames, masks=tmp_path / "masks"))


def prepare(clip: Path, settings: RunSettings | None, redo: bool = False) -> dict:
    return run_pipeline(
        clip, clip.parent / "run", settings, last_stage="prepare", redo=redo, progress=silent
    )["stages"]["prepare"]  # fmt: skip


def correct_mask(tmp_path: Path) -> None:
    images.write_mask(tmp_path / "masks" / "0.png", np.arange(48 * 64).reshape(48, 64) > 500)


def test_corrected_masks_are_refused_by_name_and_used_with_redo(clip: Path, masked: RunSettings, tmp_path: Path):
    before = prepare(clip, masked)
    correct_mask(tmp_path)
    for settings in (masked, None):
        with pytest.raises(UsageError, match=r"changed since \(prepare\):\n    frames.masks: .*masks") as refused:
            prepare(clip, settings)
        assert "--redo" in refused.value.hint
    after = prepare(clip, masked, redo=True)
    assert before["files"].keys() == after["files"].keys() == {"frames.masks"}
    assert before["files"] != after["files"]
    assert (images.read_mask(next((tmp_path / "run" / "prepare" / "masks").iterdir())) == 0).sum() == 501
    assert prepare(clip, None) == after


def test_files_that_are_not_on_this_computer_count_as_they_were(clip: Path, masked: RunSettings, tmp_path: Path):
    before = prepare(clip, masked)
    (tmp_path / "masks").rename(tmp_path / "elsewhere")
    assert prepare(clip, None) == before
    (tmp_path / "elsewhere").rename(tmp_path / "masks")
    correct_mask(tmp_path)
    with pytest.raises(UsageError, match="changed since"):
        prepare(clip, None)


def test_a_run_made_before_files_counted_stays_finished_and_knows_them_from_then_on(
    clip: Path, masked: RunSettings, tmp_path: Path
):
    made = prepare(clip, masked)
    summary = tmp_path / "run" / "summary.json"
    document = json.loads(summary.read_text())
    del document["stages"]["prepare"]["files"]
    summary.write_text(json.dumps(document))
    assert prepare(clip, masked) == made
    assert read_run(tmp_path / "run").stages["prepare"].files == made["files"]
    correct_mask(tmp_path)
    with pytest.raises(UsageError, match="changed since"):
        prepare(clip, masked)


def test_another_file_in_a_setting_is_told_once(clip: Path, masked: RunSettings, tmp_path: Path):
    prepare(clip, masked)
    images.write_mask(tmp_path / "others" / "0.png", np.zeros((48, 64), bool))
    other = replace(masked, frames=replace(masked.frames, masks=tmp_path / "others"))
    with pytest.raises(UsageError, match=r"frames.masks: .*masks -> .*others\n") as refused:
        prepare(clip, other)
    assert "has changed" not in refused.value.what


def test_a_stage_made_where_a_file_is_missing_keeps_what_was_known_of_it(tmp_path: Path):
    (tmp_path / "run").mkdir()
    with open_record(tmp_path / "run", Path("dive.mp4"), "none") as record:
        record.stage("splat", StageKey("key", {"sfm.adapter": "a"}), make=lambda: None)
        record.stage("splat", StageKey("key"), make=lambda: None)
        assert record.summary["stages"]["splat"]["files"] == {"sfm.adapter": "a"}
