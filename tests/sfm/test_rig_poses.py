"""Relative poses of a rig's cameras: robust to frames in wrong places, and the delay of one of them."""

import numpy as np
import torch
from tests.rig_scene import RIGHT, stereo

from swimm3r.geometry import rotation_angle
from swimm3r.sfm.rig_poses import delay_of, relative_scatter, relative_to_first, rig_rows, robust_mean


def test_the_pose_of_a_camera_in_the_rig_is_the_same_at_all_instants():
    poses, frames = stereo()
    found = relative_to_first(torch.from_numpy(poses), rig_rows(frames.names, frames), 1)
    assert len(found) == 14
    np.testing.assert_allclose(found.numpy(), np.tile(RIGHT, (14, 1, 1)), atol=1e-12)


def test_instants_without_one_of_the_cameras_do_not_count():
    poses, frames = stereo()
    kept = [0, 1, 2, 5, 6, 7]  # left alone at the second, right alone at the third instant
    rows = rig_rows([frames.names[i] for i in kept], frames)
    assert len(relative_to_first(torch.from_numpy(poses[kept]), rows, 1)) == 2
    assert rows.instant.tolist() == [0, 0, 1, 2, 3, 3]


def test_a_third_of_misplaced_frames_does_not_move_the_rig():
    poses, frames = stereo(18)
    rng = np.random.default_rng(0)
    for i in range(1, 36, 6):
        poses[i, :3, 3] += rng.normal(size=3)
        poses[i, :3, :3] = poses[i - 1, :3, :3].T
    mean = robust_mean(relative_to_first(torch.from_numpy(poses), rig_rows(frames.names, frames), 1))
    assert np.abs(mean[:3, 3].numpy() - RIGHT[:3, 3]).max() < 1e-4
    assert float(rotation_angle(mean[:3, :3].mT @ torch.from_numpy(RIGHT[:3, :3]))) < 1e-4


def test_a_late_camera_is_told_by_the_motion_of_the_rig():
    poses, frames = stereo(30, later=0.2)
    delay = delay_of(torch.from_numpy(poses), rig_rows(frames.names, frames), 1)
    assert delay is not None
    assert abs(delay.seconds - 0.2) < 3 * delay.std + 0.01
    assert delay.std < 0.02


def test_a_synchronous_rig_has_no_delay():
    poses, frames = stereo(30)
    delay = delay_of(torch.from_numpy(poses), rig_rows(frames.names, frames), 1)
    assert delay is not None
    assert abs(delay.seconds) < 1e-9


def test_independent_lengths_are_averaged_and_drifting_ones_are_not():
    rng = np.random.default_rng(1)
    white = np.exp(0.02 * rng.normal(size=400))
    assert 0.8 * 0.02 / np.sqrt(400) < relative_scatter(white) < 1.5 * 0.02 / np.sqrt(400)
    drift = np.exp(0.02 * np.sin(np.linspace(0, 3, 400)))
    assert relative_scatter(drift) > 3 * relative_scatter(white)
