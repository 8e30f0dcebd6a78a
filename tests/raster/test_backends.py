"""Every fast back end against the float64 oracle on scenes small enough for it."""

from collections.abc import Callable
from pathlib import Path
from typing import NamedTuple

import numpy as np
import pytest
import torch

from swimm3r.raster import (
    Backend,
    Kernel,
    MediumMaps,
    Primitives2D,
    RasterOutput,
    SggBuffers,
    bin_primitives,
    rasterize,
)

Scene = Callable[..., tuple[Primitives2D, MediumMaps]]
VECTORS = np.load(Path(__file__).parents[1] / "data" / "uwbs_vectors.npz")
FAST: list[Backend] = ["numba", "warp"]
backends = pytest.mark.parametrize("backend", FAST)
KERNELS: list[Kernel] = ["beta", "gaussian"]
kernels = pytest.mark.parametrize("kernel", KERNELS)


class Step(NamedTuple):
    """Images, gradients and buffers of one forward and adjoint pass."""

    out: RasterOutput
    grads: tuple[torch.Tensor, ...]
    sgg: SggBuffers


def step(
    backend: Backend, p: Primitives2D, medium: MediumMaps, alpha_min: float = 1 / 255, kernel: Kernel = "beta"
) -> Step:
    """A pass with a fixed random cotangent for each of the four images; float32 except in the reference."""
    dtype = torch.float64 if backend == "reference" else torch.float32
    leaves = [t.to(dtype).requires_grad_() for t in (*p, *medium)]
    height, width = medium.Binf.shape[1:]
    sgg = SggBuffers(*(b.to(dtype) for b in SggBuffers.zeros(len(p.depth))))
    out = rasterize(
        Primitives2D(*leaves[:6]), MediumMaps(*leaves[6:]), height, width,
        alpha_min=alpha_min, kernel=kernel, sgg=sgg, backend=backend,
    )  # fmt: skip
    rng = torch.Generator().manual_seed(9)
    cotangent = [torch.randn(image.shape, generator=rng).to(dtype) for image in out]
    grads = torch.autograd.grad(out, leaves, cotangent)
    return Step(RasterOutput(*(image.detach() for image in out)), grads, sgg)


NAMES = (*Primitives2D._fields, *MediumMaps._fields)


def assert_same_step(got: Step, expected: Step, tolerance: float = 3e-6) -> None:
    """Images to 1e-5, gradients to `tolerance` of their norm."""
    for name, a, b in zip(RasterOutput._fields, got.out, expected.out, strict=True):
        torch.testing.assert_close(a.double(), b.double(), rtol=0, atol=1e-5, msg=lambda m, name=name: f"{name}: {m}")
    pairs = [*zip(NAMES, got.grads, expected.grads, strict=True)]
    pairs += [*zip(SggBuffers._fields, got.sgg, expected.sgg, strict=True)]
    for name, a, b in pairs:
        error = (a.double() - b.double()).norm()
        assert error <= tolerance * b.double().norm() + 1e-12, f"{name}: off by {error / b.double().norm():.1e}"


@backends
@pytest.mark.parametrize(("kernel", "alpha_min"), [("beta", 1 / 255), ("beta", 0.0), ("gaussian", 1 / 255)])
@pytest.mark.parametrize(("n", "height", "width"), [(60, 29, 37), (1, 5, 3), (200, 48, 64)])
def test_a_pass_agrees_with_the_oracle(
    backend: Backend, n: int, height: int, width: int, alpha_min: float, kernel: Kernel, scene: Scene
):
    p, medium = scene(n, height, width)
    got, expected = (step(b, p, medium, alpha_min, kernel) for b in (backend, "reference"))
    assert_same_step(got, expected, 3e-6 if kernel == "beta" else 3e-5)  # Gaussians pile up: R / (1 - alpha) cancels


@backends
@kernels
def test_an_opaque_stack_ends_the_pixel_where_the_oracle_ends_it(backend: Backend, kernel: Kernel, scene: Scene):
    p, medium = scene(80, 20, 20)
    p = p._replace(opacity=torch.full_like(p.opacity, 0.98), conic=p.conic / 30)
    expected = step("reference", p, medium, kernel=kernel)
    assert (expected.out.alpha > 0.999).any()
    assert (expected.out.alpha < 1 - 1e-4).all()
    got = step(backend, p, medium, kernel=kernel)
    assert_same_step(got, expected, 2e-5)  # R / (1 - alpha) magnifies float32's rounding 50 times


