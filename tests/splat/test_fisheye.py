"""Maps drawn through a fisheye lens, border included."""

import math
from dataclasses import replace

import pytest
import torch

from swimm3r.cameras import Cameras, image_directions, project
from swimm3r.imaging.undistortion import undistorted
from swimm3r.splat.medium.field import ray_lengths
from swimm3r.splat.projection import view_camera as camera_module
from swimm3r.splat.projection.conditioning import Conditioned
from swimm3r.splat.projection.observed import coverage_from, coverage_of
from swimm3r.splat.projection.plain import project_conditioned
from swimm3r.splat.projection.view_camera import view_camera
from swimm3r.splat.settings import RenderSettings
from swimm3r.splat.shared_settings import DILATION

LENS = (0.02, -0.01, 0.004, -0.001)


def camera(distortion: tuple[float, ...] = LENS, model: str = "OPENCV_FISHEYE") -> Cameras:
    """A camera of 150 degrees across the diagonal, turned and off the origin."""
    angle = torch.tensor(0.3, dtype=torch.float64)
    pose = torch.eye(4, dtype=torch.float64)
    pose[:2, :2] = torch.stack([torch.stack([angle.cos(), -angle.sin()]), torch.stack([angle.sin(), angle.cos()])])
    pose[:3, 3] = torch.tensor([0.1, -0.2, 0.05])
    focal = math.hypot(96, 64) / 2 / math.radians(75)
    K = torch.tensor([[[focal, 0, 47.0], [0, focal, 33.0], [0, 0, 1]]], dtype=torch.float64)
    return Cameras(K, torch.tensor([distortion], dtype=torch.float64), pose[None], 96, 64, model)


def points(count: int = 60) -> torch.Tensor:
    """World points all over the view of the camera, its corners included."""
    rays = (
        image_directions(replace(camera(), cam2world=torch.eye(4, dtype=torch.float64)[None])).double().reshape(-1, 3)
    )
    some = torch.linspace(0, len(rays) - 1, count).long()
    z = torch.linspace(0.5, 3, count, dtype=torch.float64)[:, None]
    pose = camera().cam2world[0]
    return (rays[some] * z) @ pose[:3, :3].T + pose[:3, 3]


def drawn(xyz: torch.Tensor, spread: float, cam: Cameras):
    covariance = spread**2 * torch.eye(3, dtype=torch.float64).expand(len(xyz), 3, 3)
    ones = torch.ones(len(xyz), dtype=torch.float64)
    seen = Conditioned(xyz, covariance, ones)
    return project_conditioned(
        seen, ones, xyz, view_camera(cam, torch.float64), RenderSettings(antialiasing="dilation")
    ).primitives


def test_primitives_stand_where_the_camera_has_their_points():
    pixels, z = project(camera(), points()[None])
    primitives = drawn(points(), 0.01, camera())
    torch.testing.assert_close(primitives.mean2d, pixels[0])
    torch.testing.assert_close(primitives.depth, z[0])


def test_their_extent_is_that_of_points_around_them():
    xyz, step = points(), 1e-5
    moves = torch.eye(3, dtype=torch.float64)
    columns = [
        (project(camera(), (xyz + step * e)[None])[0][0] - project(camera(), (xyz - step * e)[None])[0][0]) / (2 * step)
        for e in moves
    ]
    J = torch.stack(columns, -1)
    expected = 0.05**2 * J @ J.mT + DILATION * torch.eye(2, dtype=torch.float64)
    a, b, c = drawn(xyz, 0.05, camera()).conic.unbind(-1)
    found = torch.linalg.inv(torch.stack([a, b, b, c], -1).unflatten(-1, (2, 2)))
    torch.testing.assert_close(found, expected, rtol=1e-5, atol=1e-6)


def test_gradients_are_those_of_finite_differences():
    weights = torch.randn(12, 6, generator=torch.Generator().manual_seed(0), dtype=torch.float64)

    def some(xyz: torch.Tensor) -> torch.Tensor:
        p = drawn(xyz, 0.05, camera())
        return (torch.cat([p.mean2d, p.conic, p.depth[:, None]], -1) * weights).sum()

    assert torch.autograd.gradcheck(some, points(12).requires_grad_(), eps=1e-7, atol=1e-4)


def test_near_the_axis_a_fisheye_is_a_pinhole():
    axis = torch.tensor([[0.0, 0.0, 1.0], [1e-4, -2e-4, 2.0]], dtype=torch.float64)
    still = torch.eye(4, dtype=torch.float64)[None]
    fisheye = drawn(axis, 0.05, replace(camera(), cam2world=still))
    straight = drawn(axis, 0.05, replace(camera((), "PINHOLE"), cam2world=still))
    torch.testing.assert_close(fisheye.mean2d, straight.mean2d, atol=1e-5, rtol=0)
    torch.testing.assert_close(fisheye.conic, straight.conic, atol=1e-6, rtol=1e-4)


def test_the_water_s_rays_are_those_of_the_camera():
    lengths = torch.linalg.vector_norm(image_directions(camera()), dim=-1)
    torch.testing.assert_close(ray_lengths(view_camera(camera())), lengths.float(), rtol=1e-4, atol=0)


def test_the_rays_of_a_lens_are_found_once_whatever_the_pose(monkeypatch: pytest.MonkeyPatch):
    first = view_camera(camera((0.03, 0.0, 0.0, 0.0)))
    lengths = ray_lengths(first)
    monkeypatch.setattr(camera_module, "undistort", None)
    assert torch.equal(ray_lengths(first.shifted(torch.ones(3))), lengths)


def test_a_fisheye_s_frame_is_drawn_whole_and_unchanged():
    canvas = camera().drawn(0)
    assert (canvas.model, canvas.width, canvas.height) == ("OPENCV_FISHEYE", 96, 64)
    image = torch.rand(64, 96, 3, generator=torch.Generator().manual_seed(2))
    shown, seen = undistorted(image, torch.ones(64, 96, dtype=torch.bool), camera(), canvas)
    assert bool(seen.all())
    torch.testing.assert_close(shown, image)


def test_a_smaller_canvas_shows_the_same_field():
    half = camera().drawn(48)
    corner = image_directions(camera())[:2, :2].reshape(-1, 3).mean(0)
    torch.testing.assert_close(image_directions(half)[0, 0], corner, rtol=0.05, atol=0)


def test_other_distortion_is_not_drawn():
    assert camera((0.1, 0.0, 0.0, 0.0), "OPENCV").drawn().model == "PINHOLE"
    with pytest.raises(ValueError, match=r"camera\.drawn\(\)"):
        view_camera(camera((0.1, 0.0, 0.0, 0.0), "OPENCV"))


def test_the_record_of_seen_parts_keeps_the_lens():
    small = camera().drawn(24)
    record = coverage_of(small, [torch.ones(16, 24)], [torch.ones(16, 24)], [torch.ones(16, 24, dtype=torch.bool)])
    again = coverage_from(record.tensors())
    assert again is not None
    assert again.cameras.model == "OPENCV_FISHEYE"
    corner = torch.nn.functional.normalize(image_directions(camera())[1, 1].double(), dim=0)
    pose = camera().cam2world[0]
    at_the_border = pose[:3, 3] + 0.5 * corner / corner[2].clamp(min=0.2) @ pose[:3, :3].T
    assert bool(again.sees(at_the_border[None]).all())
