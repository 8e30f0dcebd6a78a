"""Promises of the GPU back end alone: its source compiles for every card named, its warp-level sums are right."""

import re
import sys
from collections.abc import Callable
from pathlib import Path

import pytest
import torch

from swimm3r.errors import DeviceError
from swimm3r.raster import Kernel, MediumMaps, Primitives2D, SggBuffers, bin_primitives, rasterize

wp = pytest.importorskip("warp", reason="warp-lang is not installed: the GPU source was not compiled")
from swimm3r.raster.cuda import backend as cuda_backend  # noqa: E402
from swimm3r.raster.cuda import bins as cuda_bins  # noqa: E402
from swimm3r.raster.cuda import kernels as cuda_kernels  # noqa: E402

Scene = Callable[..., tuple[Primitives2D, MediumMaps]]
gpu = pytest.mark.gpu
needs_gpu = pytest.mark.skipif(not torch.cuda.is_available(), reason="no CUDA device: nothing ran on a GPU")


@pytest.mark.parametrize("arch", [80, 86, 90])
def test_the_kernels_compile_ahead_of_time_without_a_gpu(arch: int, tmp_path: Path):
    made = wp.compile_aot_module(cuda_kernels, arch=arch, module_dir=tmp_path, use_ptx=True)
    ptx = Path(made[0]).read_text()
    assert f".target sm_{arch}" in ptx
    functions = ptx.split(".visible .entry")[1:]
    adjoints = [code for code in functions if "adjoint_kernel" in code[:200]]
    assert (len(functions), len(adjoints)) == (4, 2)  # a forward and an adjoint pass of either kernel
    for adjoint in adjoints:
        assert "vote" in adjoint
        assert adjoint.count("shfl.sync.bfly") == 31  # fewer means loops that are not unrolled,
        assert ".local" not in adjoint  # and values in memory instead of registers
        assert len(re.findall(r"(?:red|atom)\.global\.add\.f32", adjoint)) == 1


@pytest.mark.parametrize("arch", [80, 86, 90])
def test_the_kernels_of_the_bins_compile_ahead_of_time_without_a_gpu(arch: int, tmp_path: Path):
    ptx = Path(wp.compile_aot_module(cuda_bins, arch=arch, module_dir=tmp_path, use_ptx=True)[0]).read_text()
    assert f".target sm_{arch}" in ptx
    assert ptx.count(".visible .entry") == 2
    assert ".local" not in ptx  # all values in registers


@pytest.mark.parametrize("kernel", ["beta", "gaussian"])
def test_device_binning_lists_nothing_of_primitives_that_are_none(kernel: Kernel, scene: Scene):
    p, _ = scene(60, 70, 90)
    p = Primitives2D(*(t.float() for t in p))
    broken = {"depth": (-1.0, torch.nan, torch.inf), "mean2d": (torch.nan, torch.inf), "conic": (torch.nan, 0.0)}
    broken |= {"opacity": (0.0, 1e-3, torch.nan), "beta": (0.0, -1.0, torch.nan)}
    gone = []
    for name, values in broken.items():
        for value in values:
            getattr(p, name)[len(gone)] = value
            gone.append(len(gone))
    bins = cuda_backend.bin_primitives(p, 70, 90, 1 / 255, kernel)
    assert len(bins.ids) > 0
    assert not set(bins.ids.tolist()) & set(gone)
    none = cuda_backend.bin_primitives(Primitives2D(*(t[:0] for t in p)), 70, 90, 1 / 255, kernel)
    assert len(none.ids) == 0
    assert not none.tile_start.any()


@pytest.mark.parametrize("kernel", ["beta", "gaussian"])
def test_device_binning_lists_the_tiles_that_the_cpu_lists(kernel: Kernel, scene: Scene):
    p, _ = scene(300, 70, 90)
    p = Primitives2D(*(t.float() for t in p))
    theirs, ours = cuda_backend.bin_primitives(p, 70, 90, 1 / 255, kernel), bin_primitives(p, 70, 90, kernel=kernel)
    assert torch.equal(theirs.tile_start, ours.tile_start)
    assert torch.equal(theirs.ids, ours.ids)
    seen = ours.ids.unique().long()
    torch.testing.assert_close(theirs.packed[seen, :12], ours.packed[seen, :12])


def test_bins_of_the_gpu_back_end_are_refused_by_the_cpu_kernels(scene: Scene):
    p, medium = scene(5, 20, 20)
    p = Primitives2D(*(t.float() for t in p))
    with pytest.raises(ValueError, match="made for the Warp back end"):
        rasterize(p, medium, 20, 20, bins=cuda_backend.bin_primitives(p, 20, 20, 1 / 255, "beta"), backend="numba")


def test_a_missing_warp_says_what_to_install(monkeypatch: pytest.MonkeyPatch, scene: Scene):
    p, medium = scene(5, 20, 20)
    for name in ("backend", "launch"):
        monkeypatch.delitem(sys.modules, f"swimm3r.raster.cuda.{name}")
    monkeypatch.delattr(sys.modules["swimm3r.raster.cuda"], "backend")
    monkeypatch.setitem(sys.modules, "warp", None)
    with pytest.raises(DeviceError, match=r"swimm3r\[cuda\]"):
        rasterize(p, medium, 20, 20, backend="warp")


@gpu
@needs_gpu
@pytest.mark.parametrize("kernel", ["beta", "gaussian"])
def test_on_the_gpu_a_pass_agrees_with_numba(kernel: Kernel, scene: Scene):
    p, medium = scene(20_000, 180, 320)
    results = []
    for device in ("cpu", "cuda"):
        leaves = [t.float().to(device).requires_grad_() for t in (*p, *medium)]
        sgg = SggBuffers.zeros(20_000, device)
        out = rasterize(Primitives2D(*leaves[:6]), MediumMaps(*leaves[6:]), 180, 320, kernel=kernel, sgg=sgg)
        rng = torch.Generator().manual_seed(1)
        cotangent = [torch.randn(image.shape, generator=rng).to(device) for image in out]
        grads = torch.autograd.grad(out, leaves, cotangent)
        results.append([t.detach().cpu() for t in (*out, *grads, *sgg)])
    for a, b in zip(*results, strict=True):
        assert (a - b).norm() <= 2e-5 * a.norm()


@gpu
@needs_gpu
def test_on_the_gpu_gradient_descent_finds_the_colors(scene: Scene):
    p, medium = scene(200, 64, 64)
    p, medium = Primitives2D(*(t.float().cuda() for t in p)), MediumMaps(*(t.float().cuda() for t in medium))
    target = rasterize(p, medium, 64, 64).rgb.detach()
    color = torch.full_like(p.color, 0.5).requires_grad_()
    optimizer = torch.optim.Adam([color], lr=0.02)
    errors = []
    for _ in range(200):
        optimizer.zero_grad()
        error = (rasterize(p._replace(color=color), medium, 64, 64).rgb - target).square().mean()
        error.backward()
        optimizer.step()
        errors.append(error.item())
    assert errors[-1] < 0.01 * errors[0]
