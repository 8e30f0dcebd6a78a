"""SeaSplat: water over finished images, its losses, its bursts."""

import math
from collections.abc import Callable
from dataclasses import replace

import pytest
import torch

from swimm3r.cameras import Cameras
from swimm3r.raster import RasterOutput
from swimm3r.splat.gaussian_settings import SeaSplatWeights
from swimm3r.splat.medium.seasplat import SceneWater, layer, relative_depth, seen_through
from swimm3r.splat.recipes.gaussian_step import densified_by_gradients
from swimm3r.splat.recipes.seasplat import SeaSplat, covered_background, dark_channel, depth_steps, objective
from swimm3r.splat.rendering import SplatMap, mean_water
from swimm3r.splat.settings import SeaSplatSettings, UwbsSettings, seasplat, with_recipe
from swimm3r.splat.training.scene import TrainingScene
from swimm3r.splat.views import TrainingView, TrainingViews


def water(a: float = 0.9, b: float = 0.7) -> SceneWater:
    found = SceneWater()
    with torch.no_grad():
        found.attenuation.copy_(torch.tensor([a, 0.8 * a, 0.6 * a]))
        found.backscatter.copy_(torch.tensor([b, 1.1 * b, 0.9 * b]))
    return found


def images(height: int = 12, width: int = 16, dtype: torch.dtype = torch.float32) -> RasterOutput:
    rng = torch.Generator().manual_seed(0)
    alpha = 0.2 + 0.7 * torch.rand(height, width, generator=rng)
    clear, z = torch.rand(3, height, width, generator=rng) * alpha, 1 + 4 * torch.rand(height, width, generator=rng)
    return RasterOutput(*(t.to(dtype) for t in (clear, clear, alpha * z, alpha)))


def view_like(images: RasterOutput) -> TrainingView:
    rng = torch.Generator().manual_seed(1)
    height, width = images.alpha.shape
    eye = torch.eye(3, dtype=torch.float64)[None]
    camera = Cameras(
        eye, torch.zeros(1, 0, dtype=torch.float64), torch.eye(4, dtype=torch.float64)[None], width, height
    )
    rgb = torch.rand(3, height, width, generator=rng).to(images.alpha)
    seen = torch.ones(height, width, dtype=torch.bool)
    nothing = torch.zeros(height, width)
    return TrainingView("a", camera, rgb, seen, nothing, nothing > 0)


@pytest.fixture
def recipe(tiny_dive) -> Callable[..., SeaSplat]:
    def make(**changes) -> SeaSplat:
        settings = seasplat(**changes)
        views = TrainingViews(tiny_dive.rec, tiny_dive.frames, settings, 1.0)
        return SeaSplat(settings, TrainingScene(tiny_dive.rec, 1.0, 1.0, views))

    return make


def test_water_without_coefficients_is_no_water():
    J, d = images().clear, torch.rand(12, 16)
    torch.testing.assert_close(seen_through(J, layer(water(0.0, 0.0), d)), J)


def test_negative_coefficients_count_as_none():
    J, d = images().clear, torch.rand(12, 16)
    torch.testing.assert_close(seen_through(J, layer(water(-1.0, -2.0), d)), J)


def test_far_water_is_its_own_color_and_near_water_invisible():
    W = water(80.0, 80.0)
    J = images().clear
    far, near = (seen_through(J, layer(W, torch.full((12, 16), d))) for d in (1.0, 0.0))
    torch.testing.assert_close(far, W.Binf[:, None, None].expand_as(J))
    torch.testing.assert_close(near, J)


def test_depth_runs_from_0_to_1_whatever_its_unit():
    I = images()
    d = relative_depth(I)
    assert (d.min(), d.max()) == (0, 1)
    torch.testing.assert_close(relative_depth(I._replace(z_depth=17 * I.z_depth)), d)
    hole = I._replace(alpha=I.alpha.clone(), z_depth=I.z_depth.clone())
    hole.alpha[3, 4], hole.z_depth[3, 4] = 0, 0
    assert relative_depth(hole)[3, 4] == 1
    assert relative_depth(I._replace(alpha=torch.zeros(12, 16))).min() == 1
    flat = I._replace(z_depth=2 * I.alpha)
    assert relative_depth(flat).isfinite().all()


