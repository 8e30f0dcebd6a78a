"""The differentiable underwater splat rasterizer: one function, two kernels, three back ends.

    I = B_inf + sum_i w_i (c_i e^{-beta_D z_i} - B_inf e^{-beta_B z_i}),   w_i = T_i alpha_i

which is the paper's Eqs. 11 and 12 after summation by parts (docs/derivations/compositing.md). `numba` runs on the CPU,
`warp` on CUDA, `reference` is the literal float64 oracle for tiny scenes.
"""

from dataclasses import dataclass
from types import ModuleType
from typing import Any, Literal

import torch
from torch import Tensor

from swimm3r import devices
from swimm3r.raster import reference
from swimm3r.raster.records import (
    ALPHA_MAX,
    ALPHA_MIN,
    T_MIN,
    TILE,
    Bins,
    Kernel,
    MediumMaps,
    Primitives2D,
    RasterOutput,
    SggBuffers,
)

__all__ = [
    "ALPHA_MAX",
    "ALPHA_MIN",
    "TILE",
    "T_MIN",
    "Backend",
    "Bins",
    "Kernel",
    "MediumMaps",
    "Primitives2D",
    "RasterOutput",
    "SggBuffers",
    "bin_primitives",
    "rasterize",
]

Backend = Literal["auto", "numba", "warp", "reference"]


def bin_primitives(
    p: Primitives2D, height: int, width: int, *, alpha_min: float = ALPHA_MIN, kernel: Kernel = "beta"
) -> Bins:
    """Sort primitives into 16 x 16 tiles, front to back, on their device; without gradient, and exact.

    Worth calling only to rasterize the same primitives twice: `rasterize` bins by itself.
    """
    _check_cut(alpha_min, kernel)
    kernels = _kernels("numba" if p.mean2d.device.type == "cpu" else "warp")
    return kernels.bin_primitives(_detached(p), height, width, alpha_min, kernel)


def rasterize(
    p: Primitives2D,
    medium: MediumMaps | None,
    height: int,
    width: int,
    *,
    alpha_min: float = ALPHA_MIN,
    kernel: Kernel = "beta",
    sgg: SggBuffers | None = None,
    bins: Bins | None = None,
    medium_depth_grad: bool = True,
    backend: Backend = "auto",
) -> RasterOutput:
    """Underwater image, clear image, z depth (not normalized) and alpha of one camera; differentiable in p and medium.

    `medium=None` is clear water: no veil, no attenuation. Pairs fainter than `alpha_min` are skipped; a Gaussian has no
    other end, so it needs one. `sgg` is added to in place when the gradient is taken. Without `medium_depth_grad` only
    `z_depth` moves a primitive in depth, not the light that the water takes and adds
    (docs/derivations/compositing.md#readings-of-the-paper). `auto` takes Numba on the CPU and Warp on CUDA, both in
    float32; `reference` keeps the inputs' precision. Outputs and gradients have the inputs' dtype. Raises ValueError
    where shapes, or `bins` made for another image, do not fit.
    """
    _check(p, medium, height, width)
    _check_cut(alpha_min, kernel)
    wanted = (height, width, alpha_min, kernel)
    if bins is not None and (bins.height, bins.width, bins.alpha_min, bins.kernel) != wanted:
        raise ValueError(
            f"bins are for {bins.height} x {bins.width} pixels, alpha_min {bins.alpha_min:g} and the {bins.kernel} "
            f"kernel, the image is {height} x {width} with alpha_min {alpha_min:g} and the {kernel} kernel"
        )
    if bins is not None and len(bins.packed) != len(p.mean2d):
        raise ValueError(f"bins hold {len(bins.packed)} primitives, got {len(p.mean2d)}")
    if backend == "auto":
        backend = "numba" if p.mean2d.device.type == "cpu" else "warp"
    if medium is None and backend != "numba":  # which has kernels without water
        medium = MediumMaps(*p.mean2d.new_zeros(3, 3, height, width))
    dtype = p.mean2d.dtype
    if backend == "reference":
        job = _Job(backend, height, width, alpha_min, kernel, sgg, None, medium_depth_grad)
        return RasterOutput(*_Rasterize.apply(job, *p, *(medium or ())))
    p = Primitives2D(*(t.float().contiguous() for t in p))
    maps = [t.float().contiguous() for t in medium or ()]
    if bins is None:
        bins = _kernels(backend).bin_primitives(_detached(p), height, width, alpha_min, kernel)
    job = _Job(backend, height, width, alpha_min, kernel, sgg, bins, medium_depth_grad)
    return RasterOutput(*(image.to(dtype) for image in _Rasterize.apply(job, *p, *maps)))


