"""CPU time of the rasterizer: binning, forward, adjoint with all SGG buffers, on the three workloads of its design.

    python benchmarks/raster.py [--sizes S M L] [--devices cpu cuda] [--threads N] [--repeats N]

Prints CPU-ms (process CPU time summed over threads, median) beside a calibration, 1e9 float32 FMAs on one thread,
measured before and after. "ratio" is CPU-ms / calibration, which compares across machines. The reference is dense
(pixels x primitives) and runs at XS only (400 primitives, 64 x 36), with Numba at the same size beside it. Where there
is a GPU, rows "warp" follow: wall-clock milliseconds, the device waited for after every stage, and no ratio.
"""

import argparse

import torch

from swimm3r.raster import Backend
from swimm3r.selftest.speed import SIZES, calibration_ms, measure


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--sizes", nargs="+", default=["S", "M", "L"], choices=["S", "M", "L"])
    here = ["cpu", "cuda"] if torch.cuda.is_available() else ["cpu"]
    parser.add_argument("--devices", nargs="+", default=here, choices=here)
    parser.add_argument("--threads", type=int, default=torch.get_num_threads())
    parser.add_argument("--repeats", type=int, default=9)
    arguments = parser.parse_args()
    torch.set_num_threads(arguments.threads)
    calibration = calibration_ms()
    print(f"{arguments.threads} threads; calibration: 1e9 FMA in {calibration:.1f} CPU-ms")
    print("| size | back end | pairs tile x primitive | bins | forward | adjoint | sum CPU-ms | ratio | wall ms |")
    print("|---|---|---|---|---|---|---|---|---|")
    plan: list[tuple[str, Backend]] = []
    if "cpu" in arguments.devices:
        plan.append(("XS", "reference"))
        plan.extend((name, "numba") for name in ("XS", *arguments.sizes))
    if "cuda" in arguments.devices:
        plan.extend((name, "warp") for name in arguments.sizes)
    for name, backend in plan:
        row, bins = measure(SIZES[name], backend, 1 if backend == "reference" else arguments.repeats)
        total = row.bins + row.forward + row.adjoint
        print(
            f"| {name} | {backend} | {len(bins.ids)} | {row.bins:.1f} | {row.forward:.1f} | {row.adjoint:.1f} "
            f"| {total:.1f} | {'' if backend == 'warp' else f'{total / calibration:.2f}'} | {row.wall:.1f} |"
        )
    print(f"calibration again: {calibration_ms():.1f} CPU-ms")


if __name__ == "__main__":
    main()