def test_gradients_of_every_loss_agree_with_finite_differences():
    I, W, w = images(dtype=torch.float64), water().double(), SeaSplatWeights(negative=3.0)
    view = view_like(I)
    view = replace(view, rgb=view.rgb * 0.6)
    leaves = [I.clear.clone(), I.z_depth.clone(), I.alpha.clone(), W.attenuation, W.backscatter, W.veil]
    for wet in (False, True):

        def value(clear, z, alpha, a, b, veil, wet=wet):
            of = SceneWater().double()
            parts = {"attenuation": a, "backscatter": b, "veil": veil}
            out = RasterOutput(clear, clear, z, alpha)
            return torch.func.functional_call(
                _Losses(of, out, view, w, wet), {f"of.{k}": v for k, v in parts.items()}, ()
            )

        assert torch.autograd.gradcheck(value, [t.detach().requires_grad_() for t in leaves], fast_mode=True, atol=1e-6)


class _Losses(torch.nn.Module):
    """The objective as a module, so that its water can be swapped. Terms whose weights are detached count as such."""

    def __init__(self, of: SceneWater, out: RasterOutput, view: TrainingView, w: SeaSplatWeights, wet: bool) -> None:
        super().__init__()
        self.of, self.rest = of, (out, view, w, wet)

    def forward(self) -> torch.Tensor:
        out, view, w, wet = self.rest
        # what is detached on purpose would not agree with differences
        return objective(out, self.of, view, replace(w, far=0.0, dark=0.0), wet).total


def test_the_losses_add_up_with_their_weights():
    I, W, w = images(), water(), SeaSplatWeights()
    n = objective(I, W, view_like(I), w, True)
    m = {name: float(torch.as_tensor(value).detach()) for name, value in n.numbers.items()}
    expected = 0.8 * m["l1"] + 0.2 * (1 - m["ssim"]) + m["far"] + 0.01 * m["background"] + 2 * m["smooth_depth"]
    expected += 0.1 * m["gray"] + 2 * m["saturation"] + m["dark"]
    assert float(n.total.detach()) == pytest.approx(expected, rel=1e-5)
    dry = objective(I, W, view_like(I), w, False).numbers
    assert set(m) - set(dry) == {"gray", "saturation", "dark"}


def test_what_stands_before_open_water_is_to_be_transparent():
    I, W, w = images(), water(), SeaSplatWeights()
    view = view_like(I)
    like = W.Binf[:, None, None].expand(3, 12, 16).clone()
    torch.testing.assert_close(covered_background(like, I.alpha, W, view, w), I.alpha.mean())
    like[:, :, :8] += 0.9
    torch.testing.assert_close(covered_background(like, I.alpha, W, view, w), I.alpha[:, 8:].mean())
    assert covered_background(like + 5, I.alpha, W, view, w) == 0


def test_depth_may_step_where_the_image_brightens():
    I = images()
    view = view_like(I)
    depth = torch.zeros(12, 16)
    depth[:, 8:] = 1
    dark, bright = (replace(view, rgb=torch.zeros(3, 12, 16)) for _ in range(2))
    bright.rgb[:, :, 8:] = 1
    assert float(depth_steps(depth, dark)) == pytest.approx(1 / 15, rel=1e-5)
    assert float(depth_steps(depth, bright)) == pytest.approx(math.exp(-1) / 15, rel=1e-5)


def test_backscatter_beyond_the_image_costs_much_more_than_light_left_over():
    view = view_like(images())
    gray = replace(view, rgb=torch.full((3, 12, 16), 0.5))
    left = dark_channel(torch.full((3, 12, 16), 0.4), gray, 1000.0)
    beyond = dark_channel(torch.full((3, 12, 16), 0.6), gray, 1000.0)
    assert float(left) == pytest.approx(0.1, rel=1e-4)
    assert float(beyond) == pytest.approx(1000 * 0.1**2 / 0.4, rel=1e-4)


