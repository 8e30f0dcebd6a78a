"""Distance of a moving object by its trajectory before a moving camera."""

import math

import pytest
import torch

from swimm3r.cameras import Cameras, project
from swimm3r.splat.dynamic.trajectory import course

COUNT, FOCAL = 13, 450.0
TIMES = torch.arange(COUNT).double()


def cameras(way: str) -> Cameras:
    """Twelve intervals of a loop a metre wide, of a straight line, or on the spot; all look along z."""
    poses = torch.eye(4, dtype=torch.float64).repeat(COUNT, 1, 1)
    turn = 2 * math.pi * TIMES / 20
    if way == "loop":
        poses[:, 0, 3], poses[:, 1, 3], poses[:, 2, 3] = turn.cos(), 0.2 * (2 * turn).sin(), 0.5 * turn.sin()
    elif way == "straight":
        poses[:, 0, 3] = 0.1 * TIMES
    K = torch.tensor([[FOCAL, 0, 240], [0, FOCAL, 160], [0, 0, 1]], dtype=torch.float64).repeat(COUNT, 1, 1)
    return Cameras(K, torch.zeros(COUNT, 0, dtype=torch.float64), poses, 480, 320)


def swimmer(rate: float = 0.06) -> torch.Tensor:
    """Two metres away, gently turning."""
    return torch.stack([rate * TIMES - 0.3, 0.1 * (TIMES / 6).sin(), 2 + 0.02 * TIMES], -1)


def z_depth(there: Cameras, xyz: torch.Tensor) -> torch.Tensor:
    return project(there, xyz[:, None])[1][:, 0]


@pytest.mark.parametrize("noise", [0.0, 1.0])
@pytest.mark.parametrize("assumed", [1.2, 4.5])
def test_a_camera_that_goes_another_way_sees_how_far_away_it_is(noise, assumed):
    there, xyz = cameras("loop"), swimmer()
    pixels = project(there, xyz[:, None])[0][:, 0]
    pixels = pixels + noise * torch.randn(COUNT, 2, generator=torch.Generator().manual_seed(0), dtype=torch.float64)
    found = course(there, pixels, TIMES, torch.full((COUNT,), assumed))
    ratio = z_depth(there, found) / z_depth(there, xyz)
    assert (ratio.log().abs() < math.log(1.1)).all()


def test_frames_left_out_do_not_change_the_course():
    there, xyz = cameras("loop"), swimmer()
    kept = [0, 1, 2, 4, 5, 8, 9, 10, 12]
    pixels = project(there, xyz[:, None])[0][:, 0]
    found = course(there[kept], pixels[kept], TIMES[kept], torch.full((len(kept),), 3.0))
    ratio = z_depth(there[kept], found) / z_depth(there, xyz)[kept]
    assert (ratio.log().abs() < math.log(1.1)).all()


@pytest.mark.parametrize("assumed", [1.0, 4.0])
def test_a_camera_on_the_spot_leaves_the_distance_as_assumed(assumed):
    there, xyz = cameras("spot"), swimmer(rate=0.0)
    pixels = project(there, xyz[:, None])[0][:, 0]
    z = z_depth(there, course(there, pixels, TIMES, torch.full((COUNT,), assumed)))
    assert ((z / assumed).log().abs() < math.log(1.1)).all()


def test_a_camera_that_goes_along_with_it_learns_little():
    """Straight and evenly beside what swims straight and evenly: any distance does."""
    there, xyz = cameras("straight"), torch.stack([0.1 * TIMES, 0 * TIMES, 2 + 0 * TIMES], -1)
    pixels = project(there, xyz[:, None])[0][:, 0]
    z = z_depth(there, course(there, pixels, TIMES, torch.full((COUNT,), 3.0)))
    assert (z > 2.5).all()


def test_one_observation_lies_on_its_ray_at_the_assumed_distance():
    there = cameras("loop")[[3]]
    pixel = torch.tensor([[100.0, 200.0]])
    found = course(there, pixel, TIMES[3:4], torch.tensor([2.5]))
    pixels, z = project(there, found[:, None])
    torch.testing.assert_close(pixels[:, 0], pixel.double())
    torch.testing.assert_close(z[:, 0], torch.tensor([2.5], dtype=torch.float64))
