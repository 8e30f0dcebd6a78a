"""Gaussians: colors, shapes, projection and what relocation does to them."""

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from torch.nn.functional import normalize

from swimm3r.cameras import Cameras
from swimm3r.errors import InputError
from swimm3r.geometry import rotation_from_quaternion
from swimm3r.raster import rasterize
from swimm3r.splat.densify import adaptive, mcmc_gaussian
from swimm3r.splat.densify.rows import only
from swimm3r.splat.gaussian_settings import GaussianInitialSettings, GaussianRenderSettings
from swimm3r.splat.optimizer import Moments
from swimm3r.splat.primitives.gaussian import (
    GaussianPrimitives,
    colored,
    covariance,
    initial_gaussians,
    rescaled,
    seen_color,
    to_degree,
)
from swimm3r.splat.primitives.spherical_harmonics import Y_00, spherical_harmonics
from swimm3r.splat.projection.dispatch import project
from swimm3r.splat.projection.view_camera import ViewCamera, view_camera

VECTORS = np.load(Path(__file__).parents[2] / "data" / "uwbs_vectors.npz")


def gaussians(n: int, seed: int = 0) -> GaussianPrimitives:
    """Random ones in front of the origin, float64."""
    rng = torch.Generator().manual_seed(seed)

    def normal(*shape: int) -> torch.Tensor:
        return torch.randn(*shape, generator=rng, dtype=torch.float64)

    xyz = normal(n, 3) * torch.tensor([0.8, 0.6, 0.6]) + torch.tensor([0.0, 0.0, 3.5])
    return GaussianPrimitives(
        xyz,
        normal(n, 4),
        -2 + 0.5 * normal(n, 3),
        normal(n),
        normal(n, 3),
        0.3 * normal(n, 15, 3),
        0.03 * normal(n).abs(),
    )


def turned(view: ViewCamera, world2cam: torch.Tensor) -> ViewCamera:
    R, t = world2cam[:3, :3], world2cam[:3, 3]
    return replace(view, R=R, t=t, center=-R.mT @ t)


def test_without_higher_harmonics_a_color_is_the_same_from_everywhere():
    p = to_degree(gaussians(20), 0)
    assert torch.equal(seen_color(p, torch.zeros(3)), seen_color(p, 5 * torch.ones(3)))
    torch.testing.assert_close(seen_color(p, torch.zeros(3)), (0.5 + Y_00 * p.color).clamp(min=0))


def test_harmonics_turn_with_the_scene():
    """A turned color is again a sum of harmonics of the same degree, of the same power."""
    rng = torch.Generator().manual_seed(1)
    d = normalize(torch.randn(400, 3, generator=rng, dtype=torch.float64), dim=-1)
    R = rotation_from_quaternion(torch.tensor([0.3, -0.5, 0.7, 0.2], dtype=torch.float64))
    for degree in (1, 2, 3):
        rows = slice(degree**2, (degree + 1) ** 2)
        k = torch.randn(2 * degree + 1, generator=rng, dtype=torch.float64)
        turned_values = spherical_harmonics(d @ R.mT)[:, rows] @ k
        fitted = torch.linalg.lstsq(spherical_harmonics(d)[:, rows], turned_values[:, None])
        torch.testing.assert_close(spherical_harmonics(d)[:, rows] @ fitted.solution[:, 0], turned_values)
        torch.testing.assert_close(fitted.solution.norm(), k.norm())


def test_colors_are_never_negative_and_rays_have_no_length():
    p = gaussians(50)
    seen = colored(p.color, p.harmonics, p.xyz)
    assert (seen >= 0).all()
    torch.testing.assert_close(seen, colored(p.color, p.harmonics, 7 * p.xyz))


def test_covariances_have_the_squared_scales_as_variances_along_turned_axes():
    p = gaussians(20)
    axes = rotation_from_quaternion(p.quaternion)
    torch.testing.assert_close(axes.mT @ covariance(p) @ axes, torch.diag_embed(p.scale.exp().square()))


def test_a_change_of_unit_changes_lengths_alone():
    p = gaussians(20)
    ten = rescaled(p, 10.0)
    torch.testing.assert_close(covariance(ten), 100 * covariance(p))
    torch.testing.assert_close(ten.xyz, 10 * p.xyz)
    assert torch.equal(ten.harmonics, p.harmonics)