@backends
@kernels
def test_a_capped_pair_keeps_its_color_gradient_and_loses_its_shape_gradient(backend: Backend, kernel: Kernel):
    p = Primitives2D(
        torch.tensor([[0.5, 0.5]]), torch.tensor([[0.01, 0.0, 0.01]]), torch.rand(1, 3), torch.tensor([1.0]),
        torch.tensor([2.0]), torch.tensor([1.5]),
    )  # fmt: skip
    medium = MediumMaps(*torch.rand(3, 3, 1, 1, generator=torch.Generator().manual_seed(0)))
    got, expected = step(backend, p, medium, kernel=kernel), step("reference", p, medium, kernel=kernel)
    assert_same_step(got, expected)
    grads = dict(zip(NAMES, got.grads, strict=True))
    assert got.out.alpha.item() == pytest.approx(0.999)
    assert grads["color"].all()
    assert not grads["opacity"].any()
    assert not grads["mean2d"].any()


@backends
def test_an_image_of_caps_and_stops_agrees_with_the_oracle(backend: Backend, scene: Scene):
    """12 x 16 pixels, 14 primitives: one pair is capped, some pixels end before the last primitive."""
    p, medium = scene(14, 12, 16)
    p.opacity[0], p.beta[0] = 1.0, 0.8
    p.opacity[1:6] = 0.99
    p.mean2d[:6] = torch.tensor([8.5, 6.5]) + 0.3 * torch.arange(6)[:, None]
    p.conic[:6] /= 4
    expected, got = (step(b, p, medium, 0.0) for b in ("reference", backend))
    alone = rasterize(Primitives2D(*(t[:1] for t in p)), medium, 12, 16, alpha_min=0.0, backend="reference")
    assert (alone.alpha > 0.999 - 1e-12).sum() == 1
    assert (expected.out.alpha > 0.9985).any()
    assert_same_step(got, expected, 1e-4)
    for result in (got, expected):
        torch.testing.assert_close(result.sgg.geo + result.sgg.med, result.grads[0], rtol=1e-4, atol=1e-4)


@pytest.mark.parametrize("backend", ["reference", *FAST])
def test_depth_may_be_left_to_what_looks_at_depth(backend: Backend, scene: Scene):
    """Without `medium_depth_grad` the water moves no primitive along its ray, and nothing else changes."""
    p, medium = scene(60, 29, 37)
    given = [t.to(torch.float32).requires_grad_() for t in (*p, *medium)]
    weight = torch.rand(29, 37, generator=torch.Generator().manual_seed(4))
    grads, branches = [], []
    for full in (True, False):
        sgg = SggBuffers.zeros(60)
        out = rasterize(
            Primitives2D(*given[:6]), MediumMaps(*given[6:]), 29, 37, sgg=sgg, medium_depth_grad=full, backend=backend
        )
        grads.append(torch.autograd.grad((out.z_depth * weight).sum() + out.rgb.square().sum(), given))
        branches.append(sgg)
    for name, a, b in zip(NAMES, *grads, strict=True):
        if name == "depth":
            assert (a - b).norm() > 0.01 * a.norm()
            torch.testing.assert_close(b, branches[0].depth_iso[:, 2])
        else:
            torch.testing.assert_close(a, b)
    for a, b in zip(*branches, strict=True):
        torch.testing.assert_close(a, b)


@backends
def test_without_primitives_every_pixel_is_open_water(backend: Backend, scene: Scene):
    p, medium = scene(0, 20, 33)
    got = step(backend, p, medium)
    torch.testing.assert_close(got.out.rgb.double(), medium.Binf, rtol=0, atol=1e-6)
    assert not got.out.alpha.any()
    assert not got.grads[NAMES.index("beta_B")].any()


@backends
def test_primitives_behind_the_camera_or_outside_the_image_or_broken_change_nothing(backend: Backend, scene: Scene):
    p, medium = scene(40, 40, 50)
    first = Primitives2D(*(t[:20] for t in p))
    p.depth[20:25] = -1.0
    p.depth[25:27] = float("nan")
    p.mean2d[27:32] += 1000
    p.conic[32:36, 1] = 10  # not positive definite
    p.opacity[36:38] = 0
    p.mean2d[38:] = float("inf")
    got, expected = step(backend, p, medium), step(backend, first, medium)
    torch.testing.assert_close(got.out, expected.out, rtol=0, atol=0)
    assert not any(g[20:].any() for g in got.grads[:6])


