"""Keyframes of a camera that turns: the gyroscope takes rotation out of the motion, if it is that of the images."""

from collections.abc import Callable
from functools import partial
from pathlib import Path

import cv2
import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation

from swimm3r.cameras import Cameras, project, resized
from swimm3r.io.images import write_rgb
from swimm3r.io.telemetry.gyroscope import Gyroscope, gyroscope_of
from swimm3r.io.video import Video
from swimm3r.prepare import frames_folder
from swimm3r.prepare.candidates import SelectedImages, SourceImage
from swimm3r.prepare.keyframes import choose_keyframes
from swimm3r.prepare.rotation import RotationMotion, rotation_motion
from swimm3r.prepare.split import split_frames
from swimm3r.progress import silent
from swimm3r.scene.settings import FrameSettings

WIDTH, HEIGHT, FOCAL = 320, 200, 260.0
FPS, COUNT, RATE = 10.0, 120, 200.0
HALF = COUNT // 2  # the camera only turns in the first half, and moves along, too, in the second
DISTANCE = 2.0
K = np.array([[FOCAL, 0, WIDTH / 2], [0, FOCAL, HEIGHT / 2], [0, 0, 1]])
TIMES = (np.arange(COUNT) / FPS).tolist()


def fisheye() -> Cameras:
    return calibrated((0.02, -0.01, 0.004, -0.001), "OPENCV_FISHEYE")


def calibrated(distortion: tuple[float, ...] = (), model: str = "PINHOLE") -> Cameras:
    k = torch.tensor([distortion], dtype=torch.float64)
    return Cameras(torch.from_numpy(K)[None], k, torch.eye(4, dtype=torch.float64)[None], WIDTH, HEIGHT, model)


@pytest.fixture(scope="module")
def wall() -> np.ndarray:
    """A wall at `DISTANCE`, a hundred pixels per unit."""
    rng = np.random.default_rng(0)
    total = np.zeros((700, 1100), np.float32)
    for cells in (20, 60, 150, 300):
        total += cv2.resize(rng.random((cells, 2 * cells), np.float32), (1100, 700), interpolation=cv2.INTER_CUBIC)
    return (255 * (total - total.min()) / np.ptp(total)).astype(np.uint8)


def angles(t: float) -> tuple[float, float, float]:
    """Yaw, pitch and roll of unsteady hands."""
    yaw = 0.16 * np.sin(2.1 * t) + 0.03 * np.sin(9 * t)
    return yaw, 0.05 * np.sin(3.3 * t) + 0.02 * np.sin(11 * t), 0.04 * np.sin(1.7 * t)


def attitude(t: float) -> Rotation:
    """Rotation from the camera's axes to the world's."""
    return Rotation.from_euler("YXZ", angles(t))


def view(wall: np.ndarray, i: int, sway: float = 0.0) -> np.ndarray:
    """The image of a frame; a share `sway` of the motion by rotation is undone by moving aside."""
    yaw, pitch, _ = angles(TIMES[i])
    center = np.array([0.03 * max(0, i - HALF) - sway * DISTANCE * yaw, sway * DISTANCE * pitch, 0])
    R = attitude(TIMES[i]).as_matrix().T
    onto = np.stack([R[:, 0] / 100, R[:, 1] / 100, R @ (np.array([-4.0, -3.5, DISTANCE]) - center)], 1)
    return cv2.warpPerspective(wall, K @ onto, (WIDTH, HEIGHT))


def gyroscope(late: float = 0.0) -> Gyroscope:
    """Exact rates between samples; those of a sensor that is late stand later in the file."""
    at = np.arange(-0.5, COUNT / FPS + 0.5, 1 / RATE)
    steps = [(attitude(t).inv() * attitude(t + 1 / RATE)).as_rotvec() for t in at]
    return Gyroscope(at + late, RATE * np.array(steps))


@pytest.fixture(scope="module")
def views(wall: np.ndarray) -> Callable[[int], np.ndarray]:
    return [view(wall, i) for i in range(COUNT)].__getitem__


def test_rates_add_up_to_the_rotation_between_two_times():
    found = gyroscope().turn(1.2, 7.83)
    np.testing.assert_allclose(found, (attitude(1.2).inv() * attitude(7.83)).as_matrix(), atol=2e-4)


@pytest.mark.parametrize("late", [0.0, 0.1])
def test_the_focal_length_and_the_delay_follow_from_the_images(views: Callable[[int], np.ndarray], late: float):
    motion = rotation_motion(gyroscope(late), TIMES, views)
    assert motion is not None
    assert float(motion.lens.K[0, 0, 0]) == pytest.approx(FOCAL, rel=0.03)
    assert motion.delay == pytest.approx(late, abs=0.026)


@pytest.mark.parametrize("lens", [calibrated(), calibrated((0.36, 0.25, 0, 0), "OPENCV"), fisheye()])
def test_points_move_as_those_far_away_do(lens: Cameras):
    motion = RotationMotion(gyroscope(), tuple(TIMES), lens, 0.0)
    far = attitude(TIMES[3]).apply([[0.3, -0.2, 1.0]])
    seen = [torch.from_numpy(attitude(TIMES[i]).inv().apply(far))[None] for i in (3, 9)]
    here, there = (project(lens, xyz)[0][0].numpy() - 0.5 for xyz in seen)
    np.testing.assert_allclose(motion.moved(3, 9, here), there, atol=0.2)


