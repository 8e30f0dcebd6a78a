"""Every kernel of this machine against the float64 reference of its own kind, on scenes small enough for it.

Images are compared by their largest difference, gradients by the norm of theirs relative to the reference's. The plane
sweep has no slower form: its depth is compared with that of a plane in closed form.
"""

import importlib.util
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace

import torch
from torch import Tensor

from swimm3r.imaging.gray import LUMA
from swimm3r.imaging.undistortion import covering_pinholes
from swimm3r.raster import Backend, Kernel, MediumMaps, Primitives2D, SggBuffers, rasterize
from swimm3r.selftest.scenes import (
    PLANE_DEPTH,
    beta_primitives,
    cameras_before_plane,
    image_of_plane,
    overlapping,
    turned_camera,
)
from swimm3r.sfm.plane_sweep.settings import PlaneSweepSettings
from swimm3r.sfm.plane_sweep.sweep import sweep
from swimm3r.sfm.plane_sweep.views import make_view
from swimm3r.splat.primitives.beta import BetaPrimitives, trained
from swimm3r.splat.projection.dispatch import project
from swimm3r.splat.projection.plain import project_plainly
from swimm3r.splat.projection.view_camera import view_camera
from swimm3r.splat.settings import RenderSettings
from swimm3r.splat.training.losses import mean_ssim, photometric

_IMAGES, _GRADIENTS = 1e-5, 3e-5  # float32's rounding beside float64's, with room for other orders of summation
_CONDITIONED = 1e-3  # projections of nearly singular covariances round worse
_TAME = 2.0  # entries of conics; larger ones amplify rounding beyond any bound


@dataclass(frozen=True)
class Check:
    """One quantity of one kernel on one device."""

    kernel: str
    device: str
    error: float  # of the worst image, gradient or depth
    allowed: float

    @property
    def passed(self) -> bool:
        """Return whether the error is a number within the allowed one."""
        return self.error <= self.allowed


def check_kernels() -> Iterator[Check]:
    """All checks of this machine; those of a GPU follow where PyTorch and Warp can use one."""
    devices = ["cpu"]
    if torch.cuda.is_available() and importlib.util.find_spec("warp") is not None:
        devices.append("cuda")
    for device in devices:
        for kernel in ("beta", "gaussian"):
            yield from _rasterizer(device, kernel)
        for c in (3, 4):
            yield from _projection(device, c)
        yield from _photometric_loss(device)
    for device in devices:
        yield _plane_sweep(device)


def _rasterizer(device: str, kernel: Kernel) -> Iterator[Check]:
    p, medium = overlapping(200, 48, 64)
    backend: Backend = "numba" if device == "cpu" else "warp"
    images, gradients = _rasterized(p, medium, kernel, backend, device, torch.float32)
    expected_images, expected = _rasterized(p, medium, kernel, "reference", "cpu", torch.float64)
    name = f"rasterizer, {kernel.capitalize()} kernels"
    yield Check(f"{name}: images", device, _largest(images, expected_images), _IMAGES)
    yield Check(f"{name}: gradients", device, _relative(gradients, expected), _GRADIENTS)


def _rasterized(
    p: Primitives2D, medium: MediumMaps, kernel: Kernel, backend: Backend, device: str, dtype: torch.dtype
) -> tuple[list[Tensor], list[Tensor]]:
    """The images, and the gradients and SGG buffers of a fixed random cotangent."""
    height, width = medium.Binf.shape[1:]
    leaves = [t.to(device, dtype).requires_grad_() for t in (*p, *medium)]
    sgg = SggBuffers(*(b.to(dtype) for b in SggBuffers.zeros(len(p.depth), torch.device(device))))
    out = rasterize(
        Primitives2D(*leaves[:6]), MediumMaps(*leaves[6:]), height, width, kernel=kernel, sgg=sgg, backend=backend
    )
    rng = torch.Generator().manual_seed(9)
    cotangent = [torch.randn(image.shape, generator=rng).to(device, dtype) for image in out]
    gradients = torch.autograd.grad(out, leaves, cotangent)
    return [image.detach() for image in out], [*gradients, *sgg]