@backends
def test_most_tiles_may_be_empty(backend: Backend, scene: Scene):
    p, medium = scene(3, 40, 200)
    p.mean2d[:] = torch.tensor([100.0, 21.0], dtype=torch.float64)
    assert_same_step(step(backend, p, medium), step("reference", p, medium))


@backends
def test_order_of_the_input_does_not_matter(backend: Backend, scene: Scene):
    p, medium = scene(60, 29, 37)
    shuffle = torch.randperm(60, generator=torch.Generator().manual_seed(2))
    a, b = step(backend, p, medium), step(backend, Primitives2D(*(t[shuffle] for t in p)), medium)
    torch.testing.assert_close(a.out, b.out, rtol=0, atol=0)
    torch.testing.assert_close(a.grads[0][shuffle], b.grads[0], rtol=1e-5, atol=1e-6)


@backends
@pytest.mark.parametrize("case", ["px00", "px01", "px02", "px03", "px05"])
def test_a_one_pixel_image_reproduces_the_published_pixel(backend: Backend, case: str):
    """A centerd primitive has alpha = opacity. px04 goes on below T = 1e-4, where a rasterizer ends the pixel."""
    x = {k: torch.from_numpy(np.array(VECTORS[f"{case}_in_{k}"])).float() for k in ("alpha", "c", "z")}
    n = len(x["alpha"])
    p = Primitives2D(
        torch.full((n, 2), 0.5), torch.tensor([[0.1, 0.0, 0.1]]).repeat(n, 1), x["c"], x["alpha"],
        torch.full((n,), 2.0), x["z"],
    )  # fmt: skip
    medium = MediumMaps(
        *(torch.from_numpy(VECTORS[f"{case}_in_{k}"]).float()[:, None, None] for k in ("Binf", "bD", "bB"))
    )
    leaves = [p.opacity.requires_grad_(), p.color.requires_grad_(), p.depth.requires_grad_(), *medium]
    for leaf in leaves:
        leaf.requires_grad_()
    out = rasterize(p, medium, 1, 1, alpha_min=0.0, backend=backend)
    for key, image in zip(("I", "J", "depth", "acc"), out, strict=True):
        torch.testing.assert_close(
            image.detach().flatten().double(),
            torch.from_numpy(VECTORS[f"{case}_out_{key}"]).flatten(),
            rtol=1e-5,
            atol=1e-6,
        )
    cotangent = [
        torch.from_numpy(np.array(VECTORS[f"{case}_in_{k}"])).float().reshape(image.shape)
        for k, image in zip(("gI", "gJ", "gZ", "gA"), out, strict=True)
    ]
    grads = torch.autograd.grad(out, leaves, cotangent)
    for key, grad in zip(("dalpha", "dc", "dz", "dBinf", "dbD", "dbB"), grads, strict=True):
        expected = torch.from_numpy(VECTORS[f"{case}_out_{key}"])
        torch.testing.assert_close(grad.double().reshape(expected.shape), expected, rtol=1e-4, atol=1e-5)


@backends
@kernels
def test_bins_made_once_serve_many_calls(backend: Backend, kernel: Kernel, scene: Scene):
    p, medium = scene(60, 29, 37)
    p, medium = Primitives2D(*(t.float() for t in p)), MediumMaps(*(t.float() for t in medium))
    bins = bin_primitives(p, 29, 37, kernel=kernel)
    torch.testing.assert_close(
        rasterize(p, medium, 29, 37, kernel=kernel, bins=bins, backend=backend),
        rasterize(p, medium, 29, 37, kernel=kernel, backend=backend),
    )
    with pytest.raises(ValueError, match=f"bins are for 29 x 37 pixels, alpha_min 0.00392157 and the {kernel} kernel"):
        rasterize(p, medium, 29, 37, kernel=kernel, bins=bins, alpha_min=0.1, backend=backend)


@backends
def test_clear_water_shows_the_clear_image(backend: Backend, scene: Scene):
    p, _ = scene(60, 29, 37)
    out = rasterize(p, None, 29, 37, backend=backend)
    torch.testing.assert_close(out.rgb, out.clear)
    assert out.rgb.dtype == torch.float64


