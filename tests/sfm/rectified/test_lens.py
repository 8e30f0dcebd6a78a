"""Frames that no lens of COLMAP's explains: found to be so, rectified, placed, and found again by all that follows."""

import math
import pickle
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
import torch
from tests.imaging.test_rectification import stretching_lens
from tests.sfm.colmap.two_planes import camera_path, render

from swimm3r.cameras import Cameras, image_directions
from swimm3r.errors import InputError
from swimm3r.geometry import align_similarity, rotation_angle
from swimm3r.imaging.rectification import Rectification, rectification_of
from swimm3r.io import images
from swimm3r.pipeline import stages
from swimm3r.pipeline.presets import RunSettings
from swimm3r.progress import silent
from swimm3r.scene.frames import Frame, Frames, write_index
from swimm3r.scene.ground_truth import GroundTruth
from swimm3r.scene.reconstruction import Reconstruction
from swimm3r.sfm.colmap import poses
from swimm3r.sfm.rectified.frames import BentImagesError, rectify_frames
from swimm3r.sfm.rectified.run import (
    RECTIFIED,
    given_rectification,
    run_frames,
    run_rectification,
    run_truth,
)
from swimm3r.sfm.settings import ColmapSettings
from swimm3r.tasks.settings import EngineSettings

WIDTH, HEIGHT = 320, 240
SETTINGS = ColmapSettings(threads=2)


@pytest.fixture(scope="module")
def truth() -> Cameras:
    """The pinhole cameras of the clip, each wide enough for all that the bent lens shows."""
    cameras = camera_path()
    K = cameras.K.clone()
    K[:, 0, 2], K[:, 1, 2] = 400, 400
    return replace(cameras, K=K, width=800, height=800)


@pytest.fixture(scope="module")
def bent(truth: Cameras, tmp_path_factory: pytest.TempPathFactory) -> Frames:
    """A clip that was taken through a lens that stretches, as prepared frames on disk."""
    folder = tmp_path_factory.mktemp("bent")
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("tests.sfm.colmap.two_planes.WIDTH", 800)
        patch.setattr("tests.sfm.colmap.two_planes.HEIGHT", 800)
        straight = render(truth, folder / "straight")
    rays = image_directions(stretching_lens(WIDTH, HEIGHT)).double()
    x, y = ((rays[..., k] / rays[..., 2] * truth.K[0, 0, 0] + 399.5).float().numpy() for k in (0, 1))
    frames = []
    for i, frame in enumerate(straight.frames):
        name = f"{i}.png"
        filmed = cv2.remap(images.read_rgb(frame.path), x, y, cv2.INTER_CUBIC)
        images.write_rgb(folder / "prepare" / name, filmed)
        frames.append(Frame(name, folder / "prepare" / name, float(i), 0.0, "train"))
    out = Frames(tuple(frames), WIDTH, HEIGHT, ordered=True)
    write_index(folder / "prepare", out)
    return out


@pytest.fixture(scope="module")
def found(bent: Frames, tmp_path_factory: pytest.TempPathFactory) -> Rectification:
    """The way to images that COLMAP's lenses explain, from the images alone."""
    with pytest.raises(BentImagesError) as raised:
        poses.reconstruct(bent, SETTINGS, tmp_path_factory.mktemp("sfm"))
    assert isinstance(raised.value.rectification, Rectification)
    return raised.value.rectification


def worst_turn(rec: Reconstruction, turn: torch.Tensor, truth: Cameras) -> float:
    """Degrees by which the cameras are turned against the truth, whose own axes are those of the bent lens."""
    fit = align_similarity(rec.cameras.centers, truth.centers)
    turned = fit.poses(rec.cameras.cam2world)[:, :3, :3]
    return math.degrees(rotation_angle(turned.mT @ truth.cam2world[:, :3, :3] @ turn).max().item())


@pytest.mark.long
def test_rectified_frames_are_placed_where_they_were_taken(
    bent: Frames, found: Rectification, truth: Cameras, tmp_path: Path
):
    frames = rectify_frames(bent, found, tmp_path / "rectified")
    rec = poses.reconstruct(frames, SETTINGS, tmp_path / "sfm")
    assert rec.names == bent.names
    assert worst_turn(rec, found.turn, truth) < 0.3
    assert rec.points.error.median() < 0.4


@pytest.mark.long
def test_bent_frames_that_are_kept_are_placed_worse(bent: Frames, tmp_path: Path):
    kept = poses.reconstruct(bent, replace(SETTINGS, rectify="keep", shutter="global"), tmp_path / "kept")
    assert (kept.cameras.width, kept.cameras.height) == (WIDTH, HEIGHT)
    assert kept.points.error.median() > 0.52  # 1.3 times the most that rectified frames may have


@pytest.mark.long
def test_a_lens_that_is_given_is_believed(bent: Frames, tmp_path: Path):
    rec = poses.reconstruct(bent, replace(SETTINGS, focal=280.0), tmp_path)
    assert rec.cameras.width == WIDTH


