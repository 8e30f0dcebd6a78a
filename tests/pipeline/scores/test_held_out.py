"""Frames that training did not see: placed, rendered, scored."""

from dataclasses import replace
from math import cos, sin
from pathlib import Path

import pytest
import torch
from tests.splat.conftest import TinyDive, tiny_dive  # noqa: F401 - a fixture
from torch import Tensor

from swimm3r import weights
from swimm3r.cameras import Cameras
from swimm3r.evaluate import NotComputed
from swimm3r.geometry import Similarity
from swimm3r.medium import Medium
from swimm3r.pipeline.scores.held_out import (
    FirstPose,
    cut,
    first_poses,
    in_axes_of,
    published_lpips,
    score_views,
    visible_window,
)
from swimm3r.pipeline.summary import mean_medium
from swimm3r.pipeline.summary import test_section as section_of
from swimm3r.scene.coverage import TrainingCoverage
from swimm3r.scene.ground_truth import GroundTruth
from swimm3r.scene.reconstruction import MovingMasks
from swimm3r.scene.rig import Rig, RigCamera
from swimm3r.sfm.features.settings import FeatureSettings
from swimm3r.sfm.moving.still_scene import StillScene
from swimm3r.splat.rendering import SplatMap
from swimm3r.splat.settings import PoseRefinementSettings
from swimm3r.splat.training_poses import RefinedPoses


def lens(k1: float) -> Cameras:
    K = torch.tensor([[60.0, 0, 33], [0, 60, 23], [0, 0, 1]], dtype=torch.float64)[None]
    pose = torch.eye(4, dtype=torch.float64)[None]
    return Cameras(K, torch.tensor([[k1]], dtype=torch.float64), pose, 64, 48, "SIMPLE_RADIAL")


def test_the_window_of_a_lens_without_distortion_is_the_whole_canvas():
    window = visible_window(lens(0.0), lens(0.0).pinhole())
    assert (window.rows, window.columns) == (slice(0, 48), slice(0, 64))


def test_the_window_leaves_out_what_the_lens_does_not_show():
    camera = lens(0.25)
    canvas = camera.pinhole()
    window = visible_window(camera, canvas)
    assert window.columns.start > 0
    assert window.columns.stop - window.columns.start > 40
    inner = cut(canvas, window)
    assert (inner.width, inner.height) == (
        window.columns.stop - window.columns.start,
        window.rows.stop - window.rows.start,
    )
    assert inner.K[0, 0, 2] == canvas.K[0, 0, 2] - window.columns.start
    assert visible_window(camera, canvas) == window


def test_reference_poses_are_aligned_and_their_rotations_stay_rotations(tiny_dive: TinyDive):  # noqa: F811
    scale, shift = 3.0, torch.tensor([5.0, -2.0, 1.0], dtype=torch.float64)
    theirs = tiny_dive.cameras.cam2world.clone()
    theirs[:, :3, 3] = theirs[:, :3, 3] * scale + shift
    reference = GroundTruth(tiny_dive.frames.names, replace(tiny_dive.cameras, cam2world=theirs), True)
    poses = first_poses(tiny_dive.rec, tiny_dive.frames, FeatureSettings(), reference)
    assert set(poses) == set(tiny_dive.frames.test.names)
    for name, pose in poses.items():
        assert pose.source == "reference"
        torch.testing.assert_close(pose.cam2world, tiny_dive.cameras.cam2world[tiny_dive.frames.index(name)])


