"""Virtual views beside and below a camera, and their images brought back to it."""

import pytest
import torch
from torch.autograd import gradcheck

from swimm3r.cameras import Cameras
from swimm3r.splat.gaussian_settings import VirtualViewSettings
from swimm3r.splat.projection.view_camera import ViewCamera, view_camera
from swimm3r.splat.training.trinocular import (
    camera_points,
    disparity_roughness,
    inverse_warp,
    relative_l1,
    virtual_shifts,
)

SHIFTS = torch.tensor([[0.24, 0, 0], [0, -0.16, 0]]).double()


def view(width: int = 40, height: int = 30, fisheye: bool = False) -> ViewCamera:
    K = torch.tensor([[[38.0, 0, 21], [0, 36, 14], [0, 0, 1]]]).double()
    bent = torch.tensor([[0.05, -0.01, 0.002, 0.0]] if fisheye else [[]]).double().reshape(1, -1)
    model = "OPENCV_FISHEYE" if fisheye else "PINHOLE"
    return view_camera(Cameras(K, bent, torch.eye(4).double()[None], width, height, model), torch.float64)


def texture(points: torch.Tensor) -> torch.Tensor:
    """Colors of points on a surface, smooth in X and Y."""
    X, Y, _ = points.unbind(-1)
    return torch.stack([0.6 + 0.2 * X, 0.5 + 0.2 * Y, 0.6 + 0.1 * X - 0.2 * Y])


def plane_depth(of: ViewCamera, slope: float, shift: torch.Tensor) -> torch.Tensor:
    """Depth of the plane Z = 3 + slope X as a camera sees it in whose axes points are farther by `shift`."""
    x, y = (torch.arange(n).double() + 0.5 for n in (of.width, of.height))
    u = of.rays(x, y)[..., 0]
    return (3 - slope * shift[0]) / (1 - slope * u)


@pytest.mark.parametrize("fisheye", [False, True])
@pytest.mark.parametrize("slope", [0.0, 0.25])
def test_a_plane_seen_with_exact_depth_is_the_same_from_every_virtual_camera(slope: float, fisheye: bool):
    of = view(fisheye=fisheye)
    D = plane_depth(of, slope, torch.zeros(3))
    own = texture(camera_points(D, of))
    for shift in SHIFTS:
        virtual = texture(camera_points(plane_depth(of, slope, shift), of) - shift)
        warped = inverse_warp(virtual, D, of, shift)
        assert warped.inside.double().mean() > 0.7
        assert relative_l1(warped.image, own, warped.inside, 1e-3) < 5e-4
        wrong = inverse_warp(virtual, 1.3 * D, of, shift)
        assert relative_l1(wrong.image, own, wrong.inside, 1e-3) > 0.005


def test_a_pinhole_is_warped_by_the_disparity_of_its_focal_length_and_baseline():
    of = view()
    ramp = (torch.arange(40).double() + 0.5).expand(1, 30, 40)
    D = torch.full((30, 40), 4.0).double()
    moved = inverse_warp(ramp, D, of, SHIFTS[0])
    torch.testing.assert_close(
        (moved.image - ramp)[:, moved.inside], torch.full_like(ramp, 38 * 0.24 / 4)[:, moved.inside]
    )


def test_pixels_are_the_inverse_of_rays():
    for fisheye in (False, True):
        of = view(fisheye=fisheye)
        x, y = (torch.arange(n).double() + 0.5 for n in (of.width, of.height))
        at = of.pixels(3.7 * of.rays(x, y))
        torch.testing.assert_close(at, torch.stack(torch.meshgrid(x, y, indexing="xy"), -1), atol=1e-6, rtol=0)


def test_points_of_a_shifted_camera_are_farther_by_the_shift():
    camera = Cameras(
        torch.eye(3).double()[None], torch.zeros(1, 0).double(), torch.eye(4).double()[None].clone(), 40, 30
    )
    camera.cam2world[0, :3, :3] = torch.tensor([[0.0, -1, 0], [1, 0, 0], [0, 0, 1]])
    camera.cam2world[0, :3, 3] = torch.tensor([0.3, -0.2, 0.5])
    of, X = view_camera(camera, torch.float64), torch.tensor([1.0, 2, 3]).double()
    beside = of.shifted(SHIFTS[0])
    torch.testing.assert_close(beside.R @ X + beside.t, of.R @ X + of.t + SHIFTS[0])
    torch.testing.assert_close(beside.R @ beside.center + beside.t, torch.zeros(3).double())


def test_baselines_are_unequal_and_in_units_of_depth():
    rng, settings = torch.Generator().manual_seed(0), VirtualViewSettings()
    drawn = torch.stack([virtual_shifts(settings, 2.0, rng) for _ in range(200)])
    b_h, b_v = drawn[:, 0, 0], drawn[:, 1, 1]
    torch.testing.assert_close(b_h, 1.5 * b_v)
    assert 0.75 < b_v.abs().max() <= 0.8
    assert b_v.min() < 0 < b_v.max()
    assert (drawn != 0).sum() == 400


def test_the_warp_has_the_gradients_of_image_and_depth():
    of = view(7, 5)
    rng = torch.Generator().manual_seed(0)
    image = torch.rand(2, 5, 7, generator=rng).double().requires_grad_()
    D = (2 + torch.rand(5, 7, generator=rng).double()).requires_grad_()
    assert gradcheck(lambda I, z: inverse_warp(I, z, of, SHIFTS[0]).image, (image, D))


def test_relative_errors_have_the_gradient_of_a_fixed_unit():
    rng = torch.Generator().manual_seed(0)
    a, b = torch.rand(2, 3, 4, 5, generator=rng).double()
    counted = torch.rand(4, 5, generator=rng) > 0.3
    unit = a + 1e-2
    a.requires_grad_()
    relative_l1(a, b, counted, 1e-2).backward()
    expected = torch.where(counted, (a - b).sign() / unit, 0.0) / (3 * counted.sum())
    torch.testing.assert_close(a.grad, expected.detach())
    assert relative_l1(a, b, counted & False, 1e-2) == 0


def test_smoothness_knows_neither_unit_nor_edges_of_the_image():
    rng = torch.Generator().manual_seed(0)
    D, rgb = 2 + torch.rand(6, 8, generator=rng).double(), torch.rand(3, 6, 8, generator=rng).double()
    counted = torch.ones(6, 8, dtype=torch.bool)
    torch.testing.assert_close(disparity_roughness(7 * D, rgb, counted), disparity_roughness(D, rgb, counted))
    assert disparity_roughness(torch.full_like(D, 3.0), rgb, counted) == 0
    step = torch.where(torch.arange(8) < 4, 2.0, 4.0).double().expand(6, 8)
    edge = torch.where(torch.arange(8) < 4, 0.0, 1.0).double().expand(3, 6, 8)
    assert disparity_roughness(step, edge, counted) < 0.5 * disparity_roughness(step, 0 * edge, counted)
    D.requires_grad_()
    assert gradcheck(lambda z: disparity_roughness(z, rgb, counted), (D,))
