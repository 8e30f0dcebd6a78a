"""Frames that training did not see: placed, rendered, scored."""

from dataclasses import replace

import pytest
import torch

from swimm3r.cameras import Cameras
from swimm3r.evaluate import NotComputed
from swimm3r.geometry import Similarity, align_similarity, best_similarity, pose_from, rotation_angle, so3_exp
from swimm3r.pipeline.camera_paths import smooth_path
from swimm3r.pipeline.scores.held_out import (
    covered_scores,
    cut,
    first_poses,
    mean_part,
    observed_scores,
    visible_window,
)
from swimm3r.scene.coverage import TrainingCoverage
from swimm3r.scene.ground_truth import GroundTruth
from swimm3r.scene.reconstruction import DenseCloud
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


def test_reference_poses_are_aligned_and_their_rotations_stay_rotations(tiny_dive):
    scale, shift = 3.0, torch.tensor([5.0, -2.0, 1.0], dtype=torch.float64)
    theirs = tiny_dive.cameras.cam2world.clone()
    theirs[:, :3, 3] = theirs[:, :3, 3] * scale + shift
    reference = GroundTruth(tiny_dive.frames.names, replace(tiny_dive.cameras, cam2world=theirs), True)
    poses = first_poses(tiny_dive.rec, tiny_dive.frames, FeatureSettings(), reference)
    assert set(poses) == set(tiny_dive.frames.test.names)
    for name, pose in poses.items():
        assert pose.source == "reference"
        torch.testing.assert_close(pose.cam2world, tiny_dive.cameras.cam2world[tiny_dive.frames.index(name)])


def test_a_smooth_path_begins_and_ends_near_the_dive_and_holds_rotations():
    rng = torch.Generator().manual_seed(0)
    poses = torch.eye(4, dtype=torch.float64).repeat(12, 1, 1)
    poses[:, 0, 3] = torch.arange(12)
    poses[:, 1, 3] = 0.3 * torch.rand(12, generator=rng)
    path = smooth_path(poses, 50)
    assert path.shape == (50, 4, 4)
    torch.testing.assert_close(path[:, :3, :3] @ path[:, :3, :3].mT, torch.eye(3).double().expand(50, 3, 3))
    assert path[:, 0, 3].diff().min() > 0
    assert path[:, 1, 3].diff().abs().max() < 0.1 * poses[:, 1, 3].diff().abs().max()
    assert path[0, 0, 3] < 1.5
    assert path[-1, 0, 3] > 9.5


def test_what_no_training_frame_saw_is_not_covered(tiny_dive):
    x, y = torch.meshgrid(torch.linspace(-2.6, 2.6, 150), torch.linspace(-2.1, 2.1, 120), indexing="ij")
    wall = torch.stack([x, y, torch.full_like(x, 3.0)], -1).reshape(-1, 3)
    rec = replace(tiny_dive.rec, cloud=DenseCloud(wall, wall, wall))
    camera = tiny_dive.cameras[4]
    assert TrainingCoverage(rec).of(camera).all()
    away = camera.cam2world.clone()
    away[0, 0, 3] += 3.0  # the wall ends at x = 2.6
    beyond = TrainingCoverage(rec).of(replace(camera, cam2world=away))
    assert beyond[:, :10].all()
    assert not beyond[:, 50:].any()


def test_ground_at_a_guessed_distance_is_not_covered(tiny_dive):
    x, y = torch.meshgrid(torch.linspace(-2.6, 2.6, 150), torch.linspace(-2.1, 2.1, 120), indexing="ij")
    wall = torch.stack([x, y, torch.full_like(x, 3.0)], -1).reshape(-1, 3)
    measured, guessed = wall[wall[:, 0] < 0.2], wall[wall[:, 0] >= 0.2]
    cloud, backdrop = (DenseCloud(part, part, part) for part in (measured, guessed))
    camera = tiny_dive.cameras[4]
    shares = [
        TrainingCoverage(rec).of(camera).float().mean()
        for rec in (replace(tiny_dive.rec, cloud=cloud), replace(tiny_dive.rec, cloud=cloud, backdrop=backdrop))
    ]
    assert shares[0] == shares[1] < 0.9


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


def test_a_track_that_bends_a_little_is_turned_by_its_orientations():
    rng = torch.Generator().manual_seed(0)
    R = so3_exp(0.3 * torch.randn(12, 3, generator=rng, dtype=torch.float64))
    centers = torch.stack([torch.linspace(-3, 3, 12).double(), *0.05 * torch.randn(2, 12, generator=rng).double()], -1)
    theirs = pose_from(R, centers)
    bent = centers + 0.05 * torch.randn(12, 3, generator=rng).double()
    truth = Similarity(torch.tensor(2.0).double(), R[0], torch.tensor([1.0, 2.0, 3.0]).double())
    ours = truth.poses(pose_from(R, bent))
    found = best_similarity(theirs, ours)
    assert found is not None
    assert rotation_angle(found.R @ truth.R.mT) < 1e-6
    by_centers = align_similarity(theirs[:, :3, 3], ours[:, :3, 3])
    assert rotation_angle(by_centers.R @ truth.R.mT).rad2deg() > 3  # the turn about the track is anybody's guess


def test_orientations_that_contradict_the_track_leave_it_to_the_centers():
    centers = torch.randn(6, 3, generator=torch.Generator().manual_seed(1)).double()
    theirs = pose_from(torch.eye(3).double().expand(6, 3, 3), centers)
    about = torch.diag(torch.tensor([-1.0, -1.0, 1.0])).double()
    ours = pose_from(torch.eye(3).double().expand(6, 3, 3), centers @ about.mT)
    ours[:, 2, 3] *= 0  # flat, and turned half round
    theirs[:, 2, 3] *= 0
    found = best_similarity(theirs, ours)
    assert found is not None
    torch.testing.assert_close(found.poses(theirs)[:, :3, 3], ours[:, :3, 3], atol=1e-9, rtol=0)
    still = theirs[:1].expand(6, 4, 4)
    assert best_similarity(still, ours) is None


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
