"""Frames that training did not see: placed, rendered, scored."""

from dataclasses import replace

import pytest
import torch
from tests.splat.conftest import TinyDive, tiny_dive  # noqa: F401 - a fixture

from swimm3r.cameras import Cameras
from swimm3r.evaluate import NotComputed
from swimm3r.pipeline.scores.held_out import (
    covered_scores,
    cut,
    first_poses,
    mean_part,
    observed_scores,
    visible_window,
)
from swimm3r.scene.ground_truth import GroundTruth
from swimm3r.sfm.features.settings import FeatureSettings


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


def test_the_covered_score_looks_at_covered_pixels_alone():
    render, target = torch.full((20, 20, 3), 0.5), torch.full((20, 20, 3), 0.5)
    target[:, :10] = 0.6
    target[:, 10:] = 0.9
    left = torch.zeros(20, 20, dtype=torch.bool)
    left[:, :10] = True
    seen = torch.ones(20, 20, dtype=torch.bool)
    scores = covered_scores(render, target, seen, left)
    assert scores.share == 0.5
    assert scores.psnr == pytest.approx(20.17, abs=0.01)  # 25 of 255
    assert isinstance(covered_scores(render, target, seen, ~seen).psnr, NotComputed)


def test_the_observed_score_looks_at_observed_pixels_alone():
    render, target = torch.full((20, 20, 3), 0.5), torch.full((20, 20, 3), 0.6)
    target[:, 5:] = 0.9
    seen, left = torch.ones(20, 20, dtype=torch.bool), torch.zeros(20, 20, dtype=torch.bool)
    left[:, :5] = True
    scores = observed_scores(render, target, seen, left)
    assert scores.share == 0.25
    assert scores.psnr == pytest.approx(20.17, abs=0.01)
    assert scores.sharpness == 0  # the render is flat; half of the edge in the frame is on a pixel that counts
    nothing = observed_scores(render, target, seen, ~seen)
    assert nothing.share == 0
    assert isinstance(nothing.psnr, NotComputed)
    assert isinstance(observed_scores(render, target, seen, None).share, NotComputed)
    mean = mean_part([scores, nothing])
    assert mean.share == 0.125
    assert mean.psnr == scores.psnr
