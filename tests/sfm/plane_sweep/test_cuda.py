"""The plane sweep's Warp kernels: on Warp's CPU device they agree with Numba's, and they compile for every card."""

from pathlib import Path

import numpy as np
import pytest
import torch

from swimm3r.devices import for_depth
from swimm3r.errors import DeviceError

wp = pytest.importorskip("warp", reason="warp-lang is not installed: the GPU source was not compiled")
from swimm3r.sfm.plane_sweep import numba_backend  # noqa: E402
from swimm3r.sfm.plane_sweep.cuda import backend  # noqa: E402
from swimm3r.sfm.plane_sweep.cuda import kernels as cuda_kernels  # noqa: E402
from swimm3r.sfm.plane_sweep.kernels import SCALE, doubled, packed  # noqa: E402
from swimm3r.sfm.plane_sweep.level import Level, Round, SweepNumbers  # noqa: E402
from swimm3r.sfm.plane_sweep.refinement import window  # noqa: E402
from swimm3r.sfm.plane_sweep.settings import PlaneSweepSettings  # noqa: E402

HEIGHT, WIDTH = 24, 36
NUMBERS = SweepNumbers(
    planes=np.linspace(0.2, 0.8, 12),
    radius=2,
    noise=(0.8 / 255 * SCALE) ** 2,
    edge=0.05,
    keep=2,
    smooth=0.15,
    smooth_fine=0.05,
)
OFFSETS = window(np.array([(x, y) for y in range(-3, 4) for x in range(-3, 4) if (x + y) % 2 == 0]))


def level(height: int = HEIGHT, width: int = WIDTH) -> Level:
    """A textured plane at q = 0.5 and three sources that see it from aside."""
    rng = np.random.default_rng(0)
    waves = rng.uniform(0.3, 1.2, (12, 2)), rng.uniform(0, 6, 12)

    def texture(x: np.ndarray, y: np.ndarray) -> np.ndarray:
        return 0.02 * np.sum([np.sin(a * x + b * y + c) for (a, b), c in zip(*waves, strict=True)], 0)

    x, y = np.meshgrid(np.arange(width, dtype=float), np.arange(height, dtype=float))
    shifts = ((6.0, 0.4), (-8.0, 0.6), (0.5, 10.0))
    sources = np.stack([texture(x - 0.5 * a, y - 0.5 * b) for a, b in shifts]).astype(np.float32)
    H = np.tile(np.eye(3), (3, 1, 1))
    H[:, 2, 0] = 1e-4
    seen = np.ones(sources.shape, bool)
    seen[1, :, :5] = False
    lenses = np.concatenate([H.reshape(3, 9), [(a, b, 0.01) for a, b in shifts]], 1).astype(np.float32)
    gray = texture(x, y).astype(np.float32)
    return Level(gray * np.float32(SCALE), gray + 0.5, np.ones(gray.shape, bool), packed(sources), seen, lenses)


def swept(device: str | None = None) -> np.ndarray:
    """Inverse depth after a whole sweep, by Warp on a device or by Numba."""
    coarse, fine = level(), level(2 * HEIGHT, 2 * WIDTH)
    rounds = [Round(OFFSETS, 1.0, 3), Round(OFFSETS, 2.5, 0)]
    if device is None:
        start = doubled(numba_backend.coarse_depth(coarse, NUMBERS))
        return numba_backend.refined(fine, NUMBERS, start, rounds)[0][..., 0]
    start = doubled(backend.coarse_depth(coarse, NUMBERS, device))
    return backend.refined(fine, NUMBERS, start, rounds, device)[0][..., 0]


def shares_apart(a: np.ndarray, b: np.ndarray, tolerance: float) -> float:
    return float((np.abs(a - b) > tolerance).mean())


def test_cost_volume_and_paths_agree_with_numba_to_1e_4():
    half, n = level(), NUMBERS
    ours, theirs = backend.coarse_depth(half, n, "cpu"), numba_backend.coarse_depth(half, n)
    assert shares_apart(ours, theirs, 1e-4) < 0.01  # pixels on the border of what a source shows
    assert np.median(np.abs(ours - 0.5)) < 0.02


@pytest.mark.parametrize(("step", "reach"), [(1.0, 3), (0.5, 1), (2.5, 0)])
def test_a_round_of_refinement_agrees_with_numba_to_1e_3(step: float, reach: int):
    fine, n = level(), NUMBERS
    rng = np.random.default_rng(1)
    surface = (0.003 * rng.standard_normal((HEIGHT, WIDTH, 3))).astype(np.float32)
    surface[..., 0] = 0.5 + 0.05 * rng.standard_normal((HEIGHT, WIDTH))
    rounds = [Round(OFFSETS, step, reach)]
    theirs = numba_backend.refined(fine, n, surface, rounds)
    ours = backend.refined(fine, n, surface, rounds, "cpu")
    for a, b in zip(ours, theirs, strict=True):
        assert shares_apart(a, b, 1e-3) < 0.01  # ties of two candidates


def test_a_whole_sweep_on_warp_finds_the_plane_that_numba_finds():
    assert shares_apart(swept("cpu"), swept(), 2e-3) < 0.02


@pytest.mark.parametrize("arch", [75, 80, 86, 89, 90])
def test_the_kernels_compile_ahead_of_time_without_a_gpu(arch: int, tmp_path: Path):
    made = wp.compile_aot_module(cuda_kernels, arch=arch, module_dir=tmp_path, use_ptx=True)
    ptx = Path(made[0]).read_text()
    assert f".target sm_{arch}" in ptx
    assert len(ptx.split(".visible .entry")) - 1 == 4


@pytest.mark.gpu
@pytest.mark.skipif(not torch.cuda.is_available(), reason="no CUDA device: nothing ran on a GPU")
def test_on_the_gpu_a_sweep_agrees_with_numba():
    assert shares_apart(swept("cuda"), swept(), 2e-3) < 0.02


@pytest.mark.skipif(torch.cuda.is_available(), reason="there is a CUDA device")
def test_a_gpu_that_is_not_there_is_refused():
    with pytest.raises(DeviceError, match="no cuda device"):
        for_depth("cuda")
    assert for_depth(PlaneSweepSettings().device).type == "cpu"
