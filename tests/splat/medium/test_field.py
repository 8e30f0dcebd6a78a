"""The water as a field over directions."""

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
import torch

from swimm3r.medium import Medium, backscatter
from swimm3r.splat.medium.field import (
    FieldGrid,
    grid_of,
    initial_field,
    medium_at_pixels,
    per_z_depth,
    smoothness,
    spherical_harmonics,
)
from swimm3r.splat.medium.prior import deviation, water_prior, with_binf_prior
from swimm3r.splat.projection.view_camera import view_camera
from swimm3r.splat.settings import MediumFieldSettings

WATER = Medium(torch.tensor([0.1, 0.4, 0.5]), torch.tensor([0.4, 0.15, 0.1]), torch.tensor([0.3, 0.2, 0.25]))


def rough_field():
    """A field as training leaves it: different in every direction."""
    field = initial_field(WATER, MediumFieldSettings(), torch.Generator().manual_seed(0))
    with torch.no_grad():
        last: Any = field.network[-1]
        last.weight.normal_(0, 0.3, generator=torch.Generator().manual_seed(1))
    return field


def test_the_harmonics_are_orthonormal_on_the_sphere():
    z, weights = (torch.from_numpy(a) for a in np.polynomial.legendre.leggauss(8))
    turn = torch.arange(16).double() * (2 * torch.pi / 16)
    r = (1 - z * z).sqrt()
    d = torch.stack([r[:, None] * turn.cos(), r[:, None] * turn.sin(), z[:, None].expand(-1, 16)], -1).double()
    Y = spherical_harmonics(d)
    gram = torch.einsum("zti,ztj,z->ij", Y, Y, weights) * (2 * torch.pi / 16)
    torch.testing.assert_close(gram, torch.eye(16, dtype=gram.dtype), atol=1e-9, rtol=0)


def test_the_first_field_is_the_given_water_in_every_direction(camera):
    view = view_camera(camera())
    field = initial_field(WATER, MediumFieldSettings(), torch.Generator().manual_seed(0))
    maps = medium_at_pixels(grid_of(field, view, 8), view.height, view.width)
    for got, expected in zip(maps, (WATER.Binf, WATER.beta_D, WATER.beta_B), strict=True):
        torch.testing.assert_close(got, expected[:, None, None].expand_as(got), atol=1e-5, rtol=1e-4)


def test_a_change_of_unit_divides_the_betas_only(camera):
    view, field = view_camera(camera()), rough_field()
    before = grid_of(field, view, 8).values.detach()
    field.length.fill_(4.0)
    after = grid_of(field, view, 8).values.detach()
    torch.testing.assert_close(after[:3], before[:3])
    torch.testing.assert_close(after[3:], before[3:] / 4)


def test_interpolating_between_grid_points_changes_a_rough_field_little(camera):
    view, field = view_camera(camera(160, 112)), rough_field()
    exact = medium_at_pixels(grid_of(field, view, 1), view.height, view.width)
    coarse = medium_at_pixels(grid_of(field, view, 8), view.height, view.width)
    for a, b in zip(coarse, exact, strict=True):
        assert (a - b).abs().max() < 0.02 * (b.max() - b.min())


def test_the_field_is_interpolated_as_torch_interpolates_and_so_are_its_gradients():
    rng = torch.Generator().manual_seed(1)
    values = torch.rand(9, 7, 11, generator=rng, requires_grad=True)
    weights = torch.rand(9, 45, 70, generator=rng)
    maps = medium_at_pixels(FieldGrid(values, (1.0, 1.0)), 45, 70)
    ours = torch.cat([maps.Binf, maps.beta_B, maps.beta_D])
    torchs = torch.nn.functional.interpolate(values[None], (45, 70), mode="bilinear", align_corners=True)[0]
    torch.testing.assert_close(ours, torchs, rtol=0, atol=1e-6)
    (found,), (expected,) = (torch.autograd.grad((x * weights).sum(), values) for x in (ours, torchs))
    torch.testing.assert_close(found, expected, rtol=1e-5, atol=1e-5)


def test_the_field_is_seen_at_pixel_centers_of_the_turned_camera(camera):
    view, field = view_camera(camera()), rough_field()
    maps = medium_at_pixels(grid_of(field, view, 1), view.height, view.width)
    ray = torch.tensor([(11.5 - view.cx) / view.fx, (7.5 - view.cy) / view.fy, 1.0])
    direction = torch.nn.functional.normalize(view.R.T @ ray, dim=-1)
    expected = field(direction[None, None])[:, 0, 0]
    seen = torch.cat([m[:, 7, 11] for m in (maps.Binf, maps.beta_B, maps.beta_D)])  # as the network orders them
    torch.testing.assert_close(seen, expected, atol=1e-6, rtol=1e-5)