def test_gradients_of_the_image_agree_with_finite_differences(camera: Callable[..., Cameras]):
    view = view_camera(camera(32, 24), torch.float64)
    p, pose = gaussians(12), torch.cat([view.R, view.t[:, None]], -1)
    rng = torch.Generator().manual_seed(3)
    weight = torch.randn(5, 24, 32, generator=rng, dtype=torch.float64)

    def value(*t: torch.Tensor) -> torch.Tensor:
        q = GaussianPrimitives(*t[:-1], footprint=p.footprint)
        seen = project(q, turned(view, t[-1]), GaussianRenderSettings(antialiasing="mip"))
        assert seen.kernel == "gaussian"
        out = rasterize(seen.primitives, None, 24, 32, kernel="gaussian", alpha_min=1e-12, backend="reference")
        return (torch.cat([out.clear, out.z_depth[None], out.alpha[None]]) * weight).sum()

    leaves = [t.clone().requires_grad_() for t in (*p[:-1], pose)]
    found = torch.autograd.grad(value(*leaves), leaves)
    for k, gradient in enumerate(found):
        for _ in range(4):
            at = tuple(int(torch.randint(size, (), generator=rng)) for size in gradient.shape)
            moved = []
            for sign in (1, -1):
                tensors = [t.detach().clone() for t in leaves]
                tensors[k][at] += sign * 1e-6
                moved.append(float(value(*tensors)))
            difference = (moved[0] - moved[1]) / 2e-6
            assert abs(float(gradient[at]) - difference) < 1e-5 * max(float(gradient.abs().max()), 1e-3), (k, at)


def test_a_gaussian_reaches_as_far_as_its_radius(camera: Callable[..., Cameras]):
    view = view_camera(camera(), torch.float64)
    p = to_degree(gaussians(1), 0)._replace(
        xyz=torch.tensor([[0.1, -0.05, 3.5]], dtype=torch.float64), opacity=torch.tensor([9.0], dtype=torch.float64)
    )
    seen = project(p, view, GaussianRenderSettings())
    alpha = rasterize(seen.primitives, None, view.height, view.width, kernel="gaussian", backend="reference").alpha
    y, x = (alpha > 0).nonzero().unbind(-1)
    center = seen.primitives.mean2d[0]
    reach = (torch.stack([x, y], -1) + 0.5 - center).norm(dim=-1).max()
    assert reach <= seen.radius[0] < reach + 1.5


def test_gaussians_start_round_on_the_cloud_with_its_colors(tiny_dive):
    settings = GaussianInitialSettings(primitives=500, scale=0.5, opacity=0.3)
    p = initial_gaussians(tiny_dive.rec, settings, torch.Generator().manual_seed(0))
    assert (p.scale == p.scale[:, :1]).all()
    torch.testing.assert_close(torch.sigmoid(p.opacity), torch.full_like(p.opacity, 0.3))
    colors = {tuple(c) for c in tiny_dive.rec.cloud.raw.tolist()}
    assert len(p.xyz) >= 450
    nearest = (seen_color(p, torch.zeros(3))[:, None] - tiny_dive.rec.cloud.raw[None]).abs().amax(-1).amin(1)
    assert nearest.max() < 1e-5
    assert len(colors) > 100


def test_scales_of_copies_are_the_published_ones():
    o = torch.from_numpy(VECTORS["reloc_opacity"])[:, None]
    n = torch.arange(1, VECTORS["reloc_scale_factor_unclamped"].shape[1] + 1)[None]
    factor = mcmc_gaussian.scale_factor(*torch.broadcast_tensors(o, n.double()))
    np.testing.assert_allclose(factor, VECTORS["reloc_scale_factor_unclamped"], rtol=1e-9)


def test_one_copy_changes_nothing():
    o = torch.tensor([0.1, 0.9], dtype=torch.float64)
    torch.testing.assert_close(mcmc_gaussian.scale_factor(o, torch.ones(2)), torch.ones(2, dtype=torch.float64))


def test_the_dead_go_where_the_living_are_and_growth_stops_at_its_target():
    p = GaussianPrimitives(*(t.float() for t in gaussians(200)))
    p.opacity[:50] = -9.0
    done = mcmc_gaussian.relocate_and_grow(p, 230, 0.005, torch.Generator().manual_seed(0))
    q = done.primitives
    assert (len(q.xyz), done.relocated, done.added) == (230, 50, 30)
    assert (torch.sigmoid(q.opacity) >= 0.0049).all()
    living = {tuple(x) for x in p.xyz[50:].tolist()}
    assert {tuple(x) for x in q.xyz.tolist()} <= living
    untouched = torch.tensor([i for i in range(50, 200) if i not in set(done.restarted.tolist())])
    assert len(untouched) > 20
    assert all(torch.equal(a[untouched], b[untouched]) for a, b in zip(p, q, strict=True))


def test_a_relocated_gaussian_blocks_as_much_light_through_its_middle():
    """n in one place: 1 - (1 - o')^n = o, and the mean over a line through the middle keeps its mass."""
    o, n = 0.7, 3
    share = 1 - (1 - o) ** (1 / n)
    factor = float(mcmc_gaussian.scale_factor(torch.tensor([o]), torch.tensor([float(n)]))[0])
    x = torch.linspace(-12, 12, 40_001, dtype=torch.float64)
    alone = o * torch.exp(-(x**2) / 2)
    together = 1 - (1 - share * torch.exp(-((x / factor) ** 2) / 2)) ** n
    torch.testing.assert_close(together.mean(), alone.mean(), rtol=1e-6, atol=0)


def test_noise_moves_what_is_nearly_dead_and_leaves_the_rest():
    p = GaussianPrimitives(*(t.float() for t in gaussians(100)))
    p.opacity[:50], p.opacity[50:] = -6.0, 2.0
    moved = mcmc_gaussian.noise(p, 0.1, 0.005, torch.Generator().manual_seed(0))
    assert (moved[:50] != 0).any(-1).all()
    assert not moved[50:].any()


