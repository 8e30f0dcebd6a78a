"""A protocol's name says what differs from the run's own, and fits a folder; test frames start where they are known."""

from dataclasses import replace
from pathlib import Path

import pytest
import torch
from tests.sfm.conftest import FlatDive, flat_dive

from swimm3r.errors import InputError
from swimm3r.medium import Medium
from swimm3r.pipeline.presets import RunSettings
from swimm3r.pipeline.scores.scoring import Protocol, start_poses
from swimm3r.progress import silent
from swimm3r.scene.frames import Frames
from swimm3r.scene.reconstruction import Reconstruction
from swimm3r.sfm import reconstruct
from swimm3r.sfm.backends import imported as imported_backend
from swimm3r.sfm.imported.model_poses import check_model_poses
from swimm3r.sfm.settings import ColmapModelSettings
from swimm3r.splat.settings import PoseRefinementSettings

Imported = tuple[Reconstruction, Frames, RunSettings]

OWN = Protocol(PoseRefinementSettings(steps=300, long_side=320))


def test_the_runs_own_protocol_has_no_name_beside_it():
    assert Protocol(PoseRefinementSettings(steps=300, long_side=320)).key_beside(OWN) == ""


def test_what_differs_is_named():
    fewer = replace(OWN, test=replace(OWN.test, steps=20))
    assert fewer.key_beside(OWN) == "steps-20"
    assert replace(OWN, test=replace(fewer.test, long_side=80)).key_beside(OWN) == "steps-20_long-side-80"


def test_references_of_one_name_are_told_apart():
    names = {
        Protocol(OWN.test, Path(folder) / "cameras.json").key_beside(OWN) for folder in ("a", "b", "../../c", "/d e")
    }
    assert len(names) == 4
    assert all(name.startswith("reference-cameras-") and "/" not in name for name in names)
    assert OWN.key_beside(Protocol(OWN.test, Path("a/cameras.json"))) == "no-reference"


@pytest.fixture
def posed(tmp_path: Path) -> FlatDive:
    return flat_dive(tmp_path, Medium(*torch.ones(3, 3) * 0.1), (1.0, 1.1, 1.2, 1.0, 1.1))


@pytest.fixture
def imported(posed: FlatDive, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Imported:
    """The second frame held back; the model has it, in a unit and axes of its own. RUN is `tmp_path`/run."""
    cameras, pose = posed.rec.cameras, posed.rec.cameras.cam2world.clone()
    pose[:, :3, 3] = 3 * pose[:, :3, 3] + torch.tensor([1.0, 2.0, 3.0])
    replace(cameras, cam2world=pose).save(tmp_path / "model.json", posed.rec.names)
    frames = replace(
        posed.frames,
        frames=tuple(replace(frame, split="test" if i == 1 else "train") for i, frame in enumerate(posed.frames)),
    )
    kept = [0, 2, 3, 4]
    rec = replace(posed.rec, names=tuple(posed.rec.names[i] for i in kept), cameras=cameras[kept])
    monkeypatch.setattr(imported_backend, "reconstruct", lambda *_: rec)
    settings = RunSettings(sfm=ColmapModelSettings(tmp_path / "model.json"))
    reconstruct(frames, settings.sfm, tmp_path / "run" / "sfm", silent)
    return rec, frames, settings


def check_start(posed: FlatDive, rec: Reconstruction, frames: Frames, settings: RunSettings, run: Path) -> None:
    (pose,) = start_poses(run, rec, frames, settings, None).values()
    assert pose.source == "reference"
    torch.testing.assert_close(pose.cam2world, posed.rec.cameras.cam2world[1])


def test_test_frames_of_imported_poses_are_placed_without_the_model(
    posed: FlatDive, imported: Imported, tmp_path: Path
):
    (tmp_path / "model.json").unlink()
    check_model_poses(tmp_path / "model.json", tmp_path / "run" / "sfm")
    check_start(posed, *imported, tmp_path / "run")


def test_a_run_of_an_earlier_version_reads_the_model_or_says_that_it_is_gone(
    posed: FlatDive, imported: Imported, tmp_path: Path
):
    (tmp_path / "run" / "sfm" / "cameras_imported.json").unlink()
    check_start(posed, *imported, tmp_path / "run")
    (tmp_path / "model.json").unlink()
    with pytest.raises(InputError, match=r"model\.json") as gone:
        start_poses(tmp_path / "run", *imported, None)
    assert "--reference" in gone.value.hint
