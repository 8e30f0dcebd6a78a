"""Frames whose rows were exposed while the camera turned: drawn anew, found by all that follows, and led back from."""

import pickle
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
import torch

from swimm3r.cameras import Cameras
from swimm3r.errors import InputError
from swimm3r.imaging.rectification import Rectification
from swimm3r.imaging.turned_rows import RowTurns, at_half_time
from swimm3r.io import images
from swimm3r.pipeline import stages
from swimm3r.pipeline.presets import PRESETS
from swimm3r.progress import silent
from swimm3r.scene.frames import MASKS, Frame, Frames, write_index
from swimm3r.scene.ground_truth import GroundTruth
from swimm3r.sfm.rectified.frames import BentImagesError, TurnedRowsError, rectify_frames
from swimm3r.sfm.rectified.run import (
    AS_FILMED,
    RECTIFIED_ROWS,
    has_rectified_rows,
    is_rectified,
    run_frames,
    run_truth,
    run_turns,
    write_masks_as_filmed,
)
from swimm3r.tasks.settings import EngineSettings

WIDTH, HEIGHT = 80, 60
TURN = np.array([0.03, -0.02, 0.01])


def lens(width: int = WIDTH, height: int = HEIGHT) -> Cameras:
    K = torch.tensor([[[70.0, 0, width / 2], [0, 70, height / 2], [0, 0, 1]]], dtype=torch.float64)
    distortion = torch.tensor([[-0.05]], dtype=torch.float64)
    return Cameras(K, distortion, torch.eye(4, dtype=torch.float64)[None], width, height, "SIMPLE_RADIAL")


@pytest.fixture
def filmed(tmp_path: Path) -> Frames:
    """Three prepared frames of a run, the second held back, the third with a mask and a lens that its source states."""
    folder, rng = tmp_path / "run" / "prepare", np.random.default_rng(0)
    frames = []
    for i, split in enumerate(("train", "test", "train")):
        name = f"{i}.jpg"
        image = rng.integers(0, 256, (HEIGHT, WIDTH, 3), dtype=np.uint8)
        folder.mkdir(parents=True, exist_ok=True)
        cv2.imwrite(str(folder / name), image)
        frames.append(Frame(name, folder / name, float(i), 1.0, split))
    usable = np.ones((HEIGHT, WIDTH), bool)
    usable[:, :20] = False
    images.write_mask(folder / MASKS / "2.jpg.png", usable)
    frames[2] = replace(frames[2], mask=folder / MASKS / "2.jpg.png")
    (folder / "cameras.txt").write_text(f"1 PINHOLE {WIDTH} {HEIGHT} 70 70 40 30\n")
    out = Frames(tuple(frames), WIDTH, HEIGHT, ordered=True, calibration=folder / "cameras.txt")
    write_index(folder, out)
    return out


TURNS = RowTurns(lens(), {"0.jpg": TURN, "2.jpg": -TURN})


def test_later_stages_find_frames_with_rectified_rows(filmed: Frames, tmp_path: Path):
    run = tmp_path / "run"
    assert run_frames(run).names == filmed.names
    assert run_turns(run) is None
    made = rectify_frames(filmed, TURNS, run / RECTIFIED_ROWS)
    again = run_frames(run)
    assert again == made
    assert again.rows_rectified
    assert not filmed.rows_rectified
    assert again.train.rows_rectified
    assert again.names == ("0.png", "1.png", "2.png")
    assert [frame.split for frame in again] == ["train", "test", "train"]
    assert again.calibration is not None
    assert again.calibration.read_text() == (run / "prepare" / "cameras.txt").read_text()
    straight = at_half_time(images.read_rgb(filmed.frames[0].path), lens(), TURN)
    np.testing.assert_array_equal(images.read_rgb(again.frames[0].path), straight)
    as_filmed = images.read_rgb(filmed.frames[1].path)  # no turn of a test frame is known yet
    np.testing.assert_array_equal(images.read_rgb(again.frames[1].path), as_filmed)
    assert again.mask(1).all()
    assert 0.9 < again.mask(0).double().mean() < 1  # beyond what was filmed there is nothing
    assert again.mask(2).double().mean() == pytest.approx(0.72, abs=0.04)


