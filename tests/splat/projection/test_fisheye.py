"""The fast forms of the projection through a fisheye against the plain one: values, gradients, what is not shown."""

from collections.abc import Callable
from dataclasses import replace

import pytest
import torch
from tests.splat.projection.forms import FORMS, form_called

from swimm3r.splat.primitives.beta import BetaPrimitives
from swimm3r.splat.projection.dispatch import center_gradients
from swimm3r.splat.projection.plain import project_plainly
from swimm3r.splat.projection.view_camera import Projection, ViewCamera
from swimm3r.splat.settings import RenderSettings

Make = Callable[..., BetaPrimitives]
LENS = (0.02, -0.01, 0.004, -0.001)
FOLDING = (0.1, -0.2, 0.0, 0.0)  # its image is largest at 59 degrees
DOUBLE = torch.float64


def view(lens: tuple[float, float, float, float] = LENS) -> ViewCamera:
    """A camera of 150 degrees across, turned and off the origin."""
    turn = torch.tensor([[0, -0.1, 0.05], [0.1, 0, -0.02], [-0.05, 0.02, 0]], dtype=DOUBLE)
    R, t = torch.matrix_exp(turn), torch.tensor([0.05, -0.1, 0.2], dtype=DOUBLE)
    return ViewCamera(R, t, -R.mT @ t, 55.0, 54.0, 71.0, 49.0, 144, 96, lens)


def seen_all_over(make: Make, count: int, c: int = 3) -> BetaPrimitives:
    """Primitives from the axis to 80 degrees beside it, conditioned near the directions in which they are seen."""
    rng = torch.Generator().manual_seed(5)
    p, cam = make(count, c), view()
    angle, around = torch.rand(2, count, generator=rng, dtype=DOUBLE) * torch.tensor([[1.4], [6.28]])
    z = 1 + 3 * torch.rand(count, generator=rng, dtype=DOUBLE)
    at = z[:, None] * torch.stack([angle.tan() * around.cos(), angle.tan() * around.sin(), torch.ones_like(z)], -1)
    xyz = (at - cam.t) @ cam.R
    direction = torch.nn.functional.normalize(xyz - cam.center, dim=-1)
    query = torch.cat([direction + 0.05 * torch.randn(count, 3, generator=rng, dtype=DOUBLE), p.query_mean[:, 3:]], -1)
    return p._replace(xyz=xyz, query_mean=query)


def single(p: BetaPrimitives, cam: ViewCamera) -> tuple[BetaPrimitives, ViewCamera]:
    pose = {name: getattr(cam, name).float() for name in ("R", "t", "center")}
    return BetaPrimitives(*(t.float() for t in p)), replace(cam, **pose)


def leaves(p: BetaPrimitives, cam: ViewCamera) -> tuple[BetaPrimitives, ViewCamera, list[torch.Tensor]]:
    p = BetaPrimitives(*(t.detach().clone().requires_grad_() for t in p))
    pose = [t.detach().clone().requires_grad_() for t in (cam.R, cam.t, cam.center)]
    return p, replace(cam, R=pose[0], t=pose[1], center=pose[2]), [*p, *pose]


def gradients(seen: Projection, shown: torch.Tensor, of: list[torch.Tensor]) -> tuple[torch.Tensor, ...]:
    """Those of a sum with random weights over everything that the rasterizer reads of the primitives shown."""
    rng = torch.Generator().manual_seed(3)
    total = torch.zeros((), dtype=seen.primitives.depth.dtype)
    for values in seen.primitives:
        weight = torch.randn(values.shape, generator=rng, dtype=DOUBLE).to(values)
        total = total + (values * weight)[shown].sum()
    return torch.autograd.grad(total, of, materialize_grads=True)