@backends
@kernels
def test_clear_water_has_the_gradients_of_water_without_coefficients(backend: Backend, kernel: Kernel, scene: Scene):
    p, _ = scene(60, 29, 37)
    results = []
    water = MediumMaps(*torch.zeros(3, 3, 29, 37, dtype=torch.float64))
    ways: list[tuple[Backend, MediumMaps | None]] = [(backend, None), ("reference", water)]
    for way, medium in ways:
        leaves = [t.to(torch.float32 if medium is None else torch.float64).requires_grad_() for t in p]
        sgg = SggBuffers(*(b.to(leaves[0]) for b in SggBuffers.zeros(60)))
        out = rasterize(Primitives2D(*leaves), medium, 29, 37, kernel=kernel, sgg=sgg, backend=way)
        rng = torch.Generator().manual_seed(9)
        cotangent = [torch.randn(image.shape, generator=rng).to(leaves[0]) for image in out]
        results.append([*out, *torch.autograd.grad(out, leaves, cotangent), *sgg])
    for a, b in zip(*results, strict=True):
        assert (a - b).norm() <= 2e-5 * b.norm() + 1e-6


@backends
def test_the_depth_branch_alone_is_the_isolated_depth_gradient(backend: Backend, scene: Scene):
    p, medium = scene(60, 29, 37)
    p, medium = Primitives2D(*(t.float() for t in p)), MediumMaps(*(t.float() for t in medium))
    weight = torch.rand(29, 37, generator=torch.Generator().manual_seed(4))
    mean2d, depth = p.mean2d.requires_grad_(), p.depth.requires_grad_()
    sgg = SggBuffers.zeros(60)
    out = rasterize(p, medium, 29, 37, sgg=sgg, backend=backend)
    ((out.z_depth * weight).sum() + out.rgb.square().sum()).backward()
    d_mean, d_depth = torch.autograd.grad(
        rasterize(p, medium, 29, 37, backend=backend).z_depth, (mean2d, depth), weight
    )
    torch.testing.assert_close(sgg.depth_iso, torch.cat([d_mean, d_depth[:, None]], 1), rtol=1e-4, atol=1e-4)


def test_maps_of_another_size_are_refused(scene: Scene):
    p, medium = scene(5, 8, 8)
    with pytest.raises(ValueError, match=r"Binf must have shape \(3, 8, 9\)"):
        rasterize(p, medium, 8, 9)


@pytest.mark.parametrize("backend", ["reference", *FAST])
def test_a_gaussian_fades_as_the_exponential_of_half_its_squared_distance(backend: Backend):
    conic = torch.tensor([[0.05, 0.01, 0.03]])
    one = Primitives2D(
        torch.tensor([[8.0, 6.0]]), conic, torch.ones(1, 3), torch.tensor([0.7]), torch.tensor([0.5]), torch.ones(1)
    )
    alpha = rasterize(one, None, 12, 16, kernel="gaussian", backend=backend).alpha
    y, x = torch.meshgrid(torch.arange(12) + 0.5 - 6, torch.arange(16) + 0.5 - 8, indexing="ij")
    expected = 0.7 * torch.exp(-0.5 * (0.05 * x * x + 2 * 0.01 * x * y + 0.03 * y * y))
    torch.testing.assert_close(alpha, torch.where(expected >= 1 / 255, expected, 0.0), rtol=1e-5, atol=1e-6)


@pytest.mark.parametrize("backend", ["reference", *FAST])
def test_a_gaussian_is_the_limit_of_wide_and_steep_beta_kernels(backend: Backend, scene: Scene):
    """(1 - r2 / 2b)^b -> e^(-r2 / 2)."""
    p, medium = scene(60, 29, 37)
    p = Primitives2D(*(t.float() for t in p))
    medium = MediumMaps(*(t.float() for t in medium))
    b = 2000.0
    steep = p._replace(conic=p.conic / (2 * b), beta=torch.full_like(p.beta, b))
    half = p._replace(beta=torch.full_like(p.beta, 0.5))
    torch.testing.assert_close(
        rasterize(half, medium, 29, 37, kernel="gaussian", alpha_min=1e-4, backend=backend),
        rasterize(steep, medium, 29, 37, alpha_min=1e-4, backend=backend),
        rtol=0,
        atol=2e-3,
    )


def test_a_gaussian_needs_a_least_alpha(scene: Scene):
    p, medium = scene(5, 8, 8)
    for made in (lambda: rasterize(p, medium, 8, 8, kernel="gaussian", alpha_min=0.0),
                 lambda: bin_primitives(p, 8, 8, kernel="gaussian", alpha_min=0.0)):  # fmt: skip
        with pytest.raises(ValueError, match="must be above 0"):
            made()