def test_the_turns_are_read_back(filmed: Frames, tmp_path: Path):
    rectify_frames(filmed, TURNS, tmp_path / "run" / RECTIFIED_ROWS)
    stored = run_turns(tmp_path / "run")
    assert stored is not None
    assert {name: turn.tolist() for name, turn in stored.turns.items()} == {
        "0.png": TURN.tolist(),
        "2.png": (-TURN).tolist(),
    }
    torch.testing.assert_close(stored.lens.K, lens().K)
    torch.testing.assert_close(stored.lens.distortion, lens().distortion)
    assert (stored.lens.model, stored.lens.width, stored.lens.height) == ("SIMPLE_RADIAL", WIDTH, HEIGHT)
    assert stored.typical == pytest.approx(np.degrees(np.linalg.norm(TURN)))
    (tmp_path / "run" / RECTIFIED_ROWS / "turns.json").write_text("{")
    with pytest.raises(InputError, match=r"turns\.json"):
        run_turns(tmp_path / "run")


def test_frames_of_another_size_are_refused(filmed: Frames, tmp_path: Path):
    with pytest.raises(InputError, match="80x60"):
        rectify_frames(filmed, RowTurns(lens(160, 120), {}), tmp_path / "rows")
    assert not (tmp_path / "rows").exists()


def test_masks_lead_back_to_the_frames_as_filmed(filmed: Frames, tmp_path: Path):
    run = tmp_path / "run"
    with pytest.raises(ValueError, match="as filmed"):
        write_masks_as_filmed(filmed, run)
    rectify_frames(filmed, TURNS, run / RECTIFIED_ROWS)
    usable = np.ones((HEIGHT, WIDTH), bool)
    usable[4:20, 30:60] = False
    images.write_mask(run / "sfm" / MASKS / "0.png.png", usable)
    write_masks_as_filmed(filmed, run)
    back = images.read_mask(run / "sfm" / AS_FILMED / "0.jpg.png")
    assert 0 < (back != usable).mean() < 0.03  # a pixel or two along the border
    assert not (run / "sfm" / AS_FILMED / "1.jpg.png").exists()


def test_the_truth_has_the_frames_names(filmed: Frames, tmp_path: Path):
    run = tmp_path / "run"
    cameras = replace(lens(), K=lens().K)[[0] * 3]
    stated = GroundTruth(filmed.names, cameras, metric=False, folder=tmp_path)
    assert run_truth(run, filmed, stated) is stated
    rectify_frames(filmed, TURNS, run / RECTIFIED_ROWS)
    named = run_truth(run, filmed, stated)
    assert named is not None
    assert named.names == ("0.png", "1.png", "2.png")
    assert named.folder is None
    torch.testing.assert_close(named.cameras.cam2world, cameras.cam2world)


def test_the_error_goes_from_process_to_process():
    error = TurnedRowsError(TURNS)
    again = pickle.loads(pickle.dumps(error))
    assert str(again) == str(error)
    assert "2.1 degrees" in str(again)
    np.testing.assert_array_equal(again.rectification.turns["2.jpg"], -TURN)


@pytest.mark.parametrize("bent", [False, True])
def test_a_run_goes_on_with_rectified_rows(bent: bool, filmed: Frames, tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    """Structure from motion is made anew after each rectification, and once more where a killed run goes on."""
    run, seen = tmp_path / "run", []
    polynomial = replace(lens(), distortion=torch.zeros(1, 36, dtype=torch.float64), model="POLYNOMIAL")
    way = Rectification(polynomial, replace(lens(), distortion=torch.zeros(1, 0), model="PINHOLE"), torch.eye(3))
    monkeypatch.setattr(Rectification, "image", lambda self, image: image)
    monkeypatch.setattr(Rectification, "mask", lambda self, usable: usable)

    def reconstruct(frames, *arguments):
        seen.append((frames.names[0], frames.rows_rectified))
        if bent and not is_rectified(run):
            raise BentImagesError(way)
        if not frames.rows_rectified:
            raise TurnedRowsError(RowTurns(lens(), {frames.names[0]: TURN, frames.names[2]: -TURN}))

    monkeypatch.setattr(stages, "reconstruct", reconstruct)
    written = []
    monkeypatch.setattr(stages, "write_masks_as_filmed", lambda *arguments: written.append(arguments))
    stages._reconstruct(filmed, PRESETS["fast"], run, silent, EngineSettings(), None)
    assert seen == [("0.jpg", False), *[("0.png", False)] * bent, ("0.png", True)]
    assert has_rectified_rows(run)
    assert is_rectified(run) == bent
    assert len(written) == 1
    seen.clear()
    stages._reconstruct(filmed, PRESETS["fast"], run, silent, EngineSettings(), None)
    assert seen == [("0.png", True)]
