"""Projection of conditioned primitives: a real camera's geometry, and the fast form against the plain one."""

from collections.abc import Callable
from dataclasses import replace
from typing import Literal

import pytest
import torch
from tests.splat.projection.forms import FORMS, form_called

from swimm3r.cameras import Cameras
from swimm3r.cameras import project as project_points
from swimm3r.splat.primitives.beta import BetaPrimitives
from swimm3r.splat.projection.dispatch import project
from swimm3r.splat.projection.plain import project_plainly
from swimm3r.splat.projection.view_camera import Projection, ViewCamera, view_camera
from swimm3r.splat.settings import RenderSettings
from swimm3r.splat.shared_settings import DILATION

Make = Callable[..., BetaPrimitives]


def leaves(p: BetaPrimitives, view: ViewCamera) -> tuple[BetaPrimitives, ViewCamera, list[torch.Tensor]]:
    p = BetaPrimitives(*(t.detach().clone().requires_grad_() for t in p))
    pose = [t.detach().clone().requires_grad_() for t in (view.R, view.t, view.center)]
    return p, replace(view, R=pose[0], t=pose[1], center=pose[2]), [*p, *pose]


def weighted_sum(seen: Projection) -> torch.Tensor:
    """Something that depends on everything the rasterizer reads."""
    rng = torch.Generator().manual_seed(3)
    drawn = seen.primitives.depth.detach() > 0
    total = torch.zeros((), dtype=seen.primitives.depth.dtype)
    for values in seen.primitives:
        weight = torch.randn(values.shape, generator=rng, dtype=torch.float64).to(values)
        total = total + (values * weight)[drawn].sum()
    return total


def test_a_center_lands_where_its_camera_sees_it(primitives: Make, camera: Callable[..., Cameras]):
    p = primitives(50)
    seen = project_plainly(
        p._replace(query_mean=torch.nn.functional.normalize(p.xyz - camera().centers[0], dim=-1)),
        view_camera(camera(), torch.float64),
        RenderSettings(),
    )
    pixels, z = project_points(camera(), p.xyz[None])
    torch.testing.assert_close(seen.primitives.mean2d, pixels[0])
    torch.testing.assert_close(seen.primitives.depth, z[0])


def test_a_primitive_is_drawn_out_to_the_ellipse_of_its_covariance(primitives: Make, camera: Callable[..., Cameras]):
    """A ball of radius s at the optical axis covers a disc of radius f s / z, here dilated."""
    p = primitives(1)
    p = p._replace(
        xyz=torch.tensor([[0.0, 0.0, 4.0]], dtype=torch.float64),
        query_mean=torch.tensor([[0.0, 0.0, 1.0]], dtype=torch.float64),
        scale=torch.full_like(p.scale, 0.0),
        lower=torch.zeros_like(p.lower),
    )
    view = replace(
        view_camera(camera(), torch.float64),
        R=torch.eye(3, dtype=torch.float64), t=torch.zeros(3, dtype=torch.float64),
        center=torch.zeros(3, dtype=torch.float64), fx=80.0, fy=80.0,
    )  # fmt: skip
    seen = project_plainly(p, view, RenderSettings(antialiasing="dilation"))
    radius = 80 * torch.log(torch.tensor(2.0, dtype=torch.float64)) / 4
    expected = (radius**2 + DILATION).rsqrt() ** 2
    torch.testing.assert_close(
        seen.primitives.conic[0], torch.stack([expected, 0 * expected, expected]), atol=1e-9, rtol=1e-6
    )
    assert abs(seen.radius[0] - (radius**2 + DILATION + 0.1).sqrt()) < 1e-6  # 0.1: the floor of the spread


def test_what_is_behind_the_camera_is_not_drawn(primitives: Make, camera: Callable[..., Cameras]):
    p = primitives(20)
    for form in (project, project_plainly):
        behind = BetaPrimitives(*(t.float() for t in p._replace(xyz=-p.xyz, lower=0 * p.lower)))
        assert (form(behind, view_camera(camera()), RenderSettings()).primitives.depth == 0).all()


@pytest.mark.parametrize("form", FORMS)
@pytest.mark.parametrize("c", [3, 4])
@pytest.mark.parametrize("antialiasing", ["mip", "dilation"])
@pytest.mark.parametrize("covariance", ["symmetric", "upper"])
def test_the_fast_form_agrees_with_the_plain_one(
    c: int,
    covariance: Literal["symmetric", "upper"],
    antialiasing: Literal["mip", "dilation"],
    form: str,
    primitives: Make,
    camera: Callable[..., Cameras],
):
    settings = RenderSettings(covariance=covariance, antialiasing=antialiasing)
    time = torch.tensor(0.4) if c == 4 else None
    p, view = primitives(700, c), view_camera(camera(), torch.float64)
    exact_p, exact_view, exact = leaves(p, view)
    oracle = project_plainly(exact_p, exact_view, settings, None if time is None else time.double())
    fast_p, fast_view, fast = leaves(
        BetaPrimitives(*(t.float() for t in p)),
        replace(view, R=view.R.float(), t=view.t.float(), center=view.center.float()),
    )
    seen = form_called(form).project(fast_p, fast_view, settings, time)
    # nearly singular covariances amplify rounding beyond any tolerance
    tame = (oracle.primitives.conic.detach().abs().amax(-1) < 2) & (oracle.primitives.depth > 0.3)
    assert tame.sum() > 300
    for name, a, b in zip(seen.primitives._fields, seen.primitives, oracle.primitives, strict=True):
        torch.testing.assert_close(a[tame], b[tame].float(), rtol=1e-4, atol=1e-5, msg=lambda m, n=name: f"{n}: {m}")
    torch.testing.assert_close(seen.radius[tame], oracle.radius[tame].float(), rtol=1e-4, atol=1e-4)

    def some(form: Projection) -> Projection:
        return replace(form, primitives=form.primitives._replace(depth=torch.where(tame, form.primitives.depth, 0.0)))

    expected = torch.autograd.grad(weighted_sum(some(oracle)), exact, materialize_grads=True)
    found = torch.autograd.grad(weighted_sum(some(seen)), fast, materialize_grads=True)
    for name, a, b in zip([*p._fields, "R", "t", "center"], found, expected, strict=True):
        assert (a - b).abs().max() < 1e-3 * b.abs().max() + 1e-6, name
        assert (a - b).norm() <= 2e-4 * b.norm(), name


def test_threads_change_no_bit(primitives: Make, camera: Callable[..., Cameras]):
    p = BetaPrimitives(*(t.float() for t in primitives(5000)))
    before = torch.get_num_threads()
    results = []
    try:
        for threads in (1, 2, 3):
            torch.set_num_threads(threads)
            q, view, everything = leaves(p, view_camera(camera()))
            seen = project(q, view, RenderSettings())
            gradients = torch.autograd.grad(weighted_sum(seen), everything, materialize_grads=True)
            results.append([*seen.primitives, *gradients])
    finally:
        torch.set_num_threads(before)
    for other in results[1:]:
        assert all(torch.equal(a, b) for a, b in zip(results[0], other, strict=True))


def test_a_distorted_camera_is_refused(camera: Callable[..., Cameras]):
    bent = replace(camera(), distortion=torch.tensor([[0.1]], dtype=torch.float64), model="SIMPLE_RADIAL")
    with pytest.raises(ValueError, match=r"camera\.drawn\(\)"):
        view_camera(bent)