@dataclass(frozen=True)
class _Job:
    """One call of `rasterize`, without its tensors."""

    backend: Literal["numba", "warp", "reference"]
    height: int
    width: int
    alpha_min: float
    kernel: Kernel
    sgg: SggBuffers | None
    bins: Bins | None
    medium_depth_grad: bool


class _Rasterize(torch.autograd.Function):
    """Saves inputs, bins and the four images; no memory per pair."""

    @staticmethod
    def forward(ctx: Any, job: _Job, *tensors: Tensor) -> tuple[Tensor, ...]:
        p, medium = Primitives2D(*tensors[:6]), MediumMaps(*tensors[6:]) if tensors[6:] else None
        if job.bins is None:
            assert medium is not None
            out = reference.render(p, medium, job.height, job.width, job.alpha_min, job.kernel)
        else:
            out = _kernels(job.backend).forward(job.bins, p, medium)
        ctx.job = job
        ctx.save_for_backward(*tensors, *out)
        return tuple(out)

    @staticmethod
    @torch.autograd.function.once_differentiable
    def backward(ctx: Any, *cotangents: Tensor) -> tuple[Tensor | None, ...]:
        job, saved = ctx.job, ctx.saved_tensors
        p, maps, out = Primitives2D(*saved[:6]), saved[6:-4], RasterOutput(*saved[-4:])
        medium = MediumMaps(*maps) if maps else None
        cotangent = RasterOutput(*cotangents)
        parts = job.sgg if job.medium_depth_grad else _zeros(p)
        if job.bins is None:
            assert medium is not None
            grads, medium_grads = reference.adjoint(
                p, medium, job.height, job.width, job.alpha_min, job.kernel, cotangent, parts
            )
        else:
            with_medium = any(ctx.needs_input_grad[7:])
            kernels = _kernels(job.backend)
            grads, medium_grads = kernels.backward(job.bins, p, medium, out, cotangent, parts, with_medium)
        if not job.medium_depth_grad:
            assert parts is not None
            grads = grads._replace(depth=parts.depth_iso[:, 2])
            for given, part in zip(job.sgg or (), parts, strict=False):
                given += part
        return None, *grads, *(medium_grads or (None,) * len(maps))


def _kernels(backend: Backend) -> ModuleType:
    """A fast back end, imported when first used: Numba and Warp take half a second each."""
    if backend == "numba":
        from swimm3r.raster.cpu import backend as cpu_backend

        return cpu_backend
    try:
        from swimm3r.raster.cuda import backend as cuda_backend
    except ModuleNotFoundError as error:
        if error.name != "warp":
            raise
        raise devices.without_warp("move the tensors to the CPU") from error
    return cuda_backend


def _zeros(p: Primitives2D) -> SggBuffers:
    """Empty buffers in the precision of the primitives."""
    return SggBuffers(*(buffer.to(p.depth) for buffer in SggBuffers.zeros(len(p.depth), p.depth.device)))


def _detached(p: Primitives2D) -> Primitives2D:
    return Primitives2D(*(t.detach().float().contiguous() for t in p))


def _check_cut(alpha_min: float, kernel: Kernel) -> None:
    if kernel == "gaussian" and alpha_min <= 0:
        raise ValueError(
            f"a Gaussian ends where it is fainter than alpha_min, which must be above 0, got {alpha_min:g}"
        )


def _check(p: Primitives2D, medium: MediumMaps | None, height: int, width: int) -> None:
    n = len(p.mean2d)
    expected = {"mean2d": (n, 2), "conic": (n, 3), "color": (n, 3), "opacity": (n,), "beta": (n,), "depth": (n,)}
    for name, shape in expected.items():
        got = tuple(getattr(p, name).shape)
        if got != shape:
            raise ValueError(f"{name} of {n} primitives must have shape {shape}, got {got}")
    if height < 1 or width < 1:
        raise ValueError(f"an image needs at least one pixel, got {height} x {width}")
    for name, maps in zip(MediumMaps._fields, medium or (), strict=False):
        if tuple(maps.shape) != (3, height, width):
            raise ValueError(f"{name} must have shape (3, {height}, {width}), got {tuple(maps.shape)}")