def test_pixels_that_do_not_count_change_nothing(tiny_dive):
    I, W, w = images(), water(), SeaSplatWeights()
    view = view_like(I)
    seen = torch.rand(12, 16, generator=torch.Generator().manual_seed(2)) > 0.3
    other = replace(view, seen=seen, rgb=torch.where(seen, view.rgb, 0.123))
    before = objective(I, W, replace(view, seen=seen), w, True).numbers
    after = objective(I, W, other, w, True).numbers
    for name in before.keys() - {"smooth_depth"}:  # whose weight looks across the border
        torch.testing.assert_close(torch.as_tensor(before[name]), torch.as_tensor(after[name]), rtol=1e-5, atol=0)


def test_before_the_water_a_background_is_learned_and_becomes_its_color(recipe):
    of = recipe(iterations=60)
    state, view = of.start(), of.scene.views[3]
    a, veil = state.field.attenuation.detach().clone(), state.field.veil.detach().clone()
    for step in range(1, 21):
        state, numbers = of.step(state, view, step)
    assert "gray" not in numbers
    assert torch.equal(state.field.attenuation, a)
    learned = state.field.veil.detach().clone()
    assert (learned - veil).abs().max() > 0.05
    filled = of._filled(state, 21)
    assert (filled.field.attenuation - a).abs().min() > 0
    # two steps of the first burst, of a rate of 0.01: it began where the background was
    assert (filled.field.veil - learned).abs().max() <= 0.021


def test_water_learns_in_bursts_alone_and_they_move_nothing_else(recipe):
    of = recipe(iterations=300)
    state = of.start()
    before = [t.clone() for t in state.primitives]
    a = state.field.attenuation.detach().clone()
    of._water_burst(state, 150, 5)
    assert all(torch.equal(x, y) for x, y in zip(before, state.primitives, strict=True))
    assert (state.field.attenuation - a).abs().min() > 0
    still = recipe(iterations=3000)  # 10 steps between two bursts
    state = still.start()
    a = state.field.attenuation.detach().clone()
    state, numbers = still.step(state, still.scene.views[2], 1501)
    assert "gray" in numbers
    assert torch.equal(state.field.attenuation, a)


def test_the_bursts_have_their_published_lengths(recipe):
    of = recipe()
    drawn = []
    object.__setattr__(of, "_draws", lambda step, purpose, count: drawn.append((purpose, round(count))) or [])
    of._filled(of.start(), 10_001)
    assert drawn == [(10, 1000), (11, 2000)]
    assert of._dry_steps() == 10_000
    assert of._share(of.settings.water.every) == 100
    assert round(of.settings.water.burst * of.settings.water.every * 30_000) == 50


def test_a_map_shows_its_water_as_coefficients_that_take_the_same_light(tiny_dive, recipe):
    of = recipe(iterations=60)
    scene = SplatMap(of.start().primitives, water(), of.settings, True)
    out = scene.render(tiny_dive.cameras[4])
    z = torch.where(out.z_depth > 0, out.z_depth, out.z_depth.max())
    rays = tiny_dive.cameras[4].K[0].inverse().float() @ torch.stack(
        [
            (torch.arange(64) + 0.5).expand(48, 64).flatten(),
            (torch.arange(48) + 0.5)[:, None].expand(48, 64).flatten(),
            torch.ones(48 * 64),
        ]
    )
    ray_depth = z * rays.norm(dim=0).reshape(48, 64)
    backscatter = out.medium.Binf * (1 - torch.exp(-out.medium.beta_B * ray_depth[..., None]))
    torch.testing.assert_close(backscatter, out.backscatter, rtol=1e-4, atol=1e-5)
    mean = mean_water(scene, tiny_dive.cameras[4])
    torch.testing.assert_close(mean.beta_D, out.medium.beta_D.flatten(0, 1).mean(0))


def test_opacities_are_cut_in_long_runs_alone(recipe):
    of = recipe()
    state = of.start()
    bright = replace(
        state, primitives=state.primitives._replace(opacity=torch.full_like(state.primitives.opacity, 2.0))
    )
    cut = densified_by_gradients(of.scene, bright, of.settings, of.settings.densify, 3000)
    assert float(torch.sigmoid(cut.primitives.opacity).max()) == pytest.approx(0.01, rel=1e-4)
    short = with_recipe(UwbsSettings(iterations=2000), "seasplat")
    assert isinstance(short, SeaSplatSettings)
    assert short.densify.reset_every == 0
