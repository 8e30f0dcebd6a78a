"""WaterSplatting: its water, its losses, its schedule."""

from dataclasses import replace

import pytest
import torch

from swimm3r.splat.medium.field import grid_of, initial_field
from swimm3r.splat.optimizer import Moments
from swimm3r.splat.primitives.gaussian import GaussianPrimitives
from swimm3r.splat.projection.view_camera import view_camera
from swimm3r.splat.recipes.watersplatting import WaterSplatting, relative_photometric
from swimm3r.splat.rendering import draw
from swimm3r.splat.settings import UwbsSettings, WaterSplattingSettings, watersplatting, with_recipe
from swimm3r.splat.training.losses import mean_ssim
from swimm3r.splat.training.scene import TrainingScene
from swimm3r.splat.views import TrainingViews, smaller

SETTINGS = watersplatting(iterations=1500)


def recipe(dive, settings=SETTINGS, views: int = 7) -> WaterSplatting:
    of = TrainingViews(dive.rec, dive.frames, settings, 1.0)
    of.names = (of.names * views)[:views]  # only their number matters
    return WaterSplatting(settings, TrainingScene(dive.rec, 1.0, 1.0, of))


def view_of(dive, k: int = 3):
    return TrainingViews(dive.rec, dive.frames, SETTINGS, 1.0)[k]


def test_the_image_is_the_one_that_its_kernel_adds_up(tiny_dive):
    """The published sums, pair by pair in depth order: with z_{i-1}, and the medium behind the last."""
    start = recipe(tiny_dive)
    state, view = start.start(), view_of(tiny_dive)
    sight = view_camera(view.camera)
    drawing = draw(state.primitives, state.field, sight, SETTINGS)
    p, maps = drawing.projection.primitives, drawing.maps
    y, x = 20, 31
    center = torch.tensor([x + 0.5, y + 0.5])
    T, z_before = 1.0, 0.0
    color, (Binf, beta_D, beta_B) = torch.zeros(3), (m[:, y, x].detach() for m in maps)
    for i in torch.argsort(p.depth).tolist():
        if p.depth[i] <= 0:
            continue
        dx, dy = center - p.mean2d[i]
        a, b, c = p.conic[i]
        alpha = min(0.999, float(p.opacity[i] * torch.exp(-0.5 * (a * dx * dx + 2 * b * dx * dy + c * dy * dy))))
        if alpha < 1 / 255:
            continue
        if T * (1 - alpha) <= 1e-4:
            break
        z = float(p.depth[i])
        color += T * alpha * p.color[i] * torch.exp(-beta_D * z)
        color += T * Binf * (torch.exp(-beta_B * z_before) - torch.exp(-beta_B * z))
        T, z_before = T * (1 - alpha), z
    color += T * Binf * torch.exp(-beta_B * z_before)
    assert T < 0.9
    torch.testing.assert_close(drawing.images.rgb[:, y, x].detach(), color, rtol=1e-4, atol=1e-5)


def test_its_network_has_one_hidden_layer_of_sigmoids_and_no_biases(tiny_dive):
    field = initial_field(None, SETTINGS.medium, torch.Generator().manual_seed(0))
    assert [tuple(w.shape[:2]) for w in field.parameters()] == [(128, 16), (9, 128)]
    values = grid_of(field, view_camera(view_of(tiny_dive).camera), 8).values
    assert (values > 0).all()
    assert (values[:3] < 1).all()


def test_relative_errors_count_dark_water_as_much_as_bright(tiny_dive):
    view = view_of(tiny_dive)
    dark, bright = (replace(view, rgb=value * torch.ones_like(view.rgb)) for value in (0.02, 0.8))
    losses = [relative_photometric(1.1 * v.rgb, v, 0.0, 0.0).l1 for v in (dark, bright)]
    assert losses[0] == pytest.approx(losses[1], rel=1e-4)
    assert losses[0] == pytest.approx(1 - 1 / 1.1, rel=1e-4)


