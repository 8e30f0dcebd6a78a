"""The oracle against numbers worked out elsewhere (tests/data/uwbs_vectors.npz, raster literature of the paper)."""

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
import torch

from swimm3r.raster import Kernel, MediumMaps, Primitives2D, RasterOutput, SggBuffers, rasterize
from swimm3r.raster.reference import beta_kernel, blend, split_alpha_adjoint

Scene = Callable[..., tuple[Primitives2D, MediumMaps]]
VECTORS = np.load(Path(__file__).parents[1] / "data" / "uwbs_vectors.npz")
PIXELS = [f"px{i:02d}" for i in range(int(VECTORS["px_count"])) if f"px{i:02d}_name" in VECTORS]


def close(actual: torch.Tensor, expected: np.ndarray) -> None:
    torch.testing.assert_close(actual, torch.from_numpy(np.asarray(expected)), rtol=1e-10, atol=1e-10)


class Pixel:
    """One vector case: inputs that want a gradient, the water, and the loss's cotangent."""

    def __init__(self, name: str) -> None:
        self.name = name
        self.alpha, self.color, self.z = (self.input(k).requires_grad_() for k in ("alpha", "c", "z"))
        self.medium = MediumMaps(*(self.input(k).requires_grad_() for k in ("Binf", "bD", "bB")))
        self.cotangent = RasterOutput(*(self.input(k) for k in ("gI", "gJ", "gZ", "gA")))

    def input(self, key: str) -> torch.Tensor:
        return torch.from_numpy(np.array(VECTORS[f"{self.name}_in_{key}"]))

    def out(self, key: str) -> np.ndarray:
        return VECTORS[f"{self.name}_out_{key}"]


@pytest.mark.parametrize("name", PIXELS)
def test_blending_gives_the_published_pixel(name: str):
    pixel = Pixel(name)
    out = blend(pixel.alpha, pixel.color, pixel.z, pixel.medium)
    for key, value in {
        "T": out.T, "w": out.w, "V": out.V, "D": out.attenuated, "J": out.clear, "I": out.rgb,
        "depth": out.z_depth, "acc": out.alpha,
    }.items():  # fmt: skip
        close(value.detach(), pixel.out(key))


@pytest.mark.parametrize("name", PIXELS)
def test_autograd_of_the_blend_gives_the_published_gradients(name: str):
    pixel = Pixel(name)
    out = blend(pixel.alpha, pixel.color, pixel.z, pixel.medium)
    leaves = [pixel.alpha, pixel.color, pixel.z, *pixel.medium]
    images = [out.rgb, out.clear, out.z_depth, out.alpha]
    grads = torch.autograd.grad(images, leaves, list(pixel.cotangent), materialize_grads=True)
    for key, grad in zip(("dalpha", "dc", "dz", "dBinf", "dbD", "dbB"), grads, strict=True):
        close(grad, pixel.out(key))


@pytest.mark.parametrize("name", PIXELS)
def test_closed_forms_split_the_alpha_adjoint_as_published(name: str):
    pixel = Pixel(name)
    with torch.no_grad():
        split = split_alpha_adjoint(pixel.alpha, pixel.color, pixel.z, pixel.medium, pixel.cotangent)
    for key, value in {
        "da_clear": split.clear, "da_att": split.attenuation, "da_bs": split.backscatter, "da_med": split.med,
        "da_aux": split.other, "da_dep": split.depth, "da_geo": split.geo, "dalpha": split.geo + split.med,
    }.items():  # fmt: skip
        close(value, pixel.out(key))


def test_beta_kernel_matches_the_published_table():
    r2 = torch.from_numpy(VECTORS["kern_sigma"])[:, None]
    exponent = 4 * torch.exp(torch.from_numpy(VECTORS["kern_b"]))[None]
    r2, exponent = torch.broadcast_tensors(r2, exponent)
    close(beta_kernel(r2, exponent), VECTORS["kern_value"])


def test_the_veil_is_one_minus_the_blended_backscatter_transmittance():
    rng = torch.Generator().manual_seed(3)
    alpha, z = torch.rand(7, 20, generator=rng).double(), torch.rand(20, generator=rng).double().sort().values * 9
    medium = MediumMaps(*(torch.rand(7, 3, generator=rng).double() for _ in range(3)))
    out = blend(alpha, torch.rand(20, 3, generator=rng).double(), z, medium)
    identity = 1 - (out.w[..., None] * torch.exp(-medium.beta_B[:, None] * z[:, None])).sum(1)
    torch.testing.assert_close(out.V, identity, rtol=1e-13, atol=1e-13)


@pytest.mark.parametrize("kernel", ["beta", "gaussian"])
def test_gradients_of_the_image_agree_with_finite_differences(kernel: Kernel, scene: Scene):
    p, medium = scene(3, 3, 4)
    leaves = [t.requires_grad_() for t in (*p, *medium)]

    def images(*t: torch.Tensor) -> tuple[torch.Tensor, ...]:
        p, medium = Primitives2D(*t[:6]), MediumMaps(*t[6:])
        return rasterize(p, medium, 3, 4, alpha_min=1e-9, kernel=kernel, backend="reference")

    assert torch.autograd.gradcheck(images, leaves, fast_mode=True)


@pytest.mark.parametrize("kernel", ["beta", "gaussian"])
def test_geometry_and_medium_branches_add_up_to_the_plain_center_gradient(kernel: Kernel, scene: Scene):
    p, medium = scene(30, 13, 18)
    p.mean2d.requires_grad_()
    buffers = SggBuffers(*(b.double() for b in SggBuffers.zeros(30)))
    out = rasterize(p, medium, 13, 18, alpha_min=1e-9, kernel=kernel, sgg=buffers, backend="reference")
    rng = torch.Generator().manual_seed(1)
    torch.stack([(t * torch.rand(t.shape, generator=rng).double()).sum() for t in out]).sum().backward()
    assert p.mean2d.grad is not None
    torch.testing.assert_close(buffers.geo + buffers.med, p.mean2d.grad, rtol=1e-11, atol=1e-12)
    assert (buffers.full_abs >= p.mean2d.grad.abs() - 1e-12).all()


def test_water_without_coefficients_is_alpha_blending_over_the_veiling_light(scene: Scene):
    p, medium = scene(30, 13, 18)
    clear_water = MediumMaps(medium.Binf, torch.zeros_like(medium.Binf), torch.zeros_like(medium.Binf))
    out = rasterize(p, clear_water, 13, 18, backend="reference")
    torch.testing.assert_close(out.rgb, out.clear + (1 - out.alpha) * medium.Binf)


def test_no_primitive_leaves_the_veiling_light(scene: Scene):
    p, medium = scene(0, 4, 5)
    out = rasterize(p, medium, 4, 5, backend="reference")
    torch.testing.assert_close(out.rgb, medium.Binf)
    assert not out.alpha.any()
