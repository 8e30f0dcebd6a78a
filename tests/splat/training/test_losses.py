"""The terms of the objective: their limits, and gradients against autograd."""

import math

import pytest
import torch

from swimm3r.evaluate.images import ssim
from swimm3r.raster import RasterOutput
from swimm3r.splat.settings import LossWeights, UwbsSettings
from swimm3r.splat.training import losses
from swimm3r.splat.views import TrainingViews


def images(height: int = 40, width: int = 50) -> tuple[torch.Tensor, torch.Tensor]:
    rng = torch.Generator().manual_seed(0)
    a = torch.rand(3, height, width, generator=rng)
    return a, (a + 0.3 * torch.rand(3, height, width, generator=rng)).clamp(0, 1)


ALL = torch.ones(40, 50, dtype=torch.bool)


def test_ssim_is_the_score_of_the_evaluation():
    a, b = images()
    expected = ssim(a.permute(1, 2, 0), b.permute(1, 2, 0))
    assert losses.photometric(a, b, ALL, 0.2).ssim == pytest.approx(expected, abs=1e-5)
    assert float(losses.mean_ssim(a, b)) == pytest.approx(expected, abs=1e-5)


def test_the_photometric_gradient_is_that_of_the_plain_form():
    a, b = images()
    x = a.clone().requires_grad_()
    exact = a.double().requires_grad_()
    loss = losses.photometric(x, b, ALL, 0.2).loss
    plain = losses.photometric(exact, b.double(), ALL, 0.2).loss
    assert float(loss.detach()) == pytest.approx(float(plain.detach()), rel=1e-5)
    (found,), (expected,) = torch.autograd.grad(3 * loss, x), torch.autograd.grad(3 * plain, exact)
    torch.testing.assert_close(found, expected.float(), rtol=1e-3, atol=1e-4 * float(expected.abs().max()))


def test_equal_images_cost_nothing():
    a, _ = images()
    result = losses.photometric(a, a, ALL, 0.2)
    assert result.l1 == 0
    assert float(result.loss) == pytest.approx(0, abs=1e-6)


def test_pixels_that_are_not_seen_have_no_gradient_and_no_say():
    a, b = images()
    seen = ALL.clone()
    seen[10:20, 10:30] = False
    x = a.clone().requires_grad_()
    loss = losses.photometric(x, b, seen, 0.2).loss
    (gradient,) = torch.autograd.grad(loss, x)
    assert (gradient[:, ~seen] == 0).all()
    assert (gradient[:, seen] != 0).any()
    painted = torch.where(seen, b, 0.9)
    assert float(losses.photometric(a, painted, seen, 0.2).loss) == float(loss.detach())


def test_values_that_are_not_seen_are_left_out_channel_by_channel():
    render, target = images()
    seen = torch.rand(render.shape, generator=torch.Generator().manual_seed(3)) > 0.2
    gradients = []
    for render_as in (render, render.double()):  # the fast form, and the plain one
        x = render_as.clone().requires_grad_()
        losses.photometric(x, target.to(x), seen, 0.2).loss.backward()
        assert not x.grad[~seen].any()
        gradients.append(x.grad)
    torch.testing.assert_close(gradients[0].double(), gradients[1], rtol=1e-3, atol=1e-8)


def depth_images(z: torch.Tensor, alpha: torch.Tensor) -> RasterOutput:
    nothing = torch.zeros(3, *z.shape, dtype=z.dtype)
    return RasterOutput(nothing, nothing, z * alpha, alpha)


def test_a_map_at_the_prior_depth_has_no_depth_error_however_transparent():
    z = torch.tensor([[2.0, 3.0], [4.0, 5.0]])
    alpha = torch.tensor([[0.6, 0.9], [1.0, 0.7]])
    assert losses.depth_error(depth_images(z, alpha), z, torch.ones(2, 2), 0.5) < 1e-6


def test_the_depth_error_is_a_weighted_mean_over_known_and_covered_pixels():
    z = torch.tensor([[2.0, 3.0, 4.0, 9.0]])
    prior = torch.tensor([[4.0, 3.0, 0.0, 1.0]])
    alpha, weight = torch.tensor([[0.8, 0.8, 0.8, 0.2]]), torch.tensor([[0.5, 1.0, 1.0, 1.0]])
    expected = 0.5 * torch.log(torch.tensor(1.25)) / 1.5
    torch.testing.assert_close(losses.depth_error(depth_images(z, alpha), prior, weight, 0.5), expected)


def test_a_image_without_known_depth_has_no_depth_error():
    z = torch.full((2, 2), 3.0)
    images = depth_images(z, torch.ones(2, 2))
    assert losses.depth_error(images, torch.zeros(2, 2), torch.ones(2, 2), 0.5) == 0
    assert losses.depth_error(images, z + 1, torch.zeros(2, 2), 0.5) == 0  # every weight underflows