def _projection(device: str, c: int) -> Iterator[Check]:
    p, view, time = beta_primitives(700, c), view_camera(turned_camera(), torch.float64), torch.tensor(0.4)
    exact = BetaPrimitives(*(t.requires_grad_() for t in p))
    fast = BetaPrimitives(*(t.detach().to(device, torch.float32).requires_grad_() for t in p))
    moment = time if c == 4 else None
    pose = {name: getattr(view, name).to(device, torch.float32) for name in ("R", "t", "center")}
    there = None if moment is None else moment.to(device)
    expected = project_plainly(exact, view, RenderSettings(), None if moment is None else moment.double()).primitives
    found = project(fast, replace(view, **pose), RenderSettings(), there).primitives
    tame = (expected.conic.detach().abs().amax(-1) < _TAME) & (expected.depth.detach() > 0.3)
    name = "projection" + (" with time" if c == 4 else "")
    rows = [values.cpu()[tame] for values in found], [values[tame] for values in expected]
    yield Check(f"{name}: primitives", device, _relative(*rows), _GRADIENTS)
    gradients = (_gradients(fast, rows[0]), _gradients(exact, rows[1]))
    yield Check(f"{name}: gradients", device, _relative(*gradients), _CONDITIONED)


def _gradients(p: BetaPrimitives, outputs: list[Tensor]) -> list[Tensor]:
    """Gradients of a fixed random sum of the outputs by the stored parameters."""
    rng = torch.Generator().manual_seed(3)
    weights = [torch.randn(values.shape, generator=rng, dtype=torch.float64) for values in outputs]
    total = torch.stack([(w.to(values) * values).sum() for w, values in zip(weights, outputs, strict=True)]).sum()
    return list(torch.autograd.grad(total, list(trained(p).values())))


def _photometric_loss(device: str) -> Iterator[Check]:
    rng = torch.Generator().manual_seed(5)
    render, target = torch.rand(2, 3, 48, 64, generator=rng, dtype=torch.float64)
    exact = render.clone().requires_grad_()
    expected = 0.8 * (exact - target).abs().mean() + 0.2 * (1 - mean_ssim(exact, target))
    fast = render.to(device, torch.float32).requires_grad_()
    everywhere = torch.ones(48, 64, dtype=torch.bool, device=device)
    found = photometric(fast, target.to(device, torch.float32), everywhere, 0.2).loss
    gradients = torch.autograd.grad(found, fast), torch.autograd.grad(expected, exact)
    yield Check("image loss: value", device, _largest([found.detach()], [expected.detach()]), _IMAGES)
    yield Check("image loss: gradient", device, _relative(*gradients), _GRADIENTS)


def _plane_sweep(device: str) -> Check:
    """The median error of the depth in the middle of the image, relative to the plane's."""
    cameras = cameras_before_plane()
    everywhere = torch.ones(cameras.height, cameras.width, dtype=torch.bool)
    canvas = covering_pinholes(cameras, 640)
    views = [make_view(image_of_plane(cameras[i]) @ LUMA, everywhere, cameras[i], canvas[i]) for i in range(5)]
    settings = PlaneSweepSettings(sources=4, planes=48, threads=1)
    found = sweep(views[2], [views[i] for i in (0, 1, 3, 4)], (2.0, 9.0), settings, torch.device(device))
    middle = found.inverse_depth[16:-16, 24:-24]
    return Check("plane sweep: depth", device, float((middle * PLANE_DEPTH - 1).abs().median()), 0.005)


def _largest(found: Sequence[Tensor], expected: Sequence[Tensor]) -> float:
    return max(float((a.cpu().double() - b).abs().max()) for a, b in zip(found, expected, strict=True))


def _relative(found: Sequence[Tensor], expected: Sequence[Tensor]) -> float:
    """The largest difference of two tensors in the norm of the second."""
    pairs = zip(found, expected, strict=True)
    return max(float(((a.cpu().double() - b).norm() / b.norm().clamp(min=1e-12)).detach()) for a, b in pairs)
