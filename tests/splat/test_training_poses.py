"""The training frames' poses, refined with the map."""

from dataclasses import replace
from typing import Any

import pytest
import torch

from swimm3r.cameras import project
from swimm3r.evaluate.poses import absolute_pose_errors
from swimm3r.geometry import pose_from, so3_exp
from swimm3r.io.cameras_json import read_cameras
from swimm3r.pipeline.scores.held_out import FirstPose, in_axes_of
from swimm3r.scene.reconstruction import Matches
from swimm3r.splat import train, training_poses
from swimm3r.splat.map_file import load_map
from swimm3r.splat.pose_mlp import PoseMlp, moved, pose_rate
from swimm3r.splat.rendering import SplatMap
from swimm3r.splat.settings import DensifySettings, InitialSettings, TrainingPoseSettings, UwbsSettings
from swimm3r.splat.training_poses import epipolar_loss, epipolar_matches, training_poses_of
from swimm3r.splat.views import TrainingViews


def matched(dive, count: int = 60):
    """The tiny dive's reconstruction with the true matches of all pairs of its frames."""
    rng = torch.Generator().manual_seed(0)
    rec = dive.rec
    points = rec.points.xyz[torch.randperm(len(rec.points.xyz), generator=rng)[:400]]
    pixels, _ = project(rec.cameras, points[None].expand(len(rec.names), -1, -1))
    shown = ((pixels > 0) & (pixels < torch.tensor([64.0, 48.0]))).all(-1)
    rows = []
    for i, j in torch.triu_indices(len(rec.names), len(rec.names), 1).T.tolist():
        both = (shown[i] & shown[j]).nonzero()[:count, 0]
        rows.append((torch.full_like(both, i), torch.full_like(both, j), pixels[i, both], pixels[j, both]))
    i, j, xy_i, xy_j = (torch.cat(column) for column in zip(*rows, strict=True))
    return replace(rec, matches=Matches(i, j, xy_i.float(), xy_j.float(), torch.ones(len(i))))


def disturbed(rec, degrees: float, share: float):
    """Every camera turned about its own random axis, and moved by a share of the scene's size."""
    rng = torch.Generator().manual_seed(1)
    poses, n = rec.cameras.cam2world, len(rec.names)
    axis, way = torch.nn.functional.normalize(torch.randn(2, n, 3, generator=rng, dtype=torch.float64), dim=-1)
    R = poses[:, :3, :3] @ so3_exp(axis * torch.deg2rad(torch.tensor(degrees)))
    centers = poses[:, :3, 3] + share * training_poses.spread_of(poses) * way
    return replace(rec, cameras=replace(rec.cameras, cam2world=pose_from(R, centers)))


def poses(dive, rec, settings: UwbsSettings):
    views = TrainingViews(rec, dive.frames, settings, 1.0)
    return training_poses_of(rec, views.names, views.cameras, 1.0)


def test_zero_codes_leave_every_pose_where_it_is(tiny_dive):
    s = poses(tiny_dive, tiny_dive.rec, UwbsSettings())
    codes = PoseMlp(len(s), TrainingPoseSettings())
    torch.testing.assert_close(s.moved(codes), s.cameras.cam2world)
    total = s.moved(codes)[:, :3, 3].sum()
    last: Any = codes.network[4]
    learns = torch.autograd.grad(total, last.weight)[0]
    assert (learns != 0).any()  # the last layer is zero, what it reads is not


def test_a_motion_is_made_in_the_cameras_own_axes():
    pose = pose_from(so3_exp(torch.tensor([0.0, 0.0, torch.pi / 2])), torch.tensor([1.0, 2.0, 3.0])).double()
    forward = torch.tensor([0.5, 0.0, 0.0, 0, 0, 0, 0, 0, 0])
    torch.testing.assert_close(
        moved(pose, forward, 2.0)[:3, 3], torch.tensor([1.0, 3.0, 3.0]).double(), atol=1e-6, rtol=0
    )


