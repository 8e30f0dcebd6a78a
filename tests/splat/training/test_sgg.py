"""Alg. 1: worked numbers, limits, and the whole step against the float64 oracle."""

from collections.abc import Callable
from dataclasses import replace
from typing import Any

import pytest
import torch

from swimm3r.cameras import Cameras
from swimm3r.raster import MediumMaps, Primitives2D, SggBuffers, rasterize
from swimm3r.splat.medium.field import initial_field
from swimm3r.splat.primitives.beta import BetaPrimitives
from swimm3r.splat.projection.dispatch import center_gradients, project
from swimm3r.splat.projection.plain import project_plainly
from swimm3r.splat.projection.view_camera import view_camera
from swimm3r.splat.recipes import uwbs
from swimm3r.splat.rendering import draw
from swimm3r.splat.settings import InitialSettings, RenderSettings, SggSettings, UwbsSettings
from swimm3r.splat.training import sgg as gradients
from swimm3r.splat.training.scene import TrainingScene
from swimm3r.splat.training.sgg import Branches
from swimm3r.splat.views import TrainingView, TrainingViews

Make = Callable[..., BetaPrimitives]


def branches(geo: list[float], med: list[float], geo_abs: list[float]) -> Branches:
    return Branches(*(torch.tensor([v], dtype=torch.float64) for v in (geo, med, geo_abs)))


def test_a_worked_example():
    """|geo| = 4, |med| = 4, |geo_abs| = 8: u = 1/2, kappa = 1/2, q = 1/4."""
    b = branches([3.0, -1.0], [-2.0, 2.0], [5.0, 3.0])
    assert gradients.medium_uncertainty(b).item() == pytest.approx(0.5)
    assert gradients.cancellation(b).item() == pytest.approx(0.5)
    expected = [0.75 * 3 + 0.25 * 5 + 0.15 * 0.5 * 1, -(0.75 * 1 + 0.25 * 3) + 0.15 * 0.5 * 1]
    assert gradients.filtered_gradient(b, 0.15)[0].tolist() == pytest.approx(expected)


def test_without_water_and_without_cancellation_the_filter_changes_nothing():
    b = branches([3.0, -1.0], [0.0, 0.0], [3.0, 1.0])
    torch.testing.assert_close(gradients.filtered_gradient(b, 0.15), b.geo)


def test_where_all_is_water_only_the_residual_is_left():
    b = branches([0.0, 0.0], [2.0, -3.0], [4.0, 4.0])
    assert gradients.medium_uncertainty(b).item() == pytest.approx(1)
    torch.testing.assert_close(gradients.filtered_gradient(b, 0.15), 0.15 * b.med)
    assert (gradients.filtered_gradient(b, 0.0) == 0).all()


def test_a_primitive_that_was_not_seen_keeps_its_step():
    b = branches([0.0, 0.0], [0.0, 0.0], [0.0, 0.0])
    assert gradients.filtered_gradient(b, 0.15).tolist() == [[0, 0]]
    assert gradients.step_multiplier(gradients.medium_uncertainty(b), torch.zeros(1, 3).double(), 2.0) == 1


def test_the_multiplier_is_bounded_and_protects_depth_that_is_right():
    u = torch.tensor([1.0, 1.0, 1.0, 0.0, 0.5])
    pull = torch.tensor([0.0, 2.0, 1e9, 5.0, 2.0])[:, None] * torch.tensor([0.0, 0.6, 0.8])
    c = gradients.step_multiplier(u, pull, 2.0)
    assert c.tolist() == pytest.approx([1.0, 1 + 2 / (2 + 2), 2.0, 1.0, 1.25])
    assert gradients.step_multiplier(u, torch.zeros(5, 3), 2.0).tolist() == [2.0, 2.0, 2.0, 1.0, 1.5]


@pytest.mark.parametrize("time", [None, torch.tensor(0.4)], ids=["static", "dynamic"])
def test_center_gradients_are_the_projections_own(time, primitives: Make, camera: Callable[..., Cameras]):
    """Fast against autograd of the plain form, several at once; both against the whole adjoint."""
    p, view = primitives(500, 3 if time is None else 4), view_camera(camera(), torch.float64)
    rng = torch.Generator().manual_seed(1)
    pulls = torch.randn(500, 2, 3, generator=rng, dtype=torch.float64)
    expected = center_gradients(p, view, RenderSettings(), pulls, time)
    single = BetaPrimitives(*(t.float() for t in p))
    found = center_gradients(single, view_camera(camera()), RenderSettings(), pulls.float(), time)
    tame = (p.xyz @ view.R.mT + view.t)[:, 2] > 0.5
    torch.testing.assert_close(found[tame], expected[tame].float(), rtol=1e-3, atol=1e-3)
    xyz = single.xyz.clone().requires_grad_()
    seen_from = view_camera(camera())
    seen = project(single._replace(xyz=xyz), seen_from, RenderSettings(), time).primitives
    (whole,) = torch.autograd.grad((seen.mean2d, seen.depth), xyz, (pulls[:, 0, :2].float(), pulls[:, 0, 2].float()))
    torch.testing.assert_close(found[:, 0], whole, rtol=1e-4, atol=1e-4)


