"""Depth triangulated from virtual views, and Gaussians held to rendered depth."""

import math

import pytest
import torch
from tests.splat.training.test_trinocular import SHIFTS, view
from torch.autograd import gradcheck

from swimm3r.splat.training.epipolar_depth import (
    depth_residual,
    epipolar_error,
    epipolar_prior,
    triangulated_depth,
)

B_H, B_V = float(SHIFTS[0, 0]), float(SHIFTS[1, 1])


def points(n: int = 50) -> torch.Tensor:
    rng = torch.Generator().manual_seed(0)
    z = 2 + 2 * torch.rand(n, generator=rng).double()
    return torch.cat([(torch.rand(n, 2, generator=rng).double() - 0.5) * z[:, None], z[:, None]], -1)


def planes(X: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
    h, v = ((X + shift)[:, :2] / X[:, 2:] for shift in SHIFTS)
    return h, v


def test_exact_places_give_the_depth_of_the_point():
    X = points()
    torch.testing.assert_close(triangulated_depth(*planes(X), B_H, B_V), X[:, 2])


def test_noisy_places_give_the_depth_of_the_least_squares_solution():
    rng = torch.Generator().manual_seed(1)
    h, v = (at + 0.01 * torch.randn(at.shape, generator=rng).double() for at in planes(points()))
    one, nil = torch.ones(50).double(), torch.zeros(50).double()
    A = torch.stack(
        [
            torch.stack([-one, nil, h[:, 0]], -1),
            torch.stack([nil, -one, h[:, 1]], -1),
            torch.stack([-one, nil, v[:, 0]], -1),
            torch.stack([nil, -one, v[:, 1]], -1),
        ],
        1,
    )
    right = torch.tensor([B_H, 0, 0, B_V]).double().expand(50, 4)[..., None]
    expected = torch.linalg.lstsq(A, right).solution[:, 2, 0]
    torch.testing.assert_close(triangulated_depth(h, v, B_H, B_V), expected)


def test_the_nearest_point_of_a_pixel_is_its_prior():
    of = view()
    ray = of.rays(torch.tensor([20.5]).double(), torch.tensor([12.5]).double())[0, 0]
    D = epipolar_prior(torch.stack([4.0 * ray, 2.5 * ray, 3.0 * ray]), of, SHIFTS, 0.01)
    assert D[12, 20] == pytest.approx(2.5)
    assert int((D > 0).sum()) == 1


def test_points_that_a_virtual_camera_does_not_see_have_no_prior():
    of = view()
    x = torch.tensor([39.5]).double()  # b_h moves it beyond the right edge
    out = 3.0 * of.rays(x, torch.tensor([12.5]).double())[0]
    assert not epipolar_prior(out, of, SHIFTS, 0.01).any()
    assert epipolar_prior(out, of, -SHIFTS, 0.01)[12, 39] == pytest.approx(3.0)
    assert not epipolar_prior(-points(), of, SHIFTS, 0.01).any()


def test_the_error_is_the_published_sum():
    rng = torch.Generator().manual_seed(0)
    D, prior = 2 + torch.rand(2, 4, 5, generator=rng).double()
    prior = torch.where(torch.rand(4, 5, generator=rng) > 0.4, prior, 0.0)
    rgb = torch.rand(3, 4, 5, generator=rng).double()
    counted = torch.rand(4, 5, generator=rng) > 0.2
    total = 0.0
    for y in range(4):
        for x in range(5):
            if not counted[y, x] or prior[y, x] == 0:
                continue
            right = float((rgb[:, y, x + 1] - rgb[:, y, x]).abs().mean()) if x < 4 else 0.0
            down = float((rgb[:, y + 1, x] - rgb[:, y, x]).abs().mean()) if y < 3 else 0.0
            total += math.log(1 + abs(float(D[y, x] - prior[y, x]))) * (math.exp(-right) + math.exp(-down))
    assert float(epipolar_error(D, prior, rgb, counted)) == pytest.approx(total / 20)
    assert epipolar_error(prior, prior, rgb, counted) == 0
    D.requires_grad_()
    assert gradcheck(lambda z: epipolar_error(z, prior, rgb, counted), (D,))


def test_gaussians_on_the_rendered_depth_have_no_residual():
    of, X = view(), points()
    X = X / X[:, 2:] * 3
    D, alpha = torch.full((30, 40), 3.0).double(), torch.ones(30, 40).double()
    assert float(depth_residual(X, D, alpha, of, 0.01, 0.5)) == pytest.approx(0, abs=1e-12)
    assert float(depth_residual(X * 1.1, D, alpha, of, 0.01, 0.5)) == pytest.approx(0.3)
    assert depth_residual(X * 1.1, D, 0.4 * alpha, of, 0.01, 0.5) == 0
    assert depth_residual(-X, D, alpha, of, 0.01, 0.5) == 0


def test_the_residual_has_the_gradients_of_depth_and_of_gaussians():
    of = view(8, 6)
    rng = torch.Generator().manual_seed(0)
    X = points(10) * torch.tensor([0.15, 0.1, 1]).double()
    alpha = torch.ones(6, 8).double()
    D = (2 + torch.rand(6, 8, generator=rng).double()).requires_grad_()
    assert gradcheck(lambda z: depth_residual(X, z, alpha, of, 0.01, 0.5), (D,))
    flat = torch.full((6, 8), 2.7).double()  # so that places, which have no gradient, make no difference
    X.requires_grad_()
    assert gradcheck(lambda p: depth_residual(p, flat, alpha, of, 0.01, 0.5), (X,))
