"""The rasterizer's speed on every device, beside the ratio that docs/experiments/rasterizer.md states.

Time on a processor is processor time of one thread, divided by that of 1e9 float32 FMAs on the same processor, which
compares across machines. Time on a GPU is wall-clock time, the device waited for.
"""

import importlib.util
import statistics
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from typing import NamedTuple

import numba
import numpy as np
import torch

from swimm3r.devices import torch_threads
from swimm3r.raster import Backend, Bins, MediumMaps, Primitives2D, SggBuffers, bin_primitives, rasterize


class Size(NamedTuple):
    """One workload."""

    primitives: int
    width: int
    height: int

    def __str__(self) -> str:
        return f"{self.primitives:,} primitives at {self.width}x{self.height}"


SIZES = {
    "XS": Size(400, 64, 36),
    "S": Size(20_000, 320, 180),
    "M": Size(100_000, 640, 360),
    "L": Size(400_000, 1280, 720),
}
STATED_RATIO = {"S": 0.61, "M": 2.90}
"""Rasterizer, one thread, in units of 1e9 FMAs: the table of docs/experiments/rasterizer.md."""


class Times(NamedTuple):
    """Milliseconds of the three stages, and wall-clock milliseconds of their sum."""

    bins: float
    forward: float
    adjoint: float
    wall: float


@dataclass(frozen=True)
class Speed:
    """One workload on one device."""

    device: str
    size: Size
    times: Times
    ratio: float | None  # of processor time to that of 1e9 FMAs; None on a GPU
    stated: float | None  # the ratio in the documents

    def __str__(self) -> str:
        t = self.times
        milliseconds = t.bins + t.forward + t.adjoint
        row = (
            f"{self.size}: {milliseconds:.1f} ms (bins {t.bins:.1f}, forward {t.forward:.1f}, adjoint {t.adjoint:.1f})"
        )
        if self.ratio is None:
            return row
        stated = "" if self.stated is None else f", {self.stated:.2f} in the documents"
        return f"{row}, {self.ratio:.2f} of 1e9 FMAs{stated}"


def measure_speed(repeats: int = 3) -> Iterator[Speed]:
    """The sizes S and M on the processor and, where there is one, on the GPU."""
    with torch_threads(1):
        unit = calibration_ms()
        for name in ("S", "M"):
            times, _ = measure(SIZES[name], "numba", repeats)
            yield Speed("cpu", SIZES[name], times, sum(times[:3]) / unit, STATED_RATIO[name])
    if torch.cuda.is_available() and importlib.util.find_spec("warp") is not None:
        for name in ("S", "M", "L"):
            times, _ = measure(SIZES[name], "warp", repeats)
            yield Speed("cuda", SIZES[name], times, None, None)


def workload(size: Size, seed: int = 0) -> tuple[Primitives2D, MediumMaps]:
    """Primitives like those of a trained map, in smooth water."""
    rng = np.random.default_rng(seed)
    n = size.primitives
    radius = 6 * np.exp(0.4 * rng.standard_normal(n))
    radius[: n // 100] = rng.uniform(20, 60, n // 100)
    minor = radius * rng.uniform(0.35, 1, n)
    angle = rng.uniform(0, np.pi, n)
    cos, sin, a, b = np.cos(angle), np.sin(angle), radius**-2, minor**-2
    conic = np.stack([a * cos**2 + b * sin**2, (a - b) * cos * sin, a * sin**2 + b * cos**2], -1)
    faint = rng.random(n) < 0.6
    opacity = np.where(faint, rng.uniform(0.03, 0.25, n), rng.uniform(0.25, 0.9, n))
    mean = rng.uniform(0, 1, (n, 2)) * (size.width, size.height)
    exponent = 4 * np.exp(rng.normal(-0.3, 0.5, n))
    fields = (mean, conic, rng.random((n, 3)), opacity, exponent, rng.uniform(1, 10, n))
    coarse = torch.from_numpy(rng.uniform(0.05, 0.4, (1, 9, 4, 6)))
    maps = torch.nn.functional.interpolate(coarse, (size.height, size.width), mode="bicubic", align_corners=True)[0]
    return (
        Primitives2D(*(torch.from_numpy(f).float() for f in fields)),
        MediumMaps(*maps.float().clamp(min=0.01).reshape(3, 3, size.height, size.width)),
    )


def measure(size: Size, backend: Backend, repeats: int) -> tuple[Times, Bins]:
    """Each stage alone, medians over interleaved repeats, after one that does not count."""
    device = "cuda" if backend == "warp" else "cpu"
    p, medium = workload(size)
    leaves = [t.to(device).requires_grad_() for t in (*p, *medium)]
    p = Primitives2D(*leaves[:6])
    rng = torch.Generator().manual_seed(1)
    bins = bin_primitives(p, size.height, size.width)
    rows: list[Times] = []
    for _ in range(repeats + 1):
        sgg = SggBuffers(*(b.to(p.mean2d.dtype) for b in SggBuffers.zeros(size.primitives, torch.device(device))))
        clock = [_now(backend)]
        wall = time.perf_counter()
        if backend != "reference":
            bins = bin_primitives(p, size.height, size.width)
        clock.append(_now(backend))
        out = rasterize(
            Primitives2D(*leaves[:6]), MediumMaps(*leaves[6:]), size.height, size.width,
            sgg=sgg, bins=None if backend == "reference" else bins, backend=backend,
        )  # fmt: skip
        clock.append(_now(backend))
        cotangent = [torch.randn(image.shape, generator=rng).to(device) for image in out]
        clock.append(_now(backend))
        torch.autograd.grad(out, leaves, cotangent)
        clock.append(_now(backend))
        stages = (clock[1] - clock[0], clock[2] - clock[1], clock[4] - clock[3], time.perf_counter() - wall)
        rows.append(Times(*(1e3 * seconds for seconds in stages)))
    return Times(*(statistics.median(column) for column in zip(*rows[1:], strict=True))), bins


def calibration_ms() -> float:
    """Processor milliseconds of 1e9 float32 FMAs on one thread."""
    lanes = np.ones(96, np.float32)
    passes = 10**9 // 96
    _multiply_add(lanes, 1)
    return _cpu_ms(lambda: _multiply_add(lanes, passes), 5)


@numba.njit(error_model="numpy", fastmath={"contract"})
def _multiply_add(lanes: np.ndarray, passes: int) -> None:
    """One FMA per lane and pass. 96 lanes are 12 vectors of 8: enough independent chains to keep two FMA units busy."""
    for _ in range(passes):
        for k in range(np.uintp(lanes.size)):
            lanes[k] = lanes[k] * np.float32(0.999) + np.float32(0.001)


def _cpu_ms(work: Callable[[], object], repeats: int) -> float:
    """Median processor milliseconds of a call, all threads."""
    times = []
    for _ in range(repeats):
        start = time.process_time()
        work()
        times.append(1e3 * (time.process_time() - start))
    return statistics.median(times)


def _now(backend: Backend) -> float:
    """Seconds of the processor; on a GPU those that have passed once it has finished."""
    if backend != "warp":
        return time.process_time()
    torch.cuda.synchronize()
    return time.perf_counter()