def test_a_test_frame_of_a_rig_is_rendered_through_the_lens_of_its_camera(tiny_dive: TinyDive, tmp_path):  # noqa: F811
    """The frame before the last is of another camera, with another lens."""
    rec, sides = tiny_dive.rec, ["left", "right"]
    frames = replace(
        tiny_dive.frames,
        frames=tuple(replace(frame, camera=sides[i % 2], instant=i // 2) for i, frame in enumerate(tiny_dive.frames)),
        rig=Rig((RigCamera("left"), RigCamera("right"))),
    )
    K = rec.cameras.K.clone()
    K[0::2, [0, 1], [0, 1]] = 90.0  # rec.names begins at frame 1, a right one
    poses = {"8.png": FirstPose(tiny_dive.cameras.cam2world[8], "reference")}
    rec = replace(rec, cameras=replace(rec.cameras, K=K))
    (view,) = score_views(tiny_dive.truth, rec, frames, poses, tmp_path, PoseRefinementSettings(steps=0))
    assert view.lens.K[0, 0, 0] == 60


def test_without_a_placed_test_frame_no_score_is_known():
    section = section_of([], PoseRefinementSettings(), None, ["a.png"])
    assert section["views"] == 0
    assert section["unplaced"] == ["a.png"]
    assert section["frames"] == []
    scores = ("psnr", "ssim", "lpips", "sharpness", "psnr_observed", "psnr_covered", "flow_px", "psnr_still")
    assert all(section[name] is None for name in scores)
    assert all("placed" in str(section[f"{name}_reason"]) for name in scores)


def test_coverage_and_what_moves_are_asked_in_the_axes_of_the_reconstruction(
    tiny_dive: TinyDive,  # noqa: F811
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
):
    """The training of a map may have moved all of its cameras together."""
    frames, angle, name = tiny_dive.frames, 0.3, tiny_dive.frames.test.names[0]
    R = torch.tensor([[cos(angle), 0, sin(angle)], [0, 1, 0], [-sin(angle), 0, cos(angle)]], dtype=torch.float64)
    to_map = Similarity(torch.tensor(1.1).double(), R, torch.tensor([0.5, -0.3, 0.2]).double())
    moved = RefinedPoses(tiny_dive.rec.names, to_map.poses(tiny_dive.rec.cameras.cam2world))
    scene = replace(tiny_dive.truth, poses=moved)
    there = tiny_dive.cameras.cam2world[frames.index(name)]
    asked: list[Cameras] = []

    def moving_in(self: StillScene, lens: Cameras, image: Tensor, neighbors: tuple[str, ...] = ()) -> Tensor:
        assert torch.equal(self.cameras.cam2world, tiny_dive.rec.cameras.cam2world)
        asked.append(lens)
        return torch.zeros(lens.height, lens.width, dtype=torch.bool)

    monkeypatch.setattr(StillScene, "moving_in", moving_in)
    rec = replace(tiny_dive.rec, moving=MovingMasks(tmp_path / "masks"))
    poses = in_axes_of(scene, rec, {name: FirstPose(there, "reference")})
    (view,) = score_views(scene, rec, frames, poses, tmp_path, PoseRefinementSettings(steps=0))
    canvas = replace(cut(view.canvas, view.window), cam2world=there[None])
    expected = TrainingCoverage(rec).of(canvas).float().mean().item()
    assert expected > 0.2
    assert view.covered.share == pytest.approx(expected, abs=0.01)
    torch.testing.assert_close(asked[0].cam2world[0], there, rtol=0, atol=1e-6)


def test_the_mean_water_of_a_map_is_that_of_its_own_cameras(
    tiny_dive: TinyDive,  # noqa: F811
    monkeypatch: pytest.MonkeyPatch,
):
    moved = RefinedPoses(tiny_dive.rec.names, tiny_dive.rec.cameras.cam2world.flip(0))
    asked: list[Tensor] = []

    def mean_water(scene: SplatMap, camera: Cameras, time: float) -> Medium:
        asked.append(camera.cam2world[0])
        return Medium(torch.zeros(3), torch.zeros(3), torch.zeros(3))

    monkeypatch.setattr("swimm3r.pipeline.summary.mean_water", mean_water)
    mean_medium(replace(tiny_dive.truth, poses=moved), tiny_dive.rec, tiny_dive.frames)
    torch.testing.assert_close(torch.stack(asked), moved.cam2world)


def test_a_missing_lpips_names_the_weights_as_the_command_that_gets_them_does(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
):
    """The published file is called vgg.pth; under that name nothing looks for it."""
    monkeypatch.setenv("SWIMM3R_WEIGHTS_DIR", str(tmp_path))
    monkeypatch.setenv("SWIMM3R_CACHE", str(tmp_path / "cache"))
    for name in ("vgg16", "lpips-vgg"):
        missing = published_lpips()
        assert isinstance(missing, NotComputed)
        assert f"swimm3r weights get {name}" in missing.reason
        weights_file = weights.entry(name)
        (tmp_path / weights_file.filename).write_bytes(b"0" * (weights_file.size or 1))
