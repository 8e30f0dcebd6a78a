"""OceanSplat: what it adds to WaterSplatting, its schedule and its map."""

from dataclasses import replace

import pytest
import torch

from swimm3r.splat.optimizer import adam_step
from swimm3r.splat.primitives.gaussian import GaussianPrimitives
from swimm3r.splat.projection.view_camera import view_camera
from swimm3r.splat.recipes.oceansplat import OceanField, OceanSplat, geometry, object_light, recipe
from swimm3r.splat.recipes.watersplatting import relative_photometric
from swimm3r.splat.rendering import images
from swimm3r.splat.settings import OceanSplatSettings, UwbsSettings, oceansplat, watersplatting, with_recipe
from swimm3r.splat.training.scene import TrainingScene, third_of_depth
from swimm3r.splat.training.state import State
from swimm3r.splat.training.trinocular import virtual_shifts
from swimm3r.splat.views import TrainingViews

SETTINGS = oceansplat(
    iterations=1000,
    initial=replace(oceansplat().initial, opacity=0.95),
    first_divisor=1,
)


def method(dive, settings: OceanSplatSettings = SETTINGS) -> OceanSplat:
    return recipe(settings, TrainingScene(dive.rec, 1.0, 1.0, TrainingViews(dive.rec, dive.frames, settings, 1.0)))


def opaque(of: OceanSplat) -> State:
    state = of.start()
    p = state.primitives
    return replace(state, primitives=p._replace(scale=p.scale + 0.4, harmonics=0 * p.harmonics))


def terms(of: OceanSplat, state: State, step: int = 900) -> dict[str, torch.Tensor]:
    view = of.scene.view(3)
    shifts = virtual_shifts(of.settings.virtual, of.unit, torch.Generator().manual_seed(3))
    return geometry(of._render(state, view, step), view, shifts, of.settings, of.unit)


def test_a_thin_surface_agrees_with_itself_and_a_cloud_of_floaters_does_not(tiny_dive):
    of = method(tiny_dive)
    state = opaque(of)
    p, rng = state.primitives, torch.Generator().manual_seed(0)
    pushed = p.xyz * (1 - 0.5 * (torch.rand(len(p.xyz), 1, generator=rng) < 0.3))
    good, bad = terms(of, state), terms(of, replace(state, primitives=p._replace(xyz=pushed)))
    for name in ("object_stereo", "epipolar", "residual", "roughness"):
        assert good[name] < 0.7 * bad[name], name
    assert good["residual"] < 0.15


def test_the_light_of_objects_and_of_the_medium_add_up_to_the_image(tiny_dive):
    of = method(tiny_dive)
    seen = of._render(opaque(of), of.scene.view(3), 900)
    own = object_light(seen, seen.drawing.projection, SETTINGS)
    assert (own >= 0).all()
    assert (seen.drawing.images.rgb - own >= -1e-5).all()
    dark = seen.drawing.images.clear * torch.exp(-seen.drawing.maps.beta_D * 10)
    assert (own > dark).float().mean() > 0.9


def test_the_loss_is_the_published_sum(tiny_dive):
    of = method(tiny_dive)
    state, view, step = opaque(of), of.scene.view(3), 500
    seen = of._render(state, view, step)
    loss, n = of._objective(seen, view, step)
    photo = relative_photometric(seen.drawing.images.rgb, view, 1e-3, 0.2).loss
    tri = n["object_stereo"] + n["full_stereo"] + 1e-3 * n["roughness"]
    expected = photo + 0.1 * tri + 0.3 * n["epipolar"] + 0.01 * n["residual"]  # half of the way from 0.4 to 0.2
    torch.testing.assert_close(loss, expected)
    assert all(
        torch.as_tensor(n[name]) > 0 for name in ("object_stereo", "full_stereo", "epipolar", "residual", "roughness")
    )


def test_every_term_moves_the_gaussians(tiny_dive):
    of = method(tiny_dive)
    seen = of._render(opaque(of), of.scene.view(3), 900)
    shifts = virtual_shifts(of.settings.virtual, of.unit, torch.Generator().manual_seed(3))
    for name, term in geometry(seen, of.scene.view(3), shifts, of.settings, of.unit).items():
        (grad,) = torch.autograd.grad(term, seen.p.xyz, retain_graph=True)
        assert grad.isfinite().all()
        assert grad.any(), name


def test_opacities_are_adjusted_at_first_and_never_after(tiny_dive):
    of = method(tiny_dive)
    state, view = of.start(), of.scene.view(3)
    assert isinstance(state.field, OceanField)
    early = of._render(state, view, 1)
    torch.testing.assert_close(early.shown.opacity, state.primitives.opacity)  # nothing learned yet
    weights = {"last": state.field.alpha.last.weight}
    rng = torch.Generator().manual_seed(0)
    push = {"last": torch.randn(weights["last"].shape, generator=rng)}
    with torch.no_grad():
        adam_step(weights, push, {"last": state.moments["field.alpha.last.weight"]}, {"last": 0.5})
    assert (of._render(state, view, 1).shown.opacity - state.primitives.opacity).abs().mean() > 0.01
    for step in (400, 1000):
        assert torch.equal(of._render(state, view, step).shown.opacity, state.primitives.opacity)


def test_the_network_of_opacities_learns_early_and_its_map_is_drawn_without(tiny_dive):
    of = method(tiny_dive)
    state, view = of.start(), of.scene.view(3)
    assert isinstance(state.field, OceanField)
    last = state.field.alpha.last.weight
    before = last.detach().clone()
    state, _ = of.step(state, view, 1)
    assert not torch.equal(before, last)
    with torch.no_grad():
        sight = view_camera(view.camera)
        shown = images(state.primitives, state.field, sight, SETTINGS).rgb
        last.add_(5.0)
        assert torch.equal(images(state.primitives, state.field, sight, SETTINGS).rgb, shown)


def test_settings_are_those_of_watersplatting_but_for_what_is_published():
    ocean, water = oceansplat(), watersplatting()
    assert ocean.iterations == 10_000
    assert ocean.densify.refine_stop * ocean.iterations == 7000
    for name in ("refine_start", "refine_every", "reset_every"):
        steps = [round(getattr(s.densify, name) * s.iterations) for s in (ocean, water)]
        assert steps[0] == steps[1], name
    assert ocean.medium == water.medium
    assert (ocean.weights.trinocular, ocean.weights.epipolar, ocean.weights.epipolar_end) == (0.1, 0.4, 0.2)
    assert (ocean.weights.residual, ocean.virtual.baseline, ocean.virtual.ratio) == (0.01, 0.4, 1.5)


def test_short_runs_are_culled_gently_and_long_ones_as_published():
    short, long = (with_recipe(UwbsSettings(iterations=n), "oceansplat") for n in (2000, 15_000))
    assert isinstance(short, OceanSplatSettings)
    assert (short.densify.reset_every, short.densify.prune_opacity) == (0, 0.1)
    assert long.densify == oceansplat().densify


def test_the_unit_is_a_third_of_the_median_depth(tiny_dive):
    scene = method(tiny_dive).scene
    assert third_of_depth(scene) == pytest.approx(1.0, abs=0.1)
    twice = replace(scene, scale=2.0)
    assert third_of_depth(twice) == pytest.approx(2 * third_of_depth(scene))
    assert isinstance(method(tiny_dive).start().primitives, GaussianPrimitives)