def test_true_matches_under_true_poses_cost_nothing_and_weigh_by_confidence(tiny_dive):
    rec = matched(tiny_dive)
    s = poses(tiny_dive, rec, UwbsSettings())
    assert epipolar_loss(s.matches, s.cameras.cam2world, s.cameras.K, s.spread) < 1e-3
    wrong = replace(s.matches, xy_j=s.matches.xy_j + torch.tensor([0.0, 3.0]))
    every = epipolar_loss(wrong, s.cameras.cam2world, s.cameras.K, s.spread)
    assert every > 1
    half = torch.arange(len(wrong.i)) % 2 == 0
    mixed = replace(s.matches, xy_j=torch.where(half[:, None], wrong.xy_j, s.matches.xy_j))
    silent = replace(mixed, confidence=torch.where(half, 0.0, 1.0).double())
    assert epipolar_loss(silent, s.cameras.cam2world, s.cameras.K, s.spread) < 1e-3


def test_cameras_in_one_place_have_no_say(tiny_dive):
    rec = matched(tiny_dive)
    s = poses(tiny_dive, rec, UwbsSettings())
    same = s.cameras.cam2world.clone().requires_grad_()
    loss = epipolar_loss(s.matches, same * 0 + torch.eye(4, dtype=torch.float64), s.cameras.K, s.spread)
    assert loss == 0


def test_matches_are_read_at_the_size_and_shape_of_the_training_images(tiny_dive):
    rec = matched(tiny_dive)
    small = poses(tiny_dive, rec, UwbsSettings(long_side=32))
    torch.testing.assert_close(small.matches.xy_i, rec.matches.xy_i.double() / 2)
    fewer = tiny_dive.rec.names[2:5]
    cameras = small.cameras[[2, 3, 4]]
    kept = epipolar_matches(rec, fewer, cameras)
    assert set(kept.i.tolist()) | set(kept.j.tolist()) == {0, 1, 2}


REFINED = UwbsSettings(
    iterations=300,
    initial=InitialSettings(primitives=500, scale=2.0),
    densify=DensifySettings(cap_max=600, min_refine_every=20),
    poses=TrainingPoseSettings(epipolar_end=0.75),
)


def test_disturbed_poses_recover_while_the_map_is_trained(tiny_dive, tmp_path):
    """Two degrees and 2 % of the cameras' spread, to half a degree."""
    true = matched(tiny_dive)
    rec = disturbed(true, 2.0, 0.02)
    before = absolute_pose_errors(rec.cameras.cam2world, true.cameras.cam2world)
    scene = train(rec, tiny_dive.frames, REFINED, tmp_path)
    after = absolute_pose_errors(scene.poses.cam2world, true.cameras.cam2world)
    assert before.rotation_deg > 1.5
    assert after.rotation_deg < 0.5
    stored = load_map(tmp_path / "map.safetensors")
    assert torch.equal(stored.poses.cam2world, scene.poses.cam2world)
    table = read_cameras(tmp_path / "cameras.json")
    assert table.names == scene.poses.names == rec.names
    assert torch.equal(training_poses.as_mapped(rec, scene.poses).cameras.cam2world, scene.poses.cam2world)
    torch.testing.assert_close(torch.from_numpy(table.cam2world), scene.poses.cam2world)


def test_short_runs_step_farther_and_the_papers_is_exact():
    assert pose_rate(TrainingPoseSettings(), 20_000) == 1.5e-4
    assert pose_rate(TrainingPoseSettings(), 2_000) == pytest.approx(1.5e-3)
    assert pose_rate(TrainingPoseSettings(), 10) == 2e-3


def test_poses_that_are_held_stay(tiny_dive, tmp_path):
    held = replace(REFINED, iterations=4, poses=TrainingPoseSettings(enabled=False))
    assert train(matched(tiny_dive), tiny_dive.frames, held, tmp_path).poses is None
    assert not (tmp_path / "cameras.json").exists()


def test_a_held_out_frame_follows_the_training_cameras_when_they_move_together(tiny_dive):
    rec = tiny_dive.rec
    turn = so3_exp(torch.tensor([0.1, 0.2, -0.1], dtype=torch.float64))
    poses = rec.cameras.cam2world
    moved = pose_from(turn @ poses[:, :3, :3], 1.1 * poses[:, :3, 3] @ turn.mT + torch.tensor([1.0, 0, 2.0]))
    scene = SplatMap(
        tiny_dive.truth.primitives, tiny_dive.truth.field, tiny_dive.truth.settings, True, 1.0,
        poses=training_poses.RefinedPoses(rec.names, moved),
    )  # fmt: skip
    found = in_axes_of(scene, rec, {"a": FirstPose(poses[2], "neighbors")})
    torch.testing.assert_close(found["a"].cam2world, moved[2])
    assert found["a"].cam2world[:3, :3].det().item() == pytest.approx(1)
