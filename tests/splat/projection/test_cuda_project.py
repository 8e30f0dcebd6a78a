"""Promises of the GPU's projection alone; `test_dispatch` and `test_fisheye` compare it with the plain form."""

from collections.abc import Callable
from pathlib import Path

import pytest
import torch

from swimm3r.cameras import Cameras
from swimm3r.splat.primitives.beta import BetaPrimitives
from swimm3r.splat.projection.dispatch import center_gradients, project
from swimm3r.splat.projection.view_camera import view_camera
from swimm3r.splat.settings import RenderSettings

wp = pytest.importorskip("warp", reason="warp-lang is not installed: the GPU source was not compiled")
from swimm3r.splat.projection import cuda_project  # noqa: E402

Make = Callable[..., BetaPrimitives]


@pytest.mark.parametrize("arch", [80, 90])
def test_the_kernels_compile_ahead_of_time_without_a_gpu(arch: int, tmp_path: Path):
    made = wp.compile_aot_module(cuda_project, arch=arch, module_dir=tmp_path, use_ptx=True)
    ptx = Path(made[0]).read_text()
    assert f".target sm_{arch}" in ptx
    assert len(ptx.split(".visible .entry")) - 1 == 4  # forward and adjoint of either lens
    assert ".local" not in ptx


def test_a_gradient_that_nobody_wants_is_not_made(
    primitives: Make, camera: Callable[..., Cameras], monkeypatch: pytest.MonkeyPatch
):
    made: list[bool] = []
    adjoint = cuda_project._adjoint

    def seen_adjoint(kernel, lens, given, on_plane, found) -> None:
        made.extend(values is not None for values in found)
        adjoint(kernel, lens, given, on_plane, found)

    monkeypatch.setattr(cuda_project, "_adjoint", seen_adjoint)
    p = BetaPrimitives(*(t.float() for t in primitives(40)))
    xyz = p.xyz.clone().requires_grad_()
    seen = cuda_project.project(p._replace(xyz=xyz), view_camera(camera()), RenderSettings())
    seen.primitives.depth.sum().backward()
    assert bool(xyz.grad.any())
    assert made == [True] + [False] * 10
    assert not seen.radius.requires_grad


@pytest.mark.gpu
@pytest.mark.skipif(not torch.cuda.is_available(), reason="no CUDA device: nothing was projected on a GPU")
@pytest.mark.parametrize("c", [3, 4])
def test_on_the_gpu_values_and_gradients_are_the_processors(c: int, primitives: Make, camera: Callable[..., Cameras]):
    p, view = BetaPrimitives(*(t.float() for t in primitives(3000, c))), view_camera(camera())
    moment, settings = torch.tensor(0.4) if c == 4 else None, RenderSettings()
    rng = torch.Generator().manual_seed(0)
    on_plane, weights = torch.randn(3000, 2, 3, generator=rng), torch.randn(3000, 2, generator=rng)
    results = []
    for device in ("cpu", "cuda"):
        there = BetaPrimitives(*(t.to(device).requires_grad_() for t in p))
        time, sight = None if moment is None else moment.to(device), view.to(torch.device(device))
        seen = project(there, sight, settings, time).primitives
        tame = (seen.conic.detach().abs().amax(-1) < 2) & (seen.depth > 0.3)  # the others amplify rounding
        total = (weights.to(device) * seen.mean2d + seen.conic[:, :2])[tame].sum() + seen.opacity[tame].sum()
        found = torch.autograd.grad(total, there, allow_unused=True, materialize_grads=True)
        centers = center_gradients(there, sight, settings, on_plane.to(device), time)[tame]
        results.append([t.detach().cpu() for t in (seen.mean2d[tame], seen.conic[tame], *found, centers)])
    for a, b in zip(*results, strict=True):
        assert (a - b).norm() <= 1e-3 * a.norm()
