"""Frames that a camera exposed and balanced each by itself, restored as one exposure and white balance shows them."""

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from tests.sfm.conftest import FlatDive, flat_dive

from swimm3r.cameras import project_visible
from swimm3r.errors import InputError
from swimm3r.io import images
from swimm3r.io.files.damage import Remedy
from swimm3r.medium import MediumFit
from swimm3r.scene.frame_changes import read_own_colors
from swimm3r.scene.frames import Frames
from swimm3r.scene.reconstruction import Points, Reconstruction, Tracks
from swimm3r.scene.reconstruction_io import load_reconstruction
from swimm3r.sfm.medium import apply
from swimm3r.sfm.medium.settings import AppearanceChoice
from swimm3r.sfm.settings import ColmapSettings

GAINS = torch.tensor([[0.8, 0.9, 1.1], [1.2, 1.1, 0.9], [1.0, 0.85, 1.05], [0.9, 1.2, 1.1], [1.1, 0.95, 0.85]])
COUNT = 10


@pytest.fixture(scope="module")
def steady(teal, tmp_path_factory: pytest.TempPathFactory) -> FlatDive:
    """Frames from alike heights, and points of the ground that all frames track which show them."""
    dive = flat_dive(tmp_path_factory.mktemp("steady"), teal, tuple(2.0 + 0.2 * (k % 3) for k in range(COUNT)))
    rng = torch.Generator().manual_seed(2)
    xyz = torch.rand(400, 3, generator=rng).double() * torch.tensor([3.0, 2.0, 0.0]) - torch.tensor([1.2, 1.0, 0.0])
    pixels, _, visible = project_visible(dive.rec.cameras, xyz.expand(COUNT, -1, 3))
    frame, point = torch.nonzero(visible).unbind(-1)
    points = Points(xyz, torch.full((len(xyz), 3), 0.5), torch.zeros(len(xyz)))
    return replace(dive, rec=replace(dive.rec, points=points, tracks=Tracks(point, frame, pixels[visible].float())))


@pytest.fixture(scope="module")
def relit(steady: FlatDive, tmp_path_factory: pytest.TempPathFactory) -> Frames:
    """The same with gains of each frame's own, 1 on average."""
    folder, lit = tmp_path_factory.mktemp("relit"), []
    gains = GAINS / GAINS.mean(0)
    for k, frame in enumerate(steady.frames):
        images.write_rgb(folder / frame.name, (steady.frames.image(k) * gains[k % len(gains)]).clamp(0, 1).numpy())
        lit.append(replace(frame, path=folder / frame.name))
    return replace(steady.frames, frames=tuple(lit))


def restored(
    steady: FlatDive,
    frames: Frames,
    water: MediumFit,
    folder: Path,
    monkeypatch: pytest.MonkeyPatch,
    appearance: AppearanceChoice,
) -> Reconstruction:
    monkeypatch.setattr(apply, "fit_medium", lambda *_: water)
    return apply.with_water(steady.rec, frames, ColmapSettings(flicker="keep", appearance=appearance), folder)


def errors(steady: FlatDive, folder: Path) -> np.ndarray:
    """Mean difference of each physically restored frame to its true clear colors."""
    found = (images.read_rgb(folder / "restored_physical" / f"{name}.png") / 65535 for name in steady.rec.names)
    return np.array([abs(J - true.numpy()).mean() for J, true in zip(found, steady.clear, strict=True)])


def test_frames_of_changing_exposure_are_restored_as_those_of_a_steady_camera(
    steady, relit, known_water, tmp_path, monkeypatch
):
    rec = restored(steady, relit, known_water, tmp_path / "auto", monkeypatch, "auto")
    kept = restored(steady, relit, known_water, tmp_path / "keep", monkeypatch, "keep")
    even = restored(steady, steady.frames, known_water, tmp_path / "steady", monkeypatch, "auto")
    assert rec.own_colors is not None
    assert kept.own_colors is None
    assert even.own_colors is None
    off, as_filmed, least = (errors(steady, tmp_path / run) for run in ("auto", "keep", "steady"))
    assert as_filmed.max() > 0.05
    assert (off < least + 0.25 * as_filmed.max()).all()
    assert off.mean() < 0.3 * as_filmed.mean()
    relit_cloud, true_cloud = (each.cloud.restored for each in (rec, even))
    assert relit_cloud.shape == true_cloud.shape
    assert (relit_cloud - true_cloud).abs().mean() < 0.03


def test_colors_of_single_frames_are_kept_with_the_reconstruction(steady, relit, known_water, tmp_path, monkeypatch):
    rec = restored(steady, relit, known_water, tmp_path / "run", monkeypatch, "auto")
    rec.save(tmp_path / "saved")
    again = load_reconstruction(tmp_path / "saved")
    for k in (0, 3):
        even = rec.evened(relit).image(k)
        assert torch.equal(again.evened(relit).image(k), even)
        pixels = torch.tensor([0, 500, 96 * 72 - 1])
        assert torch.equal(rec.evened(relit).colors(k, pixels), even.reshape(-1, 3)[pixels])
        assert torch.equal(rec.still(relit).image(k), relit.image(k))  # maps fit colors of their own
    assert rec.own_colors is not None
    rec = replace(rec, own_colors=replace(rec.own_colors, shading=0.05 * torch.ones(COUNT, 11, 3)))
    rec.save(tmp_path / "shaded")
    again = load_reconstruction(tmp_path / "shaded")
    assert torch.equal(again.evened(relit).image(1), rec.evened(relit).image(1))


@pytest.mark.parametrize(
    "frame",
    [
        {"map": [[1, 0, 0, 0]]},
        {"map": [[1, 0, 0, 0], [1, 0, 0, 0], [0, 0, 1, 0]]},  # red and green are one
        {"map": [[1, 0, 0, 0], [0, 1, 0, 0], [0, 0, 1, 0]], "shading": [[0, 0, 0]]},
    ],
)
def test_damaged_colors_of_frames_are_named(frame, tmp_path):
    path = tmp_path / "frame_colors.json"
    path.write_text(json.dumps({"0000.png": frame}))
    with pytest.raises(InputError, match=r"frame_colors\.json"):
        read_own_colors(path, Remedy("make it again"))
