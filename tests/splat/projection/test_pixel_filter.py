"""Primitives no smaller than pixels: moments and light of filtered kernels, and the pixels that filters follow."""

from collections.abc import Callable
from dataclasses import replace

import pytest
import torch

from swimm3r.cameras import Cameras
from swimm3r.raster import Primitives2D, rasterize
from swimm3r.splat.gaussian_settings import GaussianRenderSettings
from swimm3r.splat.primitives.beta import BetaPrimitives
from swimm3r.splat.projection.conditioning import conditioned_in_view
from swimm3r.splat.projection.footprint import footprints
from swimm3r.splat.projection.pixel_filter import PIXEL, linear, widening, with_light_kept
from swimm3r.splat.projection.plain import project_plainly
from swimm3r.splat.projection.view_camera import view_camera
from swimm3r.splat.settings import RenderSettings

Make = Callable[..., BetaPrimitives]
MIP = RenderSettings(antialiasing="mip")
SETTINGS = {"beta": MIP, "gaussian": GaussianRenderSettings(antialiasing="mip")}
SHAPE = torch.tensor([[5.0, 1.5], [1.5, 2.0]], dtype=torch.float64)


def kernel(name: str, shape: torch.Tensor, exponent: float) -> tuple[float, torch.Tensor]:
    """Mass and covariance of a kernel of opacity 1 on the image plane, summed on a fine grid."""
    axis = torch.linspace(-30, 30, 3001, dtype=torch.float64)
    at = torch.stack(torch.meshgrid(axis, axis, indexing="ij"), -1)
    r2 = torch.einsum("xyi,ij,xyj->xy", at, torch.linalg.inv(shape), at)
    value = (1 - r2).clamp(min=0) ** exponent if name == "beta" else torch.exp(-exponent * r2)
    mass = value.sum()
    return float(mass * (axis[1] - axis[0]) ** 2), torch.einsum("xy,xyi,xyj->ij", value, at, at) / mass


@pytest.mark.parametrize(("name", "exponent"), [("beta", 0.6), ("beta", 4.0), ("beta", 11.0), ("gaussian", 0.5)])
def test_a_pixel_is_added_to_the_covariance_of_the_kernel_and_its_light_stays(name: str, exponent: float):
    settings = SETTINGS[name]
    wider = SHAPE + float(linear(widening(settings).plane, torch.tensor([exponent]))) * torch.eye(2)
    (mass, covariance), (wide_mass, wide) = kernel(name, SHAPE, exponent), kernel(name, wider, exponent)
    torch.testing.assert_close(wide, covariance + PIXEL * torch.eye(2), atol=2e-4, rtol=2e-3)
    conic = torch.linalg.inv(wider)[[0, 0, 1], [0, 1, 1]][None]
    one = torch.ones(1, dtype=torch.float64)
    drawn = Primitives2D(conic[:, :2], conic, one.expand(1, 3), one, exponent * one, one)
    assert float(with_light_kept(drawn, settings).opacity) * wide_mass == pytest.approx(mass, rel=2e-3)


def smallest(at: float, settings: RenderSettings) -> float:
    """Light of the smallest primitive there is, `at` of the way between the pixels' centers of a training image."""
    exponent = torch.tensor([4.0])
    wider = widening(settings)
    shape = 1e-3 + linear(wider.world, exponent) + linear(wider.plane, exponent)
    conic = torch.stack([1 / shape, 0 * shape, 1 / shape], -1)
    place, one = torch.full((1, 2), 10.5 + at), torch.ones(1)
    spot = Primitives2D(place, conic, torch.ones(1, 3), 0.5 * one, exponent, one)
    return float(rasterize(with_light_kept(spot, settings), None, 21, 21, alpha_min=0.0).alpha.sum())


def test_the_light_of_the_smallest_primitive_does_not_depend_on_its_place_between_pixels():
    places = (0.0, 0.2, 0.35, 0.5)
    filtered, dilated = (
        [smallest(at, RenderSettings(antialiasing=name)) for at in places] for name in ("mip", "dilation")
    )
    assert max(filtered) < 1.03 * min(filtered)
    assert dilated[-1] == 0  # it falls between the pixels


def test_no_primitive_is_smaller_than_the_filter_in_the_views_that_measured_it(
    primitives: Make, camera: Callable[..., Cameras]
):
    """However the conditioning shrinks it: the standard deviation of its kernel in pixels, in every direction."""
    p = primitives(300)
    p = p._replace(scale=p.scale - 6, footprint=footprints(p.xyz, camera()))
    view = replace(view_camera(camera(), torch.float64))
    seen = conditioned_in_view(p, view.center, MIP)
    least = torch.linalg.eigvalsh(seen.covariance)[:, 0] / (2 * (4 * p.beta[:, 0].exp() + 2))
    assert (least >= 0.999 * PIXEL * p.footprint**2).all()
    conic = project_plainly(p, view, MIP).primitives.conic
    a, b, c = conic.unbind(-1)
    largest = torch.linalg.eigvalsh(torch.stack([a, b, b, c], -1).unflatten(-1, (2, 2)))[:, 1]
    on_image = 1 / largest / (2 * (4 * p.beta[:, 0].exp() + 2))
    assert (on_image >= 0.9 * 2 * PIXEL).all()  # 70 and 66 pixels of focal length: the finer one measures


def test_the_filters_gradient_is_that_of_differences(primitives: Make, camera: Callable[..., Cameras]):
    p, view = primitives(6, seed=4), view_camera(camera(), torch.float64)

    def drawn(beta: torch.Tensor, scale: torch.Tensor, xyz: torch.Tensor) -> tuple[torch.Tensor, ...]:
        on_plane = project_plainly(p._replace(beta=beta, scale=scale, xyz=xyz), view, MIP).primitives
        return on_plane.conic, on_plane.opacity

    leaves = [values.clone().requires_grad_() for values in (p.beta, p.scale, p.xyz)]
    assert torch.autograd.gradcheck(drawn, leaves, atol=1e-6)


def test_a_footprint_is_the_finest_pixel_of_the_cameras_that_have_the_point_in_their_image(
    camera: Callable[..., Cameras],
):
    K = torch.tensor([[100.0, 0, 50], [0, 80.0, 40], [0, 0, 1]], dtype=torch.float64).repeat(2, 1, 1)
    poses = torch.eye(4, dtype=torch.float64).repeat(2, 1, 1)
    poses[1, 2, 3] = 3.0  # nearer to what lies ahead
    cameras = Cameras(K, torch.zeros(2, 0, dtype=torch.float64), poses, 100, 80)
    xyz = torch.tensor([[0.0, 0, 4], [1.5, 0, 4], [0, 0, -4]])
    expected = torch.tensor([1 / 100, 4 / 100, 4 / 100])  # seen by both, by the far one alone, by none
    torch.testing.assert_close(footprints(xyz, cameras), expected)
