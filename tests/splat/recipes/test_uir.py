"""3D-UIR: its losses, rates and settings."""

from dataclasses import replace

import pytest
import torch
from torch.autograd import gradcheck

from swimm3r.raster import RasterOutput
from swimm3r.splat.recipes.uir import Uir, inverse_depth_error, recipe, smallest_scale
from swimm3r.splat.settings import UirSettings, UwbsSettings, uir, with_recipe
from swimm3r.splat.training.scene import TrainingScene
from swimm3r.splat.training.state import parameters_of
from swimm3r.splat.views import TrainingViews

SETTINGS = uir(iterations=1000)


def method(dive, settings: UirSettings = SETTINGS) -> Uir:
    return recipe(settings, TrainingScene(dive.rec, 1.0, 1.0, TrainingViews(dive.rec, dive.frames, settings, 1.0)))


def images(expected: torch.Tensor, alpha: torch.Tensor) -> RasterOutput:
    nothing = torch.zeros(3, *alpha.shape, dtype=alpha.dtype)
    return RasterOutput(nothing, nothing, alpha * expected, alpha)


def test_depth_as_measured_has_no_error_and_other_depth_that_of_its_inverse():
    rng = torch.Generator().manual_seed(0)
    D, alpha = 2 + torch.rand(5, 6, generator=rng).double(), 0.6 + 0.4 * torch.rand(5, 6, generator=rng).double()
    assert float(inverse_depth_error(images(D, alpha), D, 0.5)) == pytest.approx(0, abs=1e-12)
    off = inverse_depth_error(images(D, alpha), 2 * D, 0.5)
    torch.testing.assert_close(off, (1 / D - 1 / (2 * D)).mean())
    unknown = torch.where(D > 2.5, D, 0.0)
    wrong = torch.where(D > 2.5, D, 9.0)
    assert float(inverse_depth_error(images(wrong, alpha), unknown, 0.5)) == pytest.approx(0, abs=1e-12)
    assert inverse_depth_error(images(D, 0.4 * alpha), 2 * D, 0.5) == 0


def test_the_depth_term_has_the_gradients_of_depth_and_alpha():
    rng = torch.Generator().manual_seed(0)
    z = (2 + torch.rand(3, 4, generator=rng).double()).requires_grad_()
    alpha = (0.7 + 0.2 * torch.rand(3, 4, generator=rng).double()).requires_grad_()
    D, nothing = 2 + torch.rand(3, 4, generator=rng).double(), torch.zeros(3, 3, 4).double()
    assert gradcheck(lambda z, a: inverse_depth_error(RasterOutput(nothing, nothing, z, a), D, 0.5), (z, alpha))


def test_flattening_shrinks_the_smallest_scale_alone(tiny_dive):
    p = method(tiny_dive).start().primitives
    scale = torch.tensor([[-2.0, -3, -1], [-4, -2, -2.5]]).requires_grad_()
    flat = smallest_scale(p._replace(scale=scale))
    torch.testing.assert_close(flat, torch.tensor([-3.0, -4.0]).exp().mean())
    (grad,) = torch.autograd.grad(flat, scale)
    assert (grad != 0).tolist() == [[False, True, False], [True, False, False]]


def test_views_have_the_depth_of_the_reconstruction_and_a_step_uses_it(tiny_dive):
    of = method(tiny_dive)
    view = of.scene.view(3)
    assert (view.z_depth > 0).float().mean() > 0.5
    _, numbers = of.step(of.start(), view, 1)
    assert torch.as_tensor(numbers["depth"]) > 0
    _, without = of.step(of.start(), replace(view, z_depth=0 * view.z_depth), 1)
    assert torch.as_tensor(without["depth"]) == 0


def test_networks_learn_at_rates_of_their_own(tiny_dive):
    of = method(tiny_dive)
    assert of._field_rate("field.affine_colors.color.0.weight", 1e-3) == 5e-4
    assert of._field_rate("field.network.0.backscatter.0.weight", 1e-3) == 1e-3


def test_scales_and_depth_count_in_thirds_of_the_depth(tiny_dive):
    near = method(tiny_dive)
    far = recipe(near.settings, replace(near.scene, scale=2.0))
    assert far.unit == pytest.approx(2 * near.unit)


def test_training_flattens_gaussians_and_changes_colors(tiny_dive):
    of = method(tiny_dive)
    state = of.start()
    before = smallest_scale(state.primitives)
    name = "field.affine_colors.color.4.weight"
    last = parameters_of(state.primitives, state.field)[name].detach().clone()
    for step in range(1, 15):
        state, _ = of.step(state, of.scene.view(step % 7), step)
    assert smallest_scale(state.primitives) < 0.95 * before
    assert not torch.equal(last, parameters_of(state.primitives, state.field)[name])


def test_short_runs_are_not_cut_and_long_ones_as_published():
    short, long = (with_recipe(UwbsSettings(iterations=n), "3d-uir") for n in (2000, 30_000))
    assert isinstance(short, UirSettings)
    assert short.densify.reset_every == 0
    assert long.densify == uir().densify
