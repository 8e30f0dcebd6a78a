"""CPU time of the rasterizer: binning, forward, adjoint with all SGG buffers, on the three workloads of its design.

    python benchmarks/raster.py [--sizes S M L] [--threads N] [--repeats N]

Prints CPU-ms (process CPU time summed over threads, median) beside a calibration, 1e9 float32 FMAs on one thread,
measured before and after. "ratio" is CPU-ms / calibration, which compares across machines. The reference is dense
(pixels x primitives) and runs at XS only (400 primitives, 64 x 36), with Numba at the same size beside it. Where there
is a GPU, rows "warp" follow: wall-clock milliseconds, the device waited for after every stage, and no ratio.
"""

import argparse
import statistics
import time
from collections.abc import Callable
from typing import NamedTuple

import numba
import numpy as np
import torch

from swimm3r.raster import Backend, Bins, MediumMaps, Primitives2D, SggBuffers, bin_primitives, rasterize


class Size(NamedTuple):
    """One workload."""

    primitives: int
    width: int
    height: int


SIZES = {
    "XS": Size(400, 64, 36),
    "S": Size(20_000, 320, 180),
    "M": Size(100_000, 640, 360),
    "L": Size(400_000, 1280, 720),
}


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


@numba.njit(error_model="numpy", fastmath={"contract"})
def multiply_add(lanes: np.ndarray, passes: int) -> None:
    """One FMA per lane and pass. 96 lanes are 12 vectors of 8: enough independent chains to keep two FMA units busy."""
    for _ in range(passes):
        for k in range(np.uintp(lanes.size)):
            lanes[k] = lanes[k] * np.float32(0.999) + np.float32(0.001)


def cpu_ms(work: Callable[[], object], repeats: int) -> float:
    """Median CPU milliseconds of a call, all threads."""
    times = []
    for _ in range(repeats):
        start = time.process_time()
        work()
        times.append(1e3 * (time.process_time() - start))
    return statistics.median(times)


class Row(NamedTuple):
    """CPU-ms of the three stages, and wall-ms of their sum."""

    bins: float
    forward: float
    adjoint: float
    wall: float


def now(backend: str) -> float:
    """Seconds of the processor; on a GPU those that have passed once it has finished."""
    if backend != "warp":
        return time.process_time()
    torch.cuda.synchronize()
    return time.perf_counter()


def measure(size: Size, backend: Backend, repeats: int) -> tuple[Row, Bins]:
    """Each stage alone, medians over interleaved repeats."""
    device = "cuda" if backend == "warp" else "cpu"
    p, medium = workload(size)
    leaves = [t.to(device).requires_grad_() for t in (*p, *medium)]
    p = Primitives2D(*leaves[:6])
    rng = torch.Generator().manual_seed(1)
    bins = bin_primitives(p, size.height, size.width)
    stages: dict[str, list[float]] = {"bins": [], "forward": [], "adjoint": [], "wall": []}
    for repeat in range(repeats + 1):
        sgg = SggBuffers(*(b.to(p.mean2d.dtype) for b in SggBuffers.zeros(size.primitives, device)))
        clock = [now(backend)]
        wall = time.perf_counter()
        if backend != "reference":
            bins = bin_primitives(p, size.height, size.width)
        clock.append(now(backend))
        out = rasterize(
            Primitives2D(*leaves[:6]), MediumMaps(*leaves[6:]), size.height, size.width,
            sgg=sgg, bins=None if backend == "reference" else bins, backend=backend,
        )  # fmt: skip
        clock.append(now(backend))
        cotangent = [torch.randn(image.shape, generator=rng).to(device) for image in out]
        clock.append(now(backend))
        torch.autograd.grad(out, leaves, cotangent)
        clock.append(now(backend))
        wall = time.perf_counter() - wall
        if repeat == 0:
            continue  # compilation, first touch of memory
        for name, milliseconds in zip(
            stages, (clock[1] - clock[0], clock[2] - clock[1], clock[4] - clock[3], wall), strict=True
        ):
            stages[name].append(1e3 * milliseconds)
    return Row(*(statistics.median(v) for v in stages.values())), bins


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--sizes", nargs="+", default=["S", "M", "L"], choices=["S", "M", "L"])
    parser.add_argument("--threads", type=int, default=torch.get_num_threads())
    parser.add_argument("--repeats", type=int, default=9)
    arguments = parser.parse_args()
    torch.set_num_threads(arguments.threads)
    lanes = np.ones(96, np.float32)
    passes = 10**9 // 96
    multiply_add(lanes, 1)
    calibration = cpu_ms(lambda: multiply_add(lanes, passes), 5)
    print(f"{arguments.threads} threads; calibration: 1e9 FMA in {calibration:.1f} CPU-ms")
    print("| size | back end | pairs tile x primitive | bins | forward | adjoint | sum CPU-ms | ratio | wall ms |")
    print("|---|---|---|---|---|---|---|---|---|")
    plan = [("XS", "reference"), ("XS", "numba"), *((name, "numba") for name in arguments.sizes)]
    if torch.cuda.is_available():
        plan += [(name, "warp") for name in arguments.sizes]
    for name, backend in plan:
        row, bins = measure(SIZES[name], backend, 1 if backend == "reference" else arguments.repeats)
        total = row.bins + row.forward + row.adjoint
        print(
            f"| {name} | {backend} | {len(bins.ids)} | {row.bins:.1f} | {row.forward:.1f} | {row.adjoint:.1f} "
            f"| {total:.1f} | {'' if backend == 'warp' else f'{total / calibration:.2f}'} | {row.wall:.1f} |"
        )
    print(f"calibration again: {cpu_ms(lambda: multiply_add(lanes, passes), 5):.1f} CPU-ms")


if __name__ == "__main__":
    main()
