"""Sunlight that flickers over a flat dive of known depth and water: evened out, and left alone where it is steady."""

from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
import torch
from tests.sfm.conftest import FlatDive, flat_dive
from torch import Tensor

from swimm3r.appearance import ORDERS, shading_gains
from swimm3r.cameras import image_directions, ray_depth_from_z
from swimm3r.io import images
from swimm3r.lamp import Lamp
from swimm3r.medium import Medium, MediumFit, add_water
from swimm3r.scene.frames import Frames
from swimm3r.scene.reconstruction import Reconstruction
from swimm3r.scene.reconstruction_io import load_reconstruction
from swimm3r.sfm.medium import apply
from swimm3r.sfm.medium.flicker import with_steady
from swimm3r.sfm.medium.settings import RestoreSettings
from swimm3r.sfm.settings import ColmapSettings

COUNT = 12


@pytest.fixture(scope="module")
def steady(teal, tmp_path_factory: pytest.TempPathFactory) -> FlatDive:
    """Frames from alike heights, which see much of each other's ground."""
    return flat_dive(tmp_path_factory.mktemp("steady"), teal, tuple(2.0 + 0.2 * (k % 3) for k in range(COUNT)))


@pytest.fixture(scope="module")
def sunny(steady: FlatDive, tmp_path_factory: pytest.TempPathFactory) -> Frames:
    """The same with stripes of light that lie elsewhere in every frame and are 1 on average."""
    folder, lit = tmp_path_factory.mktemp("sunny"), []
    for k, frame in enumerate(steady.frames):
        camera = steady.rec.cameras[k]
        rays = image_directions(camera)
        height = -float(camera.cam2world[0, 2, 3])
        xy = rays[..., :2] * height + camera.cam2world[0, :2, 3]
        z_depth = torch.full(xy.shape[:2], height)
        J = (steady.clear[k] * stripes(xy, k)[..., None]).float()
        raw = add_water(J, ray_depth_from_z(z_depth, rays.float()), steady.medium).clamp(0, 1)
        images.write_rgb(folder / frame.name, raw.numpy())
        lit.append(replace(frame, path=folder / frame.name))
    return replace(steady.frames, frames=tuple(lit))


def stripes(xy: Tensor, k: int) -> Tensor:
    """A pattern of light on the ground at the time of frame `k`."""
    a, b = torch.from_numpy(np.random.default_rng(k).uniform(0, 2 * np.pi, 2))
    x, y = xy.double().unbind(-1)
    return 1 + 0.15 * torch.sin(8 * x + 3 * y + a) + 0.15 * torch.sin(2 * x - 9 * y + b)


@pytest.fixture(scope="module")
def rec(steady: FlatDive, known_water: MediumFit) -> Reconstruction:
    """The reconstruction with the true water."""
    return replace(steady.rec, medium=known_water)


def evened(rec: Reconstruction, frames: Frames, folder: Path) -> Frames:
    """The frames in steady light, which there must be."""
    found = with_steady(rec, frames, RestoreSettings(), folder)
    assert found.steady is not None
    assert found.steady.count(frames) == COUNT
    return found.still(frames)


def errors(frames: Frames, steady: FlatDive) -> np.ndarray:
    """Root mean square differences to the frames in steady light, frame by frame."""
    pairs = ((frames.image(k) - steady.frames.image(k)) for k in range(COUNT))
    return np.array([float(off.square().mean().sqrt()) for off in pairs])


def clear_image(path: Path) -> np.ndarray:
    """A physically restored frame, 0..1."""
    stored = cv2.imread(str(path), cv2.IMREAD_UNCHANGED)
    assert stored is not None
    return stored[..., ::-1] / 65535


def test_steady_light_is_left_alone(rec: Reconstruction, steady: FlatDive, tmp_path: Path):
    assert with_steady(rec, steady.frames, RestoreSettings(), tmp_path / "steady") is rec
    assert not (tmp_path / "steady").exists()