def scene(dive):
    """A few primitives of the wall, off their places and half transparent, and a view of it."""
    rng = torch.Generator().manual_seed(2)
    p = dive.truth.primitives
    p = p._replace(xyz=p.xyz + 0.03 * torch.randn(p.xyz.shape, generator=rng), opacity=torch.zeros_like(p.opacity))
    p = BetaPrimitives(*(t[::4].clone().requires_grad_() for t in p))
    camera = dive.cameras[4]
    z_depth = dive.rec.depth["4.png"].z_depth
    rgb = dive.frames.image(4).permute(2, 0, 1)
    everywhere = torch.ones(48, 64, dtype=torch.bool)
    view = TrainingView("4.png", camera, rgb, everywhere, z_depth, ~everywhere)
    return p, view


def differentiated(dive, settings: UwbsSettings):
    p, view = scene(dive)
    seen_from = view_camera(view.camera)
    drawing = draw(p, dive.truth.field, seen_from, settings, sgg=True)
    loss = uwbs.objective(p, drawing, view, settings, None, True)
    result = gradients.differentiate(loss.total, loss.depth, [*p], p, drawing, seen_from, settings)
    return result, drawing, p, view


def test_geometry_and_medium_add_up_to_the_exact_gradient_and_all_but_the_centers_keep_it(tiny_dive):
    result, drawing, p, view = differentiated(tiny_dive, UwbsSettings())
    plain = draw(p, tiny_dive.truth.field, view_camera(view.camera), UwbsSettings())
    loss = uwbs.objective(p, plain, view, UwbsSettings(), None, True)
    exact = torch.autograd.grad(loss.total, [*p, plain.projection.primitives.mean2d], materialize_grads=True)
    for name, a, b in zip(p._fields, result.gradients, exact, strict=False):
        assert (a - b).norm() <= 1e-5 * b.norm(), name  # the adjoint with buffers is another program: not the same bits
    both = drawing.sgg.geo + drawing.sgg.med
    torch.testing.assert_close(both, exact[-1], rtol=1e-4, atol=1e-5 * float(exact[-1].abs().max()))


def test_no_water_no_cancellation_no_change(tiny_dive):
    """In clear water u = 0; where a primitive's pixels all pull one way, the step is then plain Adam's."""
    clear = initial_field(None, UwbsSettings().medium, torch.Generator())
    with torch.no_grad():
        last: Any = clear.network[-1]
        last.bias.copy_(torch.tensor([-30.0] * 9))  # black, and neither attenuating nor scattering
    p, view = scene(tiny_dive)
    seen_from = view_camera(view.camera)
    drawing = draw(p, clear, seen_from, UwbsSettings(), sgg=True)
    loss = uwbs.objective(p, drawing, view, UwbsSettings(), None, True)
    result = gradients.differentiate(loss.total, loss.depth, [*p], p, drawing, seen_from, UwbsSettings())
    assert result.uncertainty.max() < 1e-4
    assert (result.multiplier - 1).max() < 1e-4
    b = Branches(drawing.sgg.geo, drawing.sgg.med, drawing.sgg.geo_abs)
    aligned = (gradients.cancellation(b) < 1e-3) & (b.geo.abs().sum(-1) > 0)
    assert aligned.any()
    plain = result.gradients[0][aligned].norm(dim=-1)
    assert (result.xyz[aligned].norm(dim=-1) < 0.02 * plain).all()


@pytest.mark.parametrize(
    "sgg",
    [
        pytest.param(SggSettings(), id="default"),
        pytest.param(SggSettings(split="direct"), id="direct", marks=pytest.mark.long),
        pytest.param(SggSettings(isolated="exact"), id="exact", marks=pytest.mark.long),
        pytest.param(SggSettings(depth="apart"), id="apart", marks=pytest.mark.long),
    ],
)
def test_the_step_of_the_centers_is_that_of_the_float64_oracle(tiny_dive, sgg: SggSettings):
    """Every reading of Alg. 1 against images drawn one branch at a time, in torch and float64."""
    settings = UwbsSettings(sgg=sgg)
    result, drawing, p, view = differentiated(tiny_dive, settings)
    expected = oracle(drawing, p, view, settings)
    assert (result.xyz - expected["xyz"]).norm() < 5e-3 * expected["xyz"].norm()
    assert (result.multiplier - expected["multiplier"]).norm() < 5e-3 * (expected["multiplier"] - 1).norm()


