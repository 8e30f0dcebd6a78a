"""Runs tests as other processors would see them: `python tests/processors.py [PROFILE ...] [--tests FILE ...]`.

A profile holds the environment under which the numerical libraries choose the code they would choose on that processor,
and the number of threads. Sums are then rounded in another order, fused multiply-adds come and go, and with them the
last digits of every result; a result that moves further than that is an accident of the processor it was made on.
Only code that this processor can run can be asked for: a profile of an older or smaller one.
"""

import argparse
import os
import subprocess
import sys
from dataclasses import dataclass, field
from pathlib import Path

ROOT = Path(__file__).parents[1]
DELICATE = (  # chains of searches and optimizations, where the last digit can decide
    "tests/pipeline/test_run.py",
    "tests/localization",
    "tests/sfm/colmap/test_adjustment.py",
    "tests/sfm/colmap/test_plausibility.py",
    "tests/sfm/colmap/test_poses.py",
    "tests/sfm/plane_sweep/test_estimate.py",
    "tests/sfm/medium/test_seathru.py",
    "tests/sfm/alignment/test_optimize.py",
    "tests/splat/test_pose_refinement.py",
    "tests/splat/recipes/test_seasplat.py",
    "tests/splat/test_end_to_end.py",
    "tests/raster",
)


@dataclass(frozen=True)
class Profile:
    """A processor to be imitated."""

    environment: dict[str, str] = field(default_factory=dict)
    numpy_keeps: str | None = None  # NumPy's own name of the largest instruction set used; None keeps all
    threads: int = 1


PROFILES = {
    "native": Profile(),
    "two-threads": Profile(threads=2),
    "haswell": Profile(
        {
            "NUMBA_CPU_NAME": "haswell",
            "OPENBLAS_CORETYPE": "Haswell",
            "MKL_ENABLE_INSTRUCTIONS": "AVX2",
            "ATEN_CPU_CAPABILITY": "avx2",
            "ONEDNN_MAX_CPU_ISA": "AVX2",
        },
        numpy_keeps="X86_V3",
    ),
    "zen": Profile(
        {
            "NUMBA_CPU_NAME": "haswell",  # LLVM's znver has instructions that Intel's processors lack
            "OPENBLAS_CORETYPE": "Zen",
            "MKL_ENABLE_INSTRUCTIONS": "AVX2",
            "MKL_CBWR": "COMPATIBLE",
            "ATEN_CPU_CAPABILITY": "avx2",
        },
        numpy_keeps="X86_V3",
        threads=2,
    ),
    "avx512": Profile({"NUMBA_CPU_NAME": "skylake-avx512", "OPENBLAS_CORETYPE": "SkylakeX"}),
    "generic": Profile(
        {
            "NUMBA_CPU_NAME": "generic",
            "OPENBLAS_CORETYPE": "Nehalem",
            "MKL_ENABLE_INSTRUCTIONS": "SSE4_2",
            "ATEN_CPU_CAPABILITY": "default",
            "ONEDNN_MAX_CPU_ISA": "SSE41",
        },
        numpy_keeps="X86_V2",
    ),
}
_BEYOND = {"X86_V2": ("AVX", "FMA", "X86_V3", "X86_V4"), "X86_V3": ("AVX512", "X86_V4")}


def environment(name: str) -> dict[str, str]:
    """The whole environment of a profile's tests. Each has compiled kernels of its own."""
    profile, threads = PROFILES[name], str(PROFILES[name].threads)
    counts = dict.fromkeys(("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS", "NUMBA_NUM_THREADS"), threads)
    cache = {"NUMBA_CACHE_DIR": str(ROOT / ".venv" / f"numba-cache-{name}"), "SWIMM3R_TEST_THREADS": threads}
    return {**os.environ, **counts, **cache, **_numpy(profile.numpy_keeps), **profile.environment}


def _numpy(keeps: str | None) -> dict[str, str]:
    """NumPy names what it can choose at run time, and refuses to disable anything else."""
    if keeps is None:
        return {}
    from numpy._core._multiarray_umath import __cpu_dispatch__ as choices

    return {"NPY_DISABLE_CPU_FEATURES": " ".join(c for c in choices if c.startswith(_BEYOND[keeps]))}


def main() -> int:
    """Run the tests under each profile and say which failed; the exit status is 1 where any did."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("profiles", nargs="*", help=f"of {', '.join(PROFILES)}; all where none is given")
    parser.add_argument("--tests", nargs="+", default=DELICATE, help="files or options of pytest")
    given = parser.parse_args()
    if unknown := set(given.profiles) - set(PROFILES):
        parser.error(f"no such profile: {', '.join(sorted(unknown))}")
    failed = []
    for name in given.profiles or PROFILES:
        print(f"== {name}", flush=True)
        command = [sys.executable, "-m", "pytest", "-q", *given.tests]
        if subprocess.run(command, cwd=ROOT, env=environment(name), check=False).returncode:
            failed.append(name)
    print(f"failed under: {', '.join(failed)}" if failed else "every profile passed")
    return 1 if failed else 0


if __name__ == "__main__":
    sys.exit(main())