def test_later_stages_find_the_rectified_frames(bent: Frames, tmp_path: Path):
    run, way = tmp_path / "run", rectification_of(stretching_lens(WIDTH, HEIGHT))
    masked = replace(bent.frames[1], mask=tmp_path / "mask.png", up=(0.0, -1.0, 0.0), split="test")
    usable = np.ones((HEIGHT, WIDTH), bool)
    usable[:, :160] = False
    images.write_mask(tmp_path / "mask.png", usable)
    frames = replace(bent, frames=(replace(bent.frames[0], name="0.jpg"), masked, *bent.frames[2:]))
    bent.save(run / "prepare")
    assert run_frames(run).width == WIDTH
    assert run_rectification(run) is None

    made = rectify_frames(frames, way, run / RECTIFIED)
    again = run_frames(run)
    assert again == made
    assert (again.width, again.height) == (way.pinhole.width, way.pinhole.height)
    assert again.names == ("0.png", *bent.names[1:])
    assert again.calibration is not None
    assert again.mask(1).double().mean() == pytest.approx(0.5, abs=0.05)
    assert again.mask(0).all()
    up = again.frames[1].up
    assert up is not None
    torch.testing.assert_close(
        way.turn @ torch.tensor(up).double(), torch.tensor([0.0, -1, 0]).double(), atol=1e-5, rtol=0
    )
    assert len(again.test) == 1
    stored = run_rectification(run)
    assert stored is not None
    assert stored.key == way.key


def test_frames_of_another_size_are_refused(bent: Frames, tmp_path: Path):
    with pytest.raises(InputError, match="320x240"):
        rectify_frames(bent, rectification_of(stretching_lens(160, 120)), tmp_path / "rectified")
    assert not (tmp_path / "rectified").exists()


def test_the_lens_of_a_run_brings_its_rectification(bent: Frames, truth: Cameras, tmp_path: Path):
    way, run = rectification_of(stretching_lens(WIDTH, HEIGHT)), tmp_path / "run"
    rectify_frames(bent, way, run / RECTIFIED)
    each = [0] * len(truth)
    pinholes = replace(way.pinhole[each], cam2world=truth.cam2world)
    pinholes.save(run / "sfm" / "cameras.json", bent.names)
    settings = ColmapSettings(lens_from=run)
    same = given_rectification(settings, bent)
    assert same is not None
    assert same.key == way.key
    larger = given_rectification(settings, replace(bent, width=2 * WIDTH, height=2 * HEIGHT))
    assert larger is not None
    assert larger.pinhole.width == 2 * way.pinhole.width
    assert given_rectification(SETTINGS, bent) is None
    with pytest.raises(InputError, match="another mode"):
        given_rectification(settings, replace(bent, height=WIDTH))


def test_the_error_goes_from_process_to_process():
    way = rectification_of(stretching_lens(WIDTH, HEIGHT))
    error = BentImagesError(way)
    again = pickle.loads(pickle.dumps(error))
    assert str(again) == str(error)
    assert again.rectification.key == way.key


def test_reference_poses_turn_with_the_frames(bent: Frames, truth: Cameras, tmp_path: Path):
    way = rectification_of(stretching_lens(WIDTH, HEIGHT))
    stated = GroundTruth(tuple(f"{i}.jpg" for i in range(len(truth))), truth, metric=False, folder=tmp_path)
    of_their_size = run_truth(tmp_path, bent, stated)
    assert of_their_size is not None
    assert (of_their_size.cameras.width, of_their_size.cameras.height) == (bent.width, bent.height)
    assert of_their_size.names == stated.names
    rectify_frames(bent, way, tmp_path / RECTIFIED)
    turned = run_truth(tmp_path, bent, stated)
    assert turned is not None
    assert turned.names == bent.names
    torch.testing.assert_close(turned.cameras.centers, truth.centers)
    ahead = turned.cameras.cam2world[:, :3, 2]
    torch.testing.assert_close(ahead, truth.cam2world[:, :3, :3] @ way.turn[:, 2])
    assert turned.clear("0.png") is None


def test_a_run_rectifies_once_and_goes_on_from_there(bent: Frames, tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    way, tried = rectification_of(stretching_lens(WIDTH, HEIGHT)), []

    def reconstruct(frames: Frames, settings: object, folder: Path, *_: object) -> None:
        tried.append((frames.width, frames.height))
        if frames.width == WIDTH:
            raise BentImagesError(way)
        if len(tried) == 2:
            raise KeyboardInterrupt
        images.write_mask(folder / "masks" / "3.png.png", np.zeros((frames.height, frames.width), bool))

    monkeypatch.setattr(stages, "reconstruct", reconstruct)
    bent.save(tmp_path / "prepare")
    arguments = (bent, RunSettings(), tmp_path, silent, EngineSettings(), None)
    with pytest.raises(KeyboardInterrupt):
        stages._reconstruct(*arguments)
    stages._reconstruct(*arguments)
    size = way.pinhole.width, way.pinhole.height
    assert tried == [(WIDTH, HEIGHT), size, size]
    (mask,) = (tmp_path / "sfm" / "masks_as_filmed").iterdir()
    usable = images.read_mask(mask)
    assert usable.shape == (HEIGHT, WIDTH)
    assert 0 < usable.mean() < 0.2
