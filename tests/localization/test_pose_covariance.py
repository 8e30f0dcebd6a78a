"""Covariance of poses against the errors of poses."""

from dataclasses import replace

import pytest
import torch

from swimm3r.cameras import Cameras, project
from swimm3r.geometry import pose_from, so3_exp, so3_log
from swimm3r.imaging.turned_rows import filmed_pixels, half_time_pixels
from swimm3r.localization.pose_covariance import pose_covariance
from swimm3r.sfm.colmap.absolute_pose import absolute_pose
from swimm3r.sfm.colmap.shutter.turning import EXPECTED_TURN, turned_pose

POSE = pose_from(
    so3_exp(torch.tensor([0.4, -0.9, 0.3], dtype=torch.float64)), torch.tensor([3.0, -2.0, 5.0], dtype=torch.float64)
)


def camera() -> Cameras:
    K = torch.tensor([[[600.0, 0, 322], [0, 600, 238], [0, 0, 1]]], dtype=torch.float64)
    return Cameras(K, torch.tensor([[0.02]], dtype=torch.float64), POSE[None], 640, 480, "SIMPLE_RADIAL")


def scene(count: int, rng: torch.Generator) -> torch.Tensor:
    """Points before the camera, 1.5 to 3 units away."""
    seen = torch.rand(count, 3, generator=rng, dtype=torch.float64) * torch.tensor([1.0, 0.75, 1.5])
    z = 1.5 + seen[:, 2:]
    inside = torch.cat([(seen[:, :1] - 0.5) * z, (seen[:, 1:2] - 0.375) * z, z], 1)
    return inside @ POSE[:3, :3].mT + POSE[:3, 3]


def solved(points: torch.Tensor, pixels: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
    """Error of the pose in the map's axes, and its covariance."""
    found = absolute_pose(pixels, points, camera(), 4.0)
    assert found is not None
    pose, inlier = found
    error = torch.cat([POSE[:3, 3] - pose[:3, 3], so3_log(POSE[:3, :3] @ pose[:3, :3].mT)])
    return error, pose_covariance(camera(), pose, points[inlier], pixels[inlier])


def mean_squared_error(noise: float, trials: int = 150, wrong: int = 0, count: int = 150, shared: float = 0.0) -> float:
    """Mean over trials of the squared error in units of its covariance: 6 where the covariance is right."""
    rng = torch.Generator().manual_seed(0)
    total = 0.0
    for _ in range(trials):
        points = scene(count, rng)
        pixels = project(camera(), points[None])[0][0]
        cell = (pixels / 110).long() @ torch.tensor([1, 10])
        moved = pixels + shared * torch.randn(100, 2, generator=rng, dtype=torch.float64)[cell]
        moved = moved + noise * torch.randn(count, 2, generator=rng, dtype=torch.float64)
        moved[:wrong] += 60 * torch.rand(wrong, 2, generator=rng, dtype=torch.float64)
        error, covariance = solved(points, moved)
        total += float(error @ torch.linalg.solve(covariance, error))
    return total / trials


@pytest.mark.parametrize("noise", [0.2, 0.6, 1.0])
def test_errors_are_as_large_as_the_covariance_says(noise: float):
    assert 4.3 < mean_squared_error(noise) < 7.2


def test_wrong_matches_do_not_change_that():
    assert 4.0 < mean_squared_error(0.5, wrong=45) < 7.5


def test_errors_that_neighbors_share_are_counted():
    """Twenty times as large as the noise of single points; counted as independent, the mean would be far above 20."""
    assert mean_squared_error(0.1, trials=60, count=600, shared=0.6) < 14


@pytest.mark.long
def test_a_turn_while_rows_were_exposed_is_an_unknown_too():
    """Turns are drawn as they are expected."""
    rng = torch.Generator().manual_seed(4)
    squared, without, trials = 0.0, 0.0, 100
    for _ in range(trials):
        points = scene(150, rng)
        turn = EXPECTED_TURN * torch.randn(3, generator=rng, dtype=torch.float64).numpy()
        pixels = filmed_pixels(camera(), project(camera(), points[None])[0][0], turn)
        pixels = pixels + 0.5 * torch.randn(150, 2, generator=rng, dtype=torch.float64)
        pose, found = turned_pose(camera(), pixels, points)
        error = torch.cat([POSE[:3, 3] - pose[:3, 3], so3_log(POSE[:3, :3] @ pose[:3, :3].mT)])
        covariance = pose_covariance(camera(), pose, points, pixels, found)
        squared += float(error @ torch.linalg.solve(covariance, error))
        known = pose_covariance(camera(), pose, points, half_time_pixels(camera(), pixels, found))
        without += float(error @ torch.linalg.solve(known, error))
    assert 4.0 < squared / trials < 7.2
    assert without > 1.25 * squared


def test_covariance_is_of_the_maps_axes():
    rng = torch.Generator().manual_seed(1)
    points = scene(400, rng)
    pixels = project(camera(), points[None])[0][0]
    pixels = pixels + 0.5 * torch.randn(400, 2, generator=rng, dtype=torch.float64)
    covariance = pose_covariance(camera(), POSE, points, pixels)
    turn = so3_exp(torch.tensor([0.2, 0.5, -1.0], dtype=torch.float64))
    pose = pose_from(turn @ POSE[:3, :3], turn @ POSE[:3, 3])
    turned = pose_covariance(replace(camera(), cam2world=pose[None]), pose, points @ turn.mT, pixels)
    both = torch.block_diag(turn, turn)
    torch.testing.assert_close(turned, both @ covariance @ both.mT, rtol=1e-5, atol=1e-12)


def test_twice_the_unit_of_length_is_twice_the_error_of_the_place():
    rng = torch.Generator().manual_seed(2)
    points = scene(100, rng)
    pixels = project(camera(), points[None])[0][0] + 0.3 * torch.randn(100, 2, generator=rng, dtype=torch.float64)
    covariance = pose_covariance(camera(), POSE, points, pixels)
    large = pose_covariance(camera(), pose_from(POSE[:3, :3], 2 * POSE[:3, 3]), 2 * points, pixels)
    unit = torch.tensor([2.0, 2, 2, 1, 1, 1], dtype=torch.float64)
    torch.testing.assert_close(large, covariance * unit[:, None] * unit, rtol=1e-4, atol=1e-12)


def test_points_on_a_line_determine_no_pose():
    along = torch.linspace(-0.5, 0.5, 40, dtype=torch.float64)[:, None]
    seen = along * torch.tensor([1.0, 0.3, 0.2]) + torch.tensor([0.0, 0.0, 2.0])
    points = seen.double() @ POSE[:3, :3].mT + POSE[:3, 3]
    pixels = project(camera(), points[None])[0][0]
    rng = torch.Generator().manual_seed(3)
    noisy = pixels + 0.3 * torch.randn(40, 2, generator=rng, dtype=torch.float64)
    deviation = pose_covariance(camera(), POSE, points, noisy).diagonal().sqrt()
    assert float(deviation.max()) > 10  # of a scene 2 units away: anything goes, or infinite