def test_gains_over_large_parts_of_frames_are_the_cameras(
    rec: Reconstruction, steady: FlatDive, tmp_path: Path, caplog: pytest.LogCaptureFixture
):
    """Local tone mapping changes brightness by more than flicker does, and more slowly over the image."""
    toned, rng = [], np.random.default_rng(0)
    for k, frame in enumerate(steady.frames):
        image = steady.frames.image(k).permute(2, 0, 1)
        shading = torch.from_numpy(rng.normal(0, 0.12, (len(ORDERS), 1))).float().expand(-1, 3)
        path = tmp_path / frame.name
        images.write_rgb(path, (image * shading_gains(shading, *image.shape[1:])).clamp(0, 1).permute(1, 2, 0).numpy())
        toned.append(replace(frame, path=path))
    caplog.set_level("INFO")
    frames = replace(steady.frames, frames=tuple(toned))
    assert with_steady(rec, frames, RestoreSettings(), tmp_path / "steady") is rec
    assert "large parts" in caplog.text


def test_patterns_of_light_that_move_are_evened_out(rec, sunny: Frames, steady: FlatDive, tmp_path: Path):
    before, after = errors(sunny, steady), errors(evened(rec, sunny, tmp_path / "steady"), steady)
    assert (after < 0.65 * before).all()
    assert after.mean() < 0.5 * before.mean()  # the mean of n frames keeps 1 / sqrt(n) of their patterns: 0.3 of 12


def test_what_the_water_scatters_keeps_its_light(rec, sunny: Frames, teal: Medium, tmp_path: Path):
    """The gains are of the direct light alone: as a factor on the whole color they depend on the channel."""
    lit = evened(rec, sunny, tmp_path / "steady")
    k = COUNT // 2
    depth = rec.depth[rec.names[k]].z_depth
    rays = image_directions(rec.cameras[k]).float()
    veil = add_water(torch.zeros(*depth.shape, 3), ray_depth_from_z(depth, rays), teal)
    before, after = sunny.image(k) - veil, lit.image(k) - veil
    sure = (before > 0.08).all(-1) & (after < 0.9).all(-1)
    gains = (after / before)[sure]
    assert len(gains) > 1000
    assert (gains / gains.mean(-1, keepdim=True) - 1).abs().quantile(0.95) < 0.05  # of 8 bits
    assert gains.std() > 0.08


def test_under_a_lamp_there_is_no_sun_to_flicker(rec: Reconstruction, sunny: Frames, tmp_path: Path):
    assert rec.medium is not None
    lamp = Lamp(torch.zeros(3), 1.0, 2.0, 1.0, torch.zeros(6), torch.zeros(6))
    under = replace(rec, medium=replace(rec.medium, lamp=lamp))
    assert with_steady(under, sunny, RestoreSettings(), tmp_path / "steady") is under


def test_restored_images_and_cloud_are_of_the_evened_frames_and_that_is_said(
    steady: FlatDive, sunny: Frames, known_water: MediumFit, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
):
    monkeypatch.setattr(apply, "fit_medium", lambda *_: known_water)
    rec = apply.with_water(steady.rec, sunny, ColmapSettings(), tmp_path / "auto")
    kept = apply.with_water(steady.rec, sunny, ColmapSettings(flicker="keep"), tmp_path / "keep")
    assert kept.steady is None
    assert not (tmp_path / "keep" / "steady").exists()
    assert [warning.what.startswith("Sunlight flickers") for warning in rec.warnings].count(True) == 1
    k = COUNT // 2
    name = f"{rec.names[k]}.png"
    true = steady.clear[k].numpy()
    off = [abs(clear_image(tmp_path / run / "restored_physical" / name) - true).mean() for run in ("auto", "keep")]
    assert off[0] < 0.7 * off[1]
    assert torch.equal(rec.medium.beta_D, kept.medium.beta_D)  # of the frames as filmed
    again = apply.with_water(rec, sunny, ColmapSettings(), tmp_path / "auto")  # as a run that was interrupted goes on
    assert torch.equal(again.cloud.restored, rec.cloud.restored)
    rec.save(tmp_path / "saved")
    again = load_reconstruction(tmp_path / "saved")
    assert again.still(sunny).frames[k].path == tmp_path / "saved" / "steady" / name
    assert torch.equal(again.still(sunny).image(k), rec.still(sunny).image(k))