@pytest.mark.long
def test_a_camera_that_only_turns_needs_few_keyframes_and_one_that_moves_as_many_as_before(
    views: Callable[[int], np.ndarray],
):
    motion = rotation_motion(gyroscope(), TIMES, views)
    assert motion is not None
    sharp = [1.0] * COUNT
    plain = choose_keyframes(COUNT, views, sharp, 0.04)
    chosen = choose_keyframes(COUNT, views, sharp, 0.04, rotated=motion.moved)
    assert sum(i < HALF for i in plain) > 25
    assert sum(i < HALF for i in chosen) <= 8
    steps = np.diff([i for i in chosen if i >= HALF])
    travel = 0.04 * WIDTH / FOCAL * DISTANCE / 0.03  # frames in which parallax makes up the wanted motion
    assert steps.max() <= travel + 1
    assert np.median(steps) >= 0.6 * travel


def test_a_gyroscope_of_something_else_is_not_used(views: Callable[[int], np.ndarray]):
    rng = np.random.default_rng(0)
    true = gyroscope()
    other = Gyroscope(true.time, np.roll(true.rate, len(true.time) // 3, axis=0)[:, [2, 0, 1]])
    noise = Gyroscope(true.time, rng.normal(size=true.rate.shape))
    assert rotation_motion(other, TIMES, views) is None
    assert rotation_motion(noise, TIMES, views) is None
    assert rotation_motion(noise, TIMES, views, calibrated()) is None


@pytest.mark.long
def test_a_camera_that_sways_as_it_turns_does_not_tell_its_focal_length(wall: np.ndarray):
    swaying = [view(wall, i, sway=0.7) for i in range(COUNT)]
    assert rotation_motion(gyroscope(), TIMES, swaying.__getitem__) is None
    larger = resized(calibrated(), 4 * WIDTH, 4 * HEIGHT)
    motion = rotation_motion(gyroscope(0.1), TIMES, swaying.__getitem__, larger)
    assert motion is not None
    torch.testing.assert_close(motion.lens.K, calibrated().K)
    assert motion.delay == pytest.approx(0.1, abs=0.026)


def test_keyframes_of_a_dive_are_chosen_by_the_gyroscope(views: Callable[[int], np.ndarray]):
    settings = FrameSettings(every_frame_to=20)
    turned = partial(rotation_motion, gyroscope(), TIMES)
    parts = split_frames(views, [1.0] * COUNT, settings, silent, ordered=True, rotation=turned)
    plain = split_frames(views, [1.0] * COUNT, settings, silent, ordered=True)
    assert parts[:HALF].count("between") > 50 > plain[:HALF].count("between")


@pytest.mark.shared
def test_the_gyroscope_of_a_gopro_is_that_of_its_images(shared: Path):
    found = gyroscope_of(shared / "data" / "gopro_reef" / "reef.mp4")
    assert found is not None
    assert len(found.time) == 1397
    assert gyroscope_of(shared / "data" / "gopro_transect" / "transect.mp4") is None


def test_the_lens_is_asked_for_frames_of_the_prepared_size(
    views: Callable[[int], np.ndarray], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
):
    def as_video(source: Path, draft: Path, *_) -> SelectedImages:
        images = []
        for i in range(COUNT):
            write_rgb(draft / f"{i:03d}.png", np.repeat(views(i)[..., None], 3, 2))
            images.append(SourceImage(f"{i:03d}.png", Path(f"{i:03d}.png"), (WIDTH, HEIGHT), TIMES[i], 1.0, gray=True))
        return SelectedImages(images, True, [], [], [], gyroscope=gyroscope())

    def lens(width: int, height: int, stated: Path | None) -> Cameras:
        asked.append((width, height, stated))
        return resized(calibrated(), width, height)

    asked: list[tuple[int, int, Path | None]] = []
    monkeypatch.setattr(frames_folder, "prepare_clip", as_video)
    monkeypatch.setattr(frames_folder, "check_source", lambda source: source)
    frames = frames_folder.read_frames("dive.mp4", folder=tmp_path / "prepare", lens=lens, every_frame_to=20)
    assert asked == [(WIDTH, HEIGHT, None)]
    assert len(frames.between) > 50
    with pytest.raises(ValueError, match="a folder of their own"):
        frames_folder.read_frames("dive.mp4", lens=lens)


@pytest.mark.shared
def test_a_calibrated_gopro_has_its_keyframes_chosen_by_its_gyroscope(shared: Path):
    clip = shared / "data" / "gopro_reef" / "reef.mp4"
    found, frames = gyroscope_of(clip), list(Video(clip).frames(start=1.0, end=5.0))
    assert found is not None
    views, times = [frame.gray(WIDTH) for frame in frames], [frame.time for frame in frames]
    assert rotation_motion(found, times, views.__getitem__) is None
    f = 1243.63 * WIDTH / 1920
    K = torch.tensor([[[f, 0, WIDTH / 2], [0, f, 90], [0, 0, 1]]], dtype=torch.float64)
    k = torch.tensor([[0.362, 0.248, 0, 0]], dtype=torch.float64)
    lens = Cameras(K, k, torch.eye(4, dtype=torch.float64)[None], WIDTH, 180, "OPENCV")
    motion = rotation_motion(found, times, views.__getitem__, lens)
    assert motion is not None
    assert motion.delay == pytest.approx(-0.125, abs=0.026)
