"""The central lens of a port: exact where it should be, off by what it says elsewhere."""

import pytest
import torch

from swimm3r.cameras import Cameras, directions, project
from swimm3r.refraction.central import CameraInWater, camera_in_water
from swimm3r.refraction.ports import DomePort, FlatPort, Port

FLAT = FlatPort(0.05, 0.01, 1.49, 1.333)
DISTANCES = torch.tensor([0.5, 1.0, 1.5, 3.0, 5.0])


def lens(model: str = "PINHOLE", focal: float = 450.0, distortion: tuple[float, ...] = ()) -> Cameras:
    K = torch.tensor([[[focal, 0, 236.0], [0, focal, 163.0], [0, 0, 1]]], dtype=torch.float64)
    pose = torch.eye(4, dtype=torch.float64)[None]
    return Cameras(K, torch.tensor([distortion], dtype=torch.float64).reshape(1, -1), pose, 480, 320, model)


def some_pixels() -> torch.Tensor:
    generator = torch.Generator().manual_seed(1)
    return torch.rand(200, 2, generator=generator, dtype=torch.float64) * torch.tensor([480.0, 320.0])


@pytest.mark.parametrize(
    ("port", "focal"),
    [(DomePort(0.05, 0.004, 0.05, 1.49, 1.333), 450.0), (FlatPort(0.02, 0.01, 1.0, 1.0), 450.0)],
)
def test_where_rays_meet_the_central_lens_is_the_lens_in_air(port: Port, focal: float):
    housed = camera_in_water(lens(focal=focal), port, 1.5)
    assert housed.center == pytest.approx(0, abs=1e-9)
    torch.testing.assert_close(housed.central.K, housed.lens.K, atol=1e-5, rtol=0)
    assert max(error.largest for error in housed.errors(DISTANCES)) < 1e-6


def test_a_port_at_the_pupil_has_the_same_error_at_all_distances():
    housed = camera_in_water(lens(), FlatPort(0.0, 0.0, 1.49, 1.333), 1.5)
    errors = [error.rms for error in housed.errors(DISTANCES)]
    assert errors == pytest.approx([errors[0]] * 5, rel=1e-6)
    assert errors[0] < 0.01


@pytest.mark.parametrize(
    ("model", "distortion"),
    [
        ("PINHOLE", ()),
        ("SIMPLE_RADIAL", (-0.1,)),
        ("OPENCV", (-0.1, 0.02, 0.001, -0.002)),
        ("OPENCV_FISHEYE", (0.0,) * 4),
    ],
)
@pytest.mark.parametrize("port", [FLAT, DomePort(0.06, 0.005, 0.05, 1.49, 1.333)])
def test_the_central_lens_is_exact_at_its_distance(model: str, distortion: tuple[float, ...], port: Port):
    housed = camera_in_water(lens(model, 450.0, distortion), port, 1.5)
    near, _, there, *_, far = housed.errors(DISTANCES)
    assert there.rms < 0.02
    assert there.largest < 0.15
    assert near.rms >= there.rms
    assert far.rms >= there.rms


def test_the_error_of_a_flat_port_grows_with_the_difference_of_inverse_distances():
    housed = camera_in_water(lens(), FLAT, 1.5)
    inverse = 1 / (DISTANCES.double() + housed.outside)
    off = torch.tensor([error.rms for error in housed.errors(DISTANCES)], dtype=torch.float64)
    slope = off / (inverse - inverse[2]).abs().clamp(min=1e-9)
    assert slope[0] == pytest.approx(float(slope[4]), rel=0.1)
    assert off[0] > 0.2


def test_shifted_pixels_are_those_of_the_central_camera():
    housed = camera_in_water(lens(), FLAT, 1.5)
    pixels = some_pixels()
    z = torch.linspace(0.4, 6.0, len(pixels), dtype=torch.float64)
    seen, depth = project(housed.central, housed.points(pixels, z)[None])
    torch.testing.assert_close(depth[0], z)
    torch.testing.assert_close(seen[0], pixels + housed.shift(pixels, z))


def test_exact_points_lie_on_straight_rays_that_pass_the_center_at_a_distance():
    housed = camera_in_water(lens(), FLAT, 1.5)
    pixels = torch.tensor([[10.0, 12.0]], dtype=torch.float64)
    a, b, c = (housed.points(pixels, z)[0] for z in (0.5, 1.0, 3.0))
    torch.testing.assert_close(
        torch.linalg.cross(b - a, c - a), torch.zeros(3, dtype=torch.float64), atol=1e-12, rtol=0
    )
    assert 1e-4 < float(torch.linalg.vector_norm(torch.linalg.cross(a, c - a)) / torch.linalg.vector_norm(c - a)) < 5e-3


def test_the_center_is_where_squared_distances_to_the_rays_are_least():
    housed = camera_in_water(lens(), FLAT, 1.5)

    def spread(shift: float) -> float:
        moved = CameraInWater(housed.lens, housed.port, housed.center + shift, housed.central)
        x, y = torch.meshgrid(torch.linspace(0, 480, 41), torch.linspace(0, 320, 41), indexing="xy")
        grid = torch.stack([x, y], -1).reshape(-1, 2).double()
        a, b = moved.points(grid, 1.0), moved.points(grid, 2.0)
        along = torch.nn.functional.normalize(b - a, dim=-1)
        return float(torch.linalg.cross(a, along).square().sum())

    assert spread(0.0) < min(spread(1e-3), spread(-1e-3))
    assert -0.03 < housed.center < -0.01


def test_the_principal_point_stays_where_it_is():
    housed = camera_in_water(lens(), FLAT, 1.5)
    middle = directions(housed.central, torch.tensor([[[236.0, 163.0]]], dtype=torch.float64))
    torch.testing.assert_close(middle[0, 0], torch.tensor([0.0, 0.0, 1.0], dtype=torch.float64))