def off_guess(images: RasterOutput, z_depth: torch.Tensor, weight: torch.Tensor, least_alpha: float) -> torch.Tensor:
    return losses.off_guess(images, z_depth * weight, 1.05, least_alpha)


@pytest.mark.parametrize("loss", [losses.depth_error, losses.in_front, off_guess])
def test_the_depth_gradients_agree_with_finite_differences(loss):
    rng = torch.Generator().manual_seed(0)
    z, prior = (2 + torch.rand(4, 5, generator=rng, dtype=torch.float64) for _ in range(2))
    alpha = 0.6 + 0.3 * torch.rand(4, 5, generator=rng, dtype=torch.float64)

    def error(total: torch.Tensor, covered: torch.Tensor) -> torch.Tensor:
        nothing = torch.zeros(3, 4, 5, dtype=torch.float64)
        images = RasterOutput(nothing, nothing, total, covered)
        return loss(images, prior, torch.ones(4, 5, dtype=torch.float64), 0.5)

    assert torch.autograd.gradcheck(error, ((z * alpha).requires_grad_(), alpha.requires_grad_()))


def test_a_map_counts_in_front_of_measured_depth_and_not_behind_it():
    prior = torch.tensor([[4.0, 4.0, 4.0, 0.0, 4.0]])
    z = torch.tensor([[2.0, 3.2, 6.0, 1.0, 1.0]])
    alpha = torch.tensor([[0.8, 0.6, 0.9, 0.9, 0.2]])  # the last is hardly covered
    weight = torch.tensor([[0.5, 1.0, 0.5, 1.0, 1.0]])
    images = RasterOutput(torch.zeros(3, 1, 5), torch.zeros(3, 1, 5), (z * alpha).requires_grad_(), alpha)
    found = losses.in_front(images, prior, weight, 0.5)
    assert found.item() == pytest.approx((0.5 * 1.0 + 1.0 * 0.0625) / 2)
    (slope,) = torch.autograd.grad(found, images.z_depth)
    assert (slope[0, :2] < 0).all()  # farther is better
    assert (slope[0, 2:] == 0).all()
    assert losses.in_front(images, torch.zeros(1, 5), weight, 0.5) == 0


def test_a_map_is_held_to_a_guess_from_both_sides_and_with_slack():
    guess = torch.tensor([[4.0, 4.0, 4.0, 4.0, 0.0, 4.0]])
    z = torch.tensor([[2.0, 3.8, 4.2, 8.0, 1.0, 1.0]])
    alpha = torch.tensor([[0.8, 0.6, 0.9, 0.7, 0.9, 0.2]])  # the last is hardly covered
    images = RasterOutput(torch.zeros(3, 1, 6), torch.zeros(3, 1, 6), (z * alpha).requires_grad_(), alpha)
    found = losses.off_guess(images, guess, 1.1, 0.5)
    assert found.item() == pytest.approx(2 * math.log(2 / 1.1) ** 2 / 6, rel=1e-5)  # of the whole image
    (slope,) = torch.autograd.grad(found, images.z_depth)
    assert slope[0, 0] < 0 < slope[0, 3]
    assert (slope[0, [1, 2, 4, 5]] == 0).all()
    assert losses.off_guess(images, torch.zeros(1, 6), 1.1, 0.5) == 0


def test_a_surface_that_is_known_is_to_be_opaque_and_open_water_is_not():
    alpha = torch.tensor([[0.6, 1.0], [0.2, 0.0]], requires_grad=True)
    images = depth_images(torch.ones(2, 2), alpha)
    share = losses.uncovered(images, torch.tensor([[True, True], [False, False]]))
    assert share.item() == pytest.approx(0.2)
    (slope,) = torch.autograd.grad(share, alpha)
    torch.testing.assert_close(slope, torch.tensor([[-0.5, -0.5], [0.0, 0.0]]))
    assert losses.uncovered(images, torch.zeros(2, 2) > 0) == 0


def test_what_looks_past_every_surface_is_to_show_nothing_but_water():
    alpha = torch.tensor([[0.6, 1.0], [0.2, 0.0]], requires_grad=True)
    images = depth_images(torch.ones(2, 2), alpha)
    share = losses.drawn_on_water(images, torch.tensor([[True, False], [True, False]]))
    assert share.item() == pytest.approx(0.4)
    (slope,) = torch.autograd.grad(share, alpha)
    torch.testing.assert_close(slope, torch.tensor([[0.5, 0.0], [0.5, 0.0]]))
    assert losses.drawn_on_water(images, torch.zeros(2, 2, dtype=torch.bool)) == 0


