"""Bundle adjustment of a rig: one pose per instant, rig and path found as well as pixels allow, and what is no rig."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from tests.rig_scene import BASELINE, RIGHT, UNIT, reconstruction, stereo

from swimm3r.evaluate.poses import absolute_pose_errors
from swimm3r.geometry import invert_poses, rotation_angle
from swimm3r.scene.reconstruction import Reconstruction
from swimm3r.scene.reconstruction_io import load_reconstruction
from swimm3r.scene.rig import RigFit
from swimm3r.sfm.colmap.adjustment import bundle_adjust
from swimm3r.sfm.colmap.rig.adjustment import as_rig
from swimm3r.sfm.settings import ColmapSettings

Fixture = tuple[np.ndarray, Reconstruction, Reconstruction]
FIXED = ColmapSettings(intrinsics="fixed", focal=500.0)


def fit_of(rec: Reconstruction) -> RigFit:
    assert rec.rig is not None
    return rec.rig


def ate(rec: Reconstruction, poses: np.ndarray) -> float:
    found = absolute_pose_errors(rec.cameras.cam2world, torch.from_numpy(poses)).ate
    assert isinstance(found, float)
    return found


@pytest.fixture(scope="module")
def noisy() -> Fixture:
    """True poses; a reconstruction from noisy pixels as frames are placed one by one; and the same as a rig."""
    poses, frames = stereo()
    free = bundle_adjust(reconstruction(poses, frames, noise_px=0.5, noise=0.002))
    return poses, free, as_rig(free, frames, FIXED)


def test_a_rig_has_one_pose_per_instant(noisy: Fixture):
    _, _, rec = noisy
    assert fit_of(rec).rigid
    relative = invert_poses(rec.cameras.cam2world[1::2]) @ rec.cameras.cam2world[::2]
    expected = torch.tensor(fit_of(rec).cameras[1].camera_from_rig, dtype=torch.float64)
    assert (relative - expected).abs().max() < 1e-6


def test_the_baseline_and_turn_of_the_second_camera_are_found(noisy: Fixture):
    _, _, rec = noisy
    placed = fit_of(rec).cameras[1]
    assert abs(placed.baseline * UNIT / BASELINE - 1) < 0.005  # the unit is that of the path, which noise moves little
    turn = torch.tensor(placed.camera_from_rig, dtype=torch.float64)[:3, :3] @ torch.from_numpy(RIGHT[:3, :3])
    assert float(rotation_angle(turn)) < np.radians(0.05)
    assert 1e-4 < placed.baseline_std < 0.02


def test_a_rig_is_placed_no_worse_than_its_frames_alone(noisy: Fixture):
    poses, free, rec = noisy
    assert ate(rec, poses) <= ate(free, poses)


def test_instants_that_lack_a_camera_are_placed_too(noisy: Fixture):
    poses, free, _ = noisy
    _, frames = stereo()
    kept = [i for i in range(28) if i not in (3, 8)]
    tracked = torch.isin(free.tracks.frame, torch.tensor(kept))
    row = torch.full((28,), -1)
    row[kept] = torch.arange(len(kept))
    tracks = replace(
        free.tracks,
        point=free.tracks.point[tracked],
        frame=row[free.tracks.frame[tracked]],
        xy=free.tracks.xy[tracked],
    )
    part = replace(free, names=tuple(free.names[i] for i in kept), cameras=free.cameras[kept], tracks=tracks)
    rec = as_rig(part, frames, FIXED)
    assert rec.names == part.names
    assert fit_of(rec).cameras[1].instants == 12
    assert ate(rec, poses[kept]) < 0.01


def test_a_frame_in_a_wrong_place_is_brought_back_by_its_partner(noisy: Fixture):
    poses, free, _ = noisy
    _, frames = stereo()
    moved = free.cameras.cam2world.clone()
    moved[7, :3, 3] += 1.5
    rec = as_rig(replace(free, cameras=replace(free.cameras, cam2world=moved)), frames, FIXED)
    assert fit_of(rec).rigid
    assert ate(rec, poses) < 0.005


def test_cameras_that_were_not_triggered_together_are_named_and_left_in_place():
    poses, frames = stereo(20, later=0.2)
    free = bundle_adjust(reconstruction(poses, frames, noise_px=0.3))
    rec = as_rig(free, frames, FIXED)
    assert not fit_of(rec).rigid
    assert torch.equal(rec.cameras.cam2world, free.cameras.cam2world)
    assert "right seems to be later by 0.2" in rec.warnings[-1].what


def test_too_few_common_instants_leave_a_warning_and_no_rig():
    poses, frames = stereo(2)
    rec = as_rig(reconstruction(poses, frames), frames, FIXED)
    assert rec.rig is None
    assert "2 instants" in rec.warnings[-1].what


def test_a_rig_comes_back_from_disk(noisy: Fixture, tmp_path: Path):
    _, _, rec = noisy
    rec.save(tmp_path / "sfm")
    assert load_reconstruction(tmp_path / "sfm").rig == rec.rig