@pytest.mark.parametrize("form", FORMS)
@pytest.mark.parametrize("c", [3, 4])
@pytest.mark.parametrize("settings", [RenderSettings(), RenderSettings(covariance="upper", antialiasing="dilation")])
def test_the_fast_form_agrees_with_the_plain_one(c: int, settings: RenderSettings, form: str, primitives: Make):
    p, time = seen_all_over(primitives, 700, c), torch.tensor(0.4) if c == 4 else None
    exact_p, exact_view, exact = leaves(p, view())
    oracle = project_plainly(exact_p, exact_view, settings, None if time is None else time.double())
    fast_p, fast_view, fast = leaves(*single(p, view()))
    seen = form_called(form).project(fast_p, fast_view, settings, time)
    tame = (oracle.primitives.conic.detach().abs().amax(-1) < 2) & (oracle.primitives.depth > 0.3)
    assert tame.sum() > 600
    for name, a, b in zip(seen.primitives._fields, seen.primitives, oracle.primitives, strict=True):
        torch.testing.assert_close(a[tame], b[tame].float(), rtol=1e-4, atol=1e-4, msg=lambda m, n=name: f"{n}: {m}")
    torch.testing.assert_close(seen.radius[tame], oracle.radius[tame].float(), rtol=1e-4, atol=1e-4)
    expected, found = gradients(oracle, tame, exact), gradients(seen, tame, fast)
    for name, a, b in zip([*p._fields, "R", "t", "center"], found, expected, strict=True):
        assert (a - b).abs().max() < 1e-3 * b.abs().max() + 1e-6, name
        assert (a - b).norm() <= 2e-4 * b.norm(), name


@pytest.mark.parametrize("form", FORMS)
def test_gradients_of_centers_agree_with_the_plain_ones(form: str, primitives: Make):
    p, settings = seen_all_over(primitives, 300), RenderSettings()
    on_plane = torch.randn(300, 2, 3, generator=torch.Generator().manual_seed(1), dtype=DOUBLE)
    expected = center_gradients(p, view(), settings, on_plane)
    found = form_called(form).center_gradients(*single(p, view()), settings, on_plane.float())
    assert (found - expected).norm() <= 1e-4 * expected.norm()


@pytest.mark.parametrize("form", FORMS)
@pytest.mark.parametrize("beside", [0.0, 1e-7, 1e-5, 1e-3, 0.0315, 0.0317, 0.3])
def test_values_and_gradients_stay_exact_toward_the_axis(beside: float, form: str, primitives: Make):
    cam = view()
    at = torch.tensor([[beside, -0.6 * beside, 1.0]], dtype=DOUBLE) * 2
    xyz = (at - cam.t) @ cam.R
    p = primitives(1)._replace(xyz=xyz, query_mean=torch.nn.functional.normalize(xyz - cam.center, dim=-1))
    exact_p, exact_view, exact = leaves(p, cam)
    oracle = project_plainly(exact_p, exact_view, RenderSettings())
    fast_p, fast_view, fast = leaves(*single(p, cam))
    seen = form_called(form).project(fast_p, fast_view, RenderSettings())
    for a, b in zip(seen.primitives, oracle.primitives, strict=True):
        torch.testing.assert_close(a, b.float(), rtol=1e-4, atol=1e-5)
    shown = torch.ones(1, dtype=torch.bool)
    for a, b in zip(gradients(seen, shown, fast), gradients(oracle, shown, exact), strict=True):
        torch.testing.assert_close(a, b.float(), rtol=1e-3, atol=1e-3 * float(b.abs().max()) + 1e-6)


@pytest.mark.parametrize("form", FORMS)
def test_nothing_shows_beyond_the_angle_at_which_the_image_turns_back_nor_behind(form: str, primitives: Make):
    p = seen_all_over(primitives, 400)
    behind = p.xyz[:100] - 6 * view().R[2]
    p = p._replace(xyz=torch.cat([behind, p.xyz[100:]]))
    hidden = project_plainly(p, view(FOLDING), RenderSettings()).primitives.depth == 0
    fast_p, fast_view, fast = leaves(*single(p, view(FOLDING)))
    seen = form_called(form).project(fast_p, fast_view, RenderSettings())
    assert 150 < hidden.sum() < 350
    assert torch.equal(seen.primitives.depth == 0, hidden)
    assert bool((seen.radius[hidden] == 0).all())
    drawn = seen.primitives
    total = sum((values[hidden].sum() for values in (drawn.mean2d, drawn.conic, drawn.depth)), torch.zeros(()))
    assert not any(bool(v.any()) for v in torch.autograd.grad(total, fast, materialize_grads=True))
    on_plane = torch.ones(400, 1, 3)
    on_centers = form_called(form).center_gradients(*single(p, view(FOLDING)), RenderSettings(), on_plane)
    assert not bool(on_centers[hidden].any())