def test_the_relative_loss_has_the_gradient_of_a_fixed_unit(tiny_dive):
    view = view_of(tiny_dive)
    render = (view.rgb + 0.05).requires_grad_()
    relative_photometric(render, view, 1e-3, 0.2).loss.backward()
    unit = render.detach() + 1e-3
    rng = torch.Generator().manual_seed(0)
    for _ in range(5):
        at = tuple(int(torch.randint(n, (), generator=rng)) for n in render.shape)
        moved = []
        for sign in (1, -1):
            x = render.detach().double().clone()
            x[at] += sign * 1e-4
            target = view.rgb.double()
            a, b = x / unit, target / unit
            moved.append(float(0.8 * (a - b).abs().mean() + 0.2 * (1 - mean_ssim(a, b))))
        assert float(render.grad[at]) == pytest.approx((moved[0] - moved[1]) / 2e-4, rel=2e-2, abs=1e-6)


def test_images_begin_at_a_quarter_and_are_whole_after_two_fifths(tiny_dive):
    of = recipe(tiny_dive)
    assert [of._divisor(step) for step in (1, 300, 301, 600, 601, 1500)] == [4, 4, 2, 2, 1, 1]
    view = view_of(tiny_dive)
    small = smaller(view, 4)
    assert small.rgb.shape == (3, 12, 16)
    torch.testing.assert_close(small.camera.K[0, 0, 0], view.camera.K[0, 0, 0] / 4)
    torch.testing.assert_close(small.rgb.mean(), view.rgb.mean())
    torch.testing.assert_close(small.z_depth, view.z_depth[2::4, 2::4])
    assert (small.open_water == view.open_water[2::4, 2::4]).all()
    assert smaller(view, 1) is view


def with_opacities(dive, settings, values: torch.Tensor, views: int = 7):
    of = recipe(dive, settings, views)
    state = of.start()
    opacity = values.repeat(-(-len(state.primitives.xyz) // len(values)))[: len(state.primitives.xyz)].logit()
    return of, replace(state, primitives=state.primitives._replace(opacity=opacity))


def test_rounds_cull_cut_and_wait_as_published(tiny_dive):
    """15,000 steps: cut at 100 of every 500, multiply and cull beyond n_train + 100 of them, gently after 10,000."""
    whole = watersplatting()
    of, state = with_opacities(tiny_dive, whole, torch.tensor([0.05, 0.3, 0.7, 0.9]), views=29)
    n = len(state.primitives.xyz)
    assert of._every() == 100
    cut = of._round(state, 600)
    assert len(cut.primitives.xyz) == n
    assert float(torch.sigmoid(cut.primitives.opacity).max()) <= 0.5 + 1e-6
    assert of._round(state, 1000).primitives is state.primitives  # 0 of 500: still waiting
    culled = of._round(state, 700).primitives
    assert len(culled.xyz) == n // 2
    late = of._round(state, 12_000).primitives
    assert abs(len(late.xyz) - 3 * n / 4) <= 2


def test_clips_of_any_length_are_densified(tiny_dive):
    of, state = with_opacities(tiny_dive, watersplatting(), torch.tensor([0.7]), views=2000)
    assert of._round(state, 800).primitives is not state.primitives


def test_short_runs_are_culled_gently_and_long_ones_as_published():
    short, long = (with_recipe(UwbsSettings(iterations=n), "watersplatting") for n in (2000, 15_000))
    assert isinstance(short, WaterSplattingSettings)
    assert (short.densify.reset_every, short.densify.prune_opacity) == (0, 0.1)
    assert long.densify == watersplatting().densify


def test_rows_of_the_optimizer_follow_their_gaussians(tiny_dive):
    settings = watersplatting(initial=replace(watersplatting().initial, primitives=300), cap_max=1000)
    of, state = with_opacities(tiny_dive, settings, torch.tensor([0.05, 0.7]))
    marks = torch.arange(len(state.primitives.xyz)).float()
    first = {name: m.first.clone() for name, m in state.moments.items()}
    first["opacity"] = marks
    moments = {name: Moments(first[name], m.second, m.steps) for name, m in state.moments.items()}
    state = replace(state, moments=moments, primitives=state.primitives._replace(xyz=marks[:, None].repeat(1, 3)))
    done = of._round(state, 12_000)
    assert isinstance(done.primitives, GaussianPrimitives)
    assert torch.equal(done.moments["opacity"].first, done.primitives.xyz[:, 0])
    assert 0 < len(done.primitives.xyz) < len(marks)