def test_colors_in_view_are_drawn_back_to_those_that_there_are(primitives):
    p = primitives(3)
    rgb = torch.tensor([[0.0, 0.5, 1.0], [1.5, -0.2, 0.3], [9.0, -9.0, 9.0]]).to(p.rgb).requires_grad_()
    outside = losses.outside_gamut(p._replace(rgb=rgb), torch.tensor([2.0, 7.0, 0.0]))
    assert outside.item() == pytest.approx((0.5**2 + 0.2**2) / 6)
    (slope,) = torch.autograd.grad(outside, rgb)
    expected = torch.zeros(3, 3)
    expected[1, 0], expected[1, 1] = 2 * 0.5 / 6, -2 * 0.2 / 6
    torch.testing.assert_close(slope, expected.to(slope), rtol=1e-5, atol=1e-8)


def test_channels_that_the_water_hides_are_drawn_to_the_hue_of_those_seen(primitives):
    p = primitives(3)
    rgb = torch.tensor([[0.6, 0.3, 0.3], [0.9, 0.2, 0.2], [5.0, 5.0, 5.0]]).to(p.rgb).requires_grad_()
    T_D = torch.tensor([[1.0, 1.0, 1.0], [0.0, 1.0, 1.0], [0.0, 1.0, 1.0]]).to(p.rgb)
    radius = torch.tensor([2.0, 7.0, 0.0])  # the first tells the hue, 2 : 1 : 1; the last is out of view
    off = losses.hidden_colors(p._replace(rgb=rgb), T_D, radius, 0.01)
    assert off.item() == pytest.approx((0.9 - 0.4) ** 2 / 6, rel=0.02)
    (slope,) = torch.autograd.grad(off, rgb)
    expected = torch.zeros(3, 3)
    expected[1, 0] = 2 * (0.9 - 0.4) / 6
    torch.testing.assert_close(slope, expected.to(slope), rtol=0.02, atol=1e-4)


def test_colors_that_the_water_leaves_are_free(primitives):
    p = primitives(3)
    clear = torch.ones(3, 3).to(p.rgb)
    assert losses.hidden_colors(p, clear, torch.tensor([2.0, 7.0, 1.0]), 0.01).item() < 1e-4
    assert losses.hidden_colors(p, 0 * clear, torch.tensor([0.0, 0.0, 0.0]), 0.01).item() == 0


def test_depth_may_step_where_color_does():
    rgb = torch.zeros(3, 6, 8)
    rgb[:, :, 4:] = 0.2
    weight = losses.edge_weight(rgb, 10.0)
    assert weight[3, 0] == 1
    assert weight[3, 3] == pytest.approx((1 + math.exp(-2.0)) / 2)
    assert (losses.edge_weight(rgb, 0.0) == 1).all()


def test_the_weights_are_normalized_so_that_lambda_depth_is_what_it_says(tiny_dive):
    """1 / D is 0.1 too large everywhere; DN-Splatter's own two means, one per axis, would count that twice."""
    view = TrainingViews(tiny_dive.rec, tiny_dive.frames, UwbsSettings(), 1.0)[2]
    images = depth_images(view.z_depth, torch.ones_like(view.z_depth))
    off = view.z_depth / (1 + 0.1 * view.z_depth)
    for scale in (0.0, 1.0, 10.0, 100.0):
        error = losses.depth_error(images, off, losses.edge_weight(view.rgb, scale), 0.5)
        assert error.item() == pytest.approx(math.log(1.1), rel=1e-5)


def test_an_edge_of_a_tenth_counts_half_or_less_by_default():
    """Real depth maps step twice as far there as where the image is flat (docs/experiments/objective.md)."""
    rgb = torch.zeros(3, 6, 8)
    rgb[:, :, 4:] += 0.1
    rgb[:, 3:] += 0.1
    corner = losses.edge_weight(rgb, LossWeights().depth_edges)[2, 3]
    assert corner < 0.5
    assert corner < 0.5 * losses.edge_weight(rgb, LossWeights().depth_edges)[0, 0]


def test_only_oversize_primitives_are_held_back(primitives):
    p = primitives(6)
    p = p._replace(scale=p.scale.requires_grad_())
    radius = torch.tensor([1.0, 300.0, 20.0, 400.0, 5.0, 5.0])
    value = losses.oversize(p, radius, 256.0)
    expected = torch.nn.functional.softplus(p.scale[[1, 3], :3]).mean()
    torch.testing.assert_close(value, expected)
    (gradient,) = torch.autograd.grad(value, p.scale)
    assert (gradient[[0, 2, 4, 5]] == 0).all()
    assert losses.oversize(p, radius, 1000.0) == 0


def test_the_scale_regularizer_sees_the_spatial_scales_of_all_or_with_ubs_slip_all_scales_of_three(primitives):
    p = primitives(10)
    spread = torch.nn.functional.softplus(p.scale)
    torch.testing.assert_close(losses.mean_scale(p), spread[:, :3].mean())
    torch.testing.assert_close(losses.mean_scale(p, ubs_bug=True), spread[:3].mean())