def test_fewer_points_than_a_neighborhood_are_refused(tiny_dive):
    cloud = tiny_dive.rec.cloud
    few = replace(tiny_dive.rec, cloud=type(cloud)(*(values[:3] for values in vars(cloud).values())))
    with pytest.raises(InputError, match="at least 4 points"):
        initial_gaussians(few, GaussianInitialSettings(), torch.Generator())


def pulled(n: int, hard: list[int]) -> dict[str, torch.Tensor]:
    """A memory in which some rows were pulled, by their place in the list the harder."""
    memory = adaptive.nothing_seen(n)
    memory["times"] += 2
    for place, row in enumerate(hard):
        memory["pull"][row] = 2.0 * (place + 1)
    return memory


def small_and_large(n: int = 40) -> GaussianPrimitives:
    p = GaussianPrimitives(*(t.float() for t in gaussians(n)))
    p.scale[:20], p.scale[20:] = -5.0, -1.0
    return p


def test_pulled_gaussians_double_where_small_and_split_where_large():
    p, rng = small_and_large(), torch.Generator().manual_seed(0)
    done = adaptive.multiply(p, pulled(40, [3, 25]), 0.5, 0.1, 100, rng)
    q = done.primitives
    assert done.source.tolist() == [*range(40), 3, 25]
    assert all(torch.equal(a[40], b[3]) and torch.equal(a[3], b[3]) for a, b in zip(q, p, strict=True))
    assert sorted(done.restarted.tolist()) == [25, 40, 41]
    for half in (25, 41):
        torch.testing.assert_close(q.scale[half].exp() * 1.6, p.scale[25].exp())
        assert (q.xyz[half] != p.xyz[25]).all()
    still = [i for i in range(40) if i != 25]
    assert all(torch.equal(a[still], b[still]) for a, b in zip(q, p, strict=True))


def test_halves_lie_within_the_shape_they_came_from():
    p = small_and_large()
    p = GaussianPrimitives(*(t[25:26].repeat(2000, *[1] * (t.ndim - 1)) for t in p))
    done = adaptive.multiply(p, pulled(2000, list(range(2000))), 0.5, 0.1, 4000, torch.Generator())
    off = (done.primitives.xyz - p.xyz[0]).double()
    expected = covariance(GaussianPrimitives(*(t[:1].double() for t in p)))[0]
    torch.testing.assert_close(off.T @ off / len(off), expected, rtol=0.15, atol=0.005)


def test_the_hardest_pulled_multiply_first_where_room_is_short():
    p = small_and_large()
    done = adaptive.multiply(p, pulled(40, [3, 7, 5]), 0.5, 0.1, 42, torch.Generator())
    assert done.source[40:].tolist() == [5, 7]
    full = adaptive.multiply(p, pulled(40, [3, 7, 5]), 0.5, 0.1, 40, torch.Generator())
    assert len(full.primitives.xyz) == 40


def test_culled_rows_leave_and_the_others_keep_their_place():
    done = adaptive.multiply(small_and_large(), pulled(40, [3, 25]), 0.5, 0.1, 100, torch.Generator())
    kept = torch.ones(42, dtype=torch.bool)
    kept[[0, 25]] = False
    left = only(done, kept)
    assert len(left.primitives.xyz) == 40
    assert left.source.tolist() == [*range(1, 25), *range(26, 40), 3, 25]
    assert torch.equal(left.primitives.xyz, done.primitives.xyz[kept])
    assert sorted(left.restarted.tolist()) == [38, 39]


def test_pulls_are_counted_while_a_gaussian_is_in_the_image(camera: Callable[..., Cameras]):
    view = view_camera(camera())
    p = GaussianPrimitives(*(t.float() for t in to_degree(gaussians(30), 0)))
    p.xyz[10:20, 2] = -3.0
    seen = project(p, view, GaussianRenderSettings())
    gradient = torch.ones(30, 2)
    memory = adaptive.remembered(adaptive.nothing_seen(30), gradient, seen, view)
    memory = adaptive.remembered(memory, gradient, seen, view)
    assert not memory["times"][10:20].any()
    shown = memory["times"] == 2
    assert shown.sum() >= 10
    torch.testing.assert_close(memory["pull"][shown] / 2, torch.full((int(shown.sum()),), float(np.hypot(40, 28))))


def test_dimming_bounds_opacities_and_forgets_their_moments_alone():
    p = small_and_large()
    moments = {
        name: Moments(torch.ones_like(t), torch.ones_like(t), torch.tensor(3.0)) for name, t in p._asdict().items()
    }
    q, after = adaptive.dimmed(p, moments, 0.5)
    assert float(torch.sigmoid(q.opacity).max()) <= 0.5 + 1e-6
    faint = torch.sigmoid(p.opacity) < 0.5
    assert torch.equal(q.opacity[faint], p.opacity[faint])
    assert not after["opacity"].first.any()
    assert after["xyz"].first.all()
