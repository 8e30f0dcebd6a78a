"""Frames that training did not see: placed, rendered, scored."""

from dataclasses import replace

import torch
from tests.splat.conftest import TinyDive, tiny_dive  # noqa: F401 - a fixture

from swimm3r.cameras import Cameras
from swimm3r.pipeline.scores.held_out import (
    FirstPose,
    cut,
    first_poses,
    score_views,
    visible_window,
)
from swimm3r.pipeline.summary import test_section as section_of
from swimm3r.scene.ground_truth import GroundTruth
from swimm3r.scene.rig import Rig, RigCamera
from swimm3r.sfm.features.settings import FeatureSettings
from swimm3r.splat.settings import PoseRefinementSettings


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
