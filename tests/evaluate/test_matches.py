"""Matches of a known scene: exact ones agree, moved ones are as wrong as they were moved."""

import pytest
import torch

from swimm3r.evaluate import NotComputed, matches
from swimm3r.evaluate.matches import epipolar_errors, match_scores
from swimm3r.geometry import fundamental_from_poses, pose_from, so3_exp, symmetric_epipolar_error

K = torch.tensor([[[400.0, 0, 320], [0, 400, 240], [0, 0, 1]]]).double().repeat(4, 1, 1)


def dive(pairs: int = 5, points: int = 30) -> tuple[torch.Tensor, ...]:
    """Cameras above a cloud of points, and the true matches of the first `pairs` pairs."""
    g = torch.Generator().manual_seed(2)
    centers = torch.tensor([[0.0, 0, 0], [0.5, 0, 0], [1.0, 0.2, 0.1], [1.4, 0.6, 0.0]]).double()
    poses = pose_from(so3_exp(0.1 * torch.randn(4, 3, generator=g).double()), centers)
    world = torch.rand(points, 3, generator=g).double() * 2 + torch.tensor([-0.5, -1, 4.0])
    x = torch.einsum("npc,ndc->npd", (world - centers[:, None]) @ poses[:, :3, :3], K)
    pixels = x[..., :2] / x[..., 2:]
    i, j = torch.triu_indices(4, 4, 1)[:, :pairs].repeat_interleave(points, dim=1)
    point = torch.arange(points).repeat(pairs)
    return i, j, pixels[i, point], pixels[j, point], poses


def test_exact_matches_have_no_error():
    i, j, xy_i, xy_j, poses = dive()
    scores = match_scores(epipolar_errors(i, j, xy_i, xy_j, K, poses))
    assert scores.epipolar_px == pytest.approx(0, abs=1e-9)
    assert scores.inlier_1px == 1
    assert scores.matches == 150


def test_each_match_is_judged_by_its_own_pair(monkeypatch):
    monkeypatch.setattr(matches, "_CHUNK", 37)
    i, j, xy_i, xy_j, poses = dive()
    xy_j = xy_j + torch.randn(xy_j.shape, generator=torch.Generator().manual_seed(0)).double()
    errors = epipolar_errors(i, j, xy_i.float(), xy_j.float(), K.float(), poses)
    for m in (0, 40, 149):
        F = fundamental_from_poses(poses[i[m]], poses[j[m]], K[0], K[0])
        expected = symmetric_epipolar_error(F, xy_i[m], xy_j[m])
        assert errors[m].item() == pytest.approx(expected.item(), abs=1e-3)


def test_equal_distances_differ_by_the_root_of_two_between_the_forms():
    i, j, xy_i, xy_j, poses = dive(pairs=1)
    flat = pose_from(torch.eye(3).double().repeat(4, 1, 1), poses[:, :3, 3])  # rectified: both lines are rows
    xy_j = torch.cat((xy_i[:, :1] - 30, xy_i[:, 1:] + 0.8), -1)
    mean = epipolar_errors(i, j, xy_i, xy_j, K, flat)
    torch.testing.assert_close(mean, torch.full_like(mean, 0.8))
    root = epipolar_errors(i, j, xy_i, xy_j, K, flat, "root_sum_square")
    torch.testing.assert_close(root, mean * 2**0.5)


def test_inliers_are_counted_in_original_pixels():
    errors = torch.tensor([0.3, 0.45, 0.6, 2.0]).double()
    assert match_scores(errors).inlier_1px == 0.75
    halved = match_scores(errors, pixel_scale=2.0)
    assert halved.inlier_1px == 0.5
    assert halved.epipolar_px == pytest.approx(2 * 3.35 / 4)


def test_a_turn_on_the_spot_has_no_epipolar_geometry():
    i, j, xy_i, xy_j, poses = dive(pairs=1)
    poses = poses.clone()
    poses[:, :3, 3] = torch.tensor([1e5, 3.3, -7.1]).double()
    errors = epipolar_errors(i, j, xy_i, xy_j, K, poses)
    assert errors.isnan().all()
    scores = match_scores(errors)
    assert isinstance(scores.epipolar_px, NotComputed)
    assert "baseline" in scores.epipolar_px.reason
    assert scores.matches == 0


def test_no_matches_are_no_score():
    none = torch.zeros(0, dtype=torch.int64)
    errors = epipolar_errors(none, none, torch.zeros(0, 2).double(), torch.zeros(0, 2).double(), K, dive()[4])
    assert isinstance(match_scores(errors).inlier_1px, NotComputed)
