"""From stored primitives through conditioning, projection and water to the image, and back as far as the pose."""

from collections.abc import Callable
from dataclasses import replace

import pytest
import torch

from swimm3r.cameras import Cameras
from swimm3r.raster import Backend, MediumMaps, RasterOutput, rasterize
from swimm3r.splat.primitives.beta import BetaPrimitives
from swimm3r.splat.projection.dispatch import project
from swimm3r.splat.projection.view_camera import ViewCamera, view_camera
from swimm3r.splat.settings import RenderSettings

Make = Callable[..., BetaPrimitives]
HEIGHT, WIDTH = 24, 32
TIME = torch.tensor(0.4, dtype=torch.float64)


def water() -> MediumMaps:
    rng = torch.Generator().manual_seed(5)
    Binf, beta_D, beta_B = torch.rand(3, 3, HEIGHT, WIDTH, generator=rng, dtype=torch.float64)
    return MediumMaps(Binf, 0.4 * beta_D, 0.4 * beta_B)


def turned(view: ViewCamera, world2cam: torch.Tensor) -> ViewCamera:
    """The camera with another pose; its center follows."""
    R, t = world2cam[:3, :3], world2cam[:3, 3]
    return replace(view, R=R, t=t, center=-R.mT @ t)


def loss(out: RasterOutput) -> torch.Tensor:
    rng = torch.Generator().manual_seed(6)
    weights = [torch.randn(image.shape, generator=rng, dtype=torch.float64).to(image) for image in out]
    return sum(((w * image).sum() for w, image in zip(weights, out, strict=True)), torch.zeros(()))


def image(p: BetaPrimitives, view: ViewCamera, backend: Backend) -> RasterOutput:
    dtype = p.xyz.dtype
    time = TIME.to(dtype) if p.query_mean.shape[1] == 4 else None
    drawn = project(p, view, RenderSettings(), time).primitives
    maps = MediumMaps(*(m.to(dtype) for m in water()))
    return rasterize(drawn, maps, HEIGHT, WIDTH, alpha_min=0.0, backend=backend)


def scene(primitives: Make, camera: Callable[..., Cameras], c: int) -> tuple[BetaPrimitives, ViewCamera, torch.Tensor]:
    """36 primitives that a 32 x 24 camera sees, and its pose, world to camera."""
    p, view = primitives(36, c, seed=2), view_camera(camera(WIDTH, HEIGHT), torch.float64)
    p = p._replace(
        beta=torch.cat([p.beta[:, :1], p.beta[:, 1:] - 1], -1),  # most of them show
        scale=torch.cat([p.scale[:, :3] + 0.8, p.scale[:, 3:]], -1),
    )
    return p, view, torch.cat([view.R, view.t[:, None]], -1)


@pytest.mark.parametrize("c", [3, 4])
def test_gradients_of_the_image_agree_with_finite_differences(c: int, primitives: Make, camera):
    p, view, pose = scene(primitives, camera, c)
    leaves = [t.clone().requires_grad_() for t in (*p[:-1], pose)]

    def value(tensors: list[torch.Tensor]) -> torch.Tensor:
        q = BetaPrimitives(*tensors[:-1], footprint=p.footprint)
        return loss(image(q, turned(view, tensors[-1]), "reference"))

    found = torch.autograd.grad(value(leaves), leaves)
    rng = torch.Generator().manual_seed(7)
    checked = 0
    with torch.no_grad():
        for k, gradient in enumerate(found):
            for _ in range(4 if k < len(found) - 1 else 8):
                at = tuple(int(torch.randint(size, (), generator=rng)) for size in gradient.shape)
                moved = []
                for sign in (1, -1):
                    tensors = [t.detach().clone() for t in leaves]
                    tensors[k][at] += sign * 1e-6
                    moved.append(value(tensors))
                difference = (moved[0] - moved[1]) / 2e-6
                scale = max(float(gradient.abs().max()), 1e-3)
                assert abs(float(gradient[at] - difference)) < 1e-5 * scale, (k, at)
                checked += bool(gradient[at] != 0)
    assert checked > 15


@pytest.mark.parametrize("c", [3, 4])
def test_the_fast_path_gives_the_oracles_image_and_gradients(c: int, primitives: Make, camera):
    p, view, pose = scene(primitives, camera, c)
    results = []
    kinds: list[tuple[torch.dtype, Backend]] = [(torch.float64, "reference"), (torch.float32, "numba")]
    for dtype, backend in kinds:
        leaves = [t.to(dtype).requires_grad_() for t in (*p[:-1], pose)]
        q = BetaPrimitives(*leaves[:-1], footprint=p.footprint.to(dtype))
        out = image(q, turned(view, leaves[-1]), backend)
        results.append((out, torch.autograd.grad(loss(out), leaves)))
    (exact, expected), (fast, found) = results
    assert exact.alpha.mean() > 0.1
    for a, b in zip(fast, exact, strict=True):
        torch.testing.assert_close(a.double(), b, rtol=0, atol=1e-4)
    for name, a, b in zip([*p._fields[:-1], "pose"], found, expected, strict=True):
        assert (a.double() - b).norm() < 1e-3 * b.norm(), name