def test_smoothness_on_the_grid_is_that_of_the_interpolated_pixels(camera):
    view = view_camera(camera(129, 97))
    grid = grid_of(rough_field(), view, 8)
    pixels = torch.cat(medium_at_pixels(grid, view.height, view.width))
    on_pixels = pixels.diff(dim=1).abs().mean() + pixels.diff(dim=2).abs().mean()
    torch.testing.assert_close(smoothness(grid), on_pixels, rtol=0.05, atol=0)


def test_uniform_water_is_perfectly_smooth(camera):
    field = initial_field(WATER, MediumFieldSettings(), torch.Generator().manual_seed(0))
    assert smoothness(grid_of(field, view_camera(camera()), 8)) < 1e-7


def test_betas_for_z_depth_attenuate_as_much_as_betas_along_the_ray(camera):
    view, field = view_camera(camera()), rough_field()
    maps = medium_at_pixels(grid_of(field, view, 4), view.height, view.width)
    scaled = per_z_depth(maps, view)
    ray = torch.tensor([(3.5 - view.cx) / view.fx, (50.5 - view.cy) / view.fy, 1.0])
    z_depth = 2.7
    torch.testing.assert_close(scaled.beta_D[:, 50, 3] * z_depth, maps.beta_D[:, 50, 3] * z_depth * ray.norm())
    assert torch.equal(scaled.Binf, maps.Binf)


def test_the_pose_reaches_the_field(camera):
    view = view_camera(camera())
    R = view.R.clone().requires_grad_()
    value = grid_of(rough_field(), replace(view, R=R), 8).values.square().sum()
    assert torch.autograd.grad(value, R)[0].abs().max() > 1e-3


def test_the_prior_is_what_the_first_field_says_in_the_fields_own_unit(camera, tiny_dive):
    fit, length = tiny_dive.rec.medium, 0.25
    settings = MediumFieldSettings(hidden=16)
    water = Medium(fit.Binf, fit.beta_D * length, fit.beta_B * length)
    prior = water_prior(fit, length, settings)
    grid = grid_of(initial_field(water, settings, torch.Generator().manual_seed(0)), view_camera(camera()), 8)
    assert deviation(grid, prior) < 1e-8
    one_off = replace(grid, values=grid.values * torch.cat([torch.ones(8), torch.tensor([1.1])])[:, None, None])
    d = torch.tensor(1.1).log() / settings.least_std
    torch.testing.assert_close(deviation(one_off, prior), 2 * ((1 + d**2).sqrt() - 1) / 9, rtol=1e-4, atol=0)


@pytest.mark.parametrize(("spread", "expected"), [(1e-4, [0.6, 0.99, 0.7]), (1e3, [0.5, 0.6, 0.5])])
def test_an_unknown_horizon_looks_like_the_scene_and_a_known_one_like_itself(tiny_dive, spread, expected):
    fit = tiny_dive.rec.medium
    Binf = torch.tensor([0.6, 0.99, 0.7])
    fit = replace(fit, Binf=Binf, std=replace(fit.std, Binf=torch.full((3,), spread)))
    drawn = with_binf_prior(fit, torch.tensor([0.5, 0.6, 0.5]), 0.2)
    torch.testing.assert_close(drawn.Binf, torch.tensor(expected), atol=1e-3, rtol=0)
    assert (drawn.std.Binf <= torch.tensor(min(spread, 0.2)) + 1e-6).all()
    z = torch.tensor(fit.z_range).prod().sqrt()
    torch.testing.assert_close(backscatter(z, drawn.constant()), backscatter(z, fit.constant()), rtol=1e-4, atol=1e-5)


def test_a_known_horizon_that_is_black_or_nearly_reached_stays(tiny_dive):
    fit = tiny_dive.rec.medium
    fit = replace(fit, Binf=torch.tensor([0.0, 0.4, 0.5]), beta_B=torch.tensor([0.3, 2.0, 0.2]))
    fit = replace(fit, std=replace(fit.std, Binf=torch.zeros(3)))
    drawn = with_binf_prior(fit, torch.tensor([0.5, 0.6, 0.5]), 0.2)
    assert drawn.beta_B.isfinite().all()
    torch.testing.assert_close(drawn.Binf, fit.Binf)
    torch.testing.assert_close(drawn.beta_B[1:], fit.beta_B[1:], rtol=1e-4, atol=0)
