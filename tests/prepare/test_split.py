"""Keyframes follow the camera's motion; frames that hold a chain together are not held back for testing."""

from pathlib import Path

import cv2
import numpy as np
import pytest

from swimm3r.prepare import read_frames
from swimm3r.prepare.keyframes import choose_keyframes, displacement
from swimm3r.prepare.split import shift, split_frames
from swimm3r.progress import silent
from swimm3r.scene.settings import FrameSettings

HEIGHT, WIDTH = 180, 320


@pytest.fixture(scope="module")
def ground() -> np.ndarray:
    rng = np.random.default_rng(0)
    total = np.zeros((600, 4000), np.float32)
    for cells in (20, 60, 150, 300):
        total += cv2.resize(rng.random((cells, 7 * cells), np.float32), (4000, 600), interpolation=cv2.INTER_CUBIC)
    return (255 * (total - total.min()) / np.ptp(total)).astype(np.uint8)


def view(ground: np.ndarray, x: float) -> np.ndarray:
    """The image of a camera that has moved by so many pixels."""
    M = np.array([[1, 0, -x], [0, 1, -200]], np.float32)
    return cv2.warpAffine(ground, M, (WIDTH, HEIGHT))


def test_the_shift_of_two_views_is_measured_up_to_a_third_of_the_image(ground: np.ndarray) -> None:
    for moved in (5.0, 60.0, 100.0):
        found = shift(view(ground, 0), view(ground, moved))
        assert found is not None
        np.testing.assert_allclose(np.abs(found), [moved, 0], atol=1)
    assert shift(view(ground, 0), view(ground, 1500)) is None


def test_displacement_is_a_share_of_the_longer_side(ground: np.ndarray) -> None:
    assert displacement(view(ground, 0), view(ground, 8)) == pytest.approx(8 / WIDTH, rel=0.05)
    assert displacement(view(ground, 0), view(ground, 2000)) is None
    assert displacement(np.zeros((HEIGHT, WIDTH), np.uint8), view(ground, 0)) is None


@pytest.mark.parametrize("step", [1.0, 2.0, 4.0])
def test_the_number_of_keyframes_follows_the_ground_and_not_the_rate(ground: np.ndarray, step: float) -> None:
    count = int(400 / step) + 1
    chosen = choose_keyframes(count, lambda i: view(ground, i * step), [1.0] * count, 0.04)
    assert chosen[0] == 0
    assert chosen[-1] == count - 1
    steps = np.diff(chosen)[:-1] * step
    assert steps.max() <= 0.04 * WIDTH + 1
    assert len(chosen) == pytest.approx(400 / (0.04 * WIDTH), rel=0.4)


def test_of_the_frames_that_would_do_the_sharpest_is_taken(ground: np.ndarray) -> None:
    sharpness = [1.0 + (i % 5 == 0) for i in range(101)]
    chosen = choose_keyframes(101, lambda i: view(ground, 2.0 * i), sharpness, 0.04)
    assert np.mean([sharpness[i] == 2 for i in chosen]) > 0.6


def test_a_fast_camera_makes_every_frame_a_keyframe(ground: np.ndarray) -> None:
    assert choose_keyframes(20, lambda i: view(ground, 40.0 * i), [1.0] * 20, 0.04) == list(range(20))


def test_every_8th_frame_is_held_back_where_its_neighbors_overlap(ground: np.ndarray) -> None:
    parts = split_frames(lambda i: view(ground, 30.0 * i), [1.0] * 30, FrameSettings(), silent, ordered=True)
    assert [i for i, part in enumerate(parts) if part == "test"] == [0, 8, 16, 24]
    assert "between" not in parts


def test_a_chain_of_stills_that_overlap_little_keeps_its_frames(ground: np.ndarray) -> None:
    parts = split_frames(lambda i: view(ground, 95.0 * i), [1.0] * 30, FrameSettings(), silent, ordered=True)
    assert [i for i, part in enumerate(parts) if part == "test"] == [0]
    unordered = split_frames(lambda i: view(ground, 95.0 * i), [1.0] * 30, FrameSettings(), silent, ordered=False)
    assert unordered.count("test") == 4


def test_a_dense_folder_is_split_into_keyframes_and_frames_between(ground: np.ndarray, tmp_path: Path) -> None:
    (tmp_path / "dive").mkdir()
    for i in range(60):
        cv2.imwrite(str(tmp_path / "dive" / f"{i:04d}.png"), view(ground, 3.0 * i))
    settings = FrameSettings(every_frame_to=20)
    frames = read_frames(tmp_path / "dive", settings, tmp_path / "prepare")
    assert len(frames) == 60 == len(frames.train) + len(frames.test) + len(frames.between)
    assert 12 <= len(frames.train) + len(frames.test) <= 30
    assert len(frames.test) == -(-(len(frames.train) + len(frames.test)) // 8)
    every = read_frames(tmp_path / "dive", FrameSettings(), tmp_path / "every")
    assert not len(every.between)
