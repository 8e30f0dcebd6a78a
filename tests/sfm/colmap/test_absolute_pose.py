"""A camera from points and their pixels, wrong ones among them."""

import torch
from tests.sfm.colmap.two_planes import camera_path

from swimm3r.cameras import project
from swimm3r.sfm.colmap.absolute_pose import absolute_pose


def test_pnp_finds_the_pose_among_outliers() -> None:
    truth = camera_path()[2]
    generator = torch.Generator().manual_seed(0)
    points = torch.rand(100, 3, generator=generator, dtype=torch.float64) * 2 + torch.tensor([-1.0, -1, 2.5])
    pixels, _ = project(truth, points[None])
    pixels = pixels[0].clone()
    pixels[:30] += 50 * torch.rand(30, 2, generator=generator, dtype=torch.float64) + 20
    found = absolute_pose(pixels, points, truth)
    assert found is not None
    pose, inliers = found
    torch.testing.assert_close(pose, truth.cam2world[0], atol=1e-4, rtol=0)
    assert inliers.tolist() == [False] * 30 + [True] * 70


def test_pnp_without_a_consistent_pose_finds_none() -> None:
    generator = torch.Generator().manual_seed(0)
    pixels = torch.rand(3, 2, generator=generator) * 200
    assert absolute_pose(pixels, torch.zeros(3, 3), camera_path()[0]) is None