def oracle(drawing, p: BetaPrimitives, view: TrainingView, settings: UwbsSettings) -> dict[str, torch.Tensor]:
    """Corrections and multipliers of the plain form: black water shows the geometry's branch by itself."""
    exact = BetaPrimitives(*(t.detach().double().requires_grad_() for t in p))
    seen_from = view_camera(view.camera, torch.float64)
    seen = project_plainly(exact, seen_from, settings.render).primitives
    maps = MediumMaps(*(t.detach().double() for t in drawing.maps))
    images = [t.detach().requires_grad_() for t in drawing.images]
    again = replace(drawing, images=type(drawing.images)(*images))
    loss = uwbs.objective(p, again, view, settings, None, True)
    total = torch.autograd.grad(loss.total, images, materialize_grads=True, retain_graph=True)
    alone = [t.double() for t in torch.autograd.grad(loss.depth, images, materialize_grads=True)]
    on_images = [a.double() for a in total]
    if settings.sgg.depth == "apart":
        on_images = [a - b for a, b in zip(on_images, alone, strict=True)]

    def pull(
        maps: MediumMaps, cotangents: list[torch.Tensor], *, of=("mean2d",)
    ) -> tuple[tuple[torch.Tensor, ...], SggBuffers]:
        flat = Primitives2D(*(t.detach() for t in seen))
        leaves = {name: getattr(flat, name).clone().requires_grad_() for name in of}
        buffers = SggBuffers(*(b.double() for b in SggBuffers.zeros(len(flat.mean2d))))
        out = rasterize(flat._replace(**leaves), maps, 48, 64, alpha_min=1 / 255, sgg=buffers, backend="reference")
        found = torch.autograd.grad(out, [*leaves.values()], cotangents, materialize_grads=True)
        return found, buffers

    def backprop(found: dict[str, torch.Tensor]) -> torch.Tensor:
        outputs, cotangents = [getattr(seen, k) for k in found], [*found.values()]
        return torch.autograd.grad(outputs, exact.xyz, cotangents, retain_graph=True)[0]

    (g0,), own = pull(maps, on_images)
    nothing = torch.zeros_like(maps.Binf)
    dark = MediumMaps(nothing, *((maps.beta_D, maps.beta_B) if settings.sgg.split == "direct" else (nothing, nothing)))
    (geo,), parts = pull(dark, on_images)
    b = Branches(geo, g0 - geo, parts.full_abs)
    u = gradients.medium_uncertainty(b)
    delta = gradients.filtered_gradient(b, settings.sgg.residual) - g0
    names = ("mean2d", "conic", "opacity", "depth")
    by_depth: dict[str, torch.Tensor] = dict(zip(names, pull(maps, alone, of=names)[0], strict=True))
    if settings.sgg.depth == "apart":
        delta = delta + settings.sgg.residual * u[:, None] * by_depth["mean2d"]
    if settings.sgg.isolated == "exact" or settings.sgg.depth == "apart":
        isolated = backprop(by_depth)
    else:
        isolated = backprop({"mean2d": own.depth_iso[:, :2], "depth": own.depth_iso[:, 2]})
    return {
        "xyz": backprop({"mean2d": delta}),
        "multiplier": gradients.step_multiplier(u, isolated, settings.sgg.largest_step),
    }


def test_filter_and_multiplier_end_at_the_cut_off(tiny_dive):
    """Step 10 of 20 is the last that differs from plain Adam's, and differs in xyz alone."""
    settings = UwbsSettings(iterations=20, initial=InitialSettings(primitives=300, scale=2.0))
    views = TrainingViews(tiny_dive.rec, tiny_dive.frames, settings, 1.0)
    moved = {}
    for enabled in (True, False):
        sgg = replace(settings.sgg, enabled=enabled)
        recipe = uwbs.Uwbs(replace(settings, sgg=sgg), TrainingScene(tiny_dive.rec, 1.0, 1.0, views))
        for step in (10, 11):
            moved[enabled, step] = recipe.step(recipe.start(), views[3], step)[0].primitives
    assert not torch.equal(moved[True, 10].xyz, moved[False, 10].xyz)
    torch.testing.assert_close(moved[True, 10].scale, moved[False, 10].scale)
    assert torch.equal(moved[True, 11].xyz, moved[False, 11].xyz)
