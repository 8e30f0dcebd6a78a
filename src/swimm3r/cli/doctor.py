"""`swimm3r doctor`: what this machine offers and what is missing, as a block to copy into an issue."""

import os
import platform
import shutil
import subprocess
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path

from swimm3r import memory
from swimm3r import weights as store
from swimm3r.cli.weights import whereabouts
from swimm3r.errors import DeviceError

_PACKAGES = ("swimm3r", "torch", "numpy", "scipy", "numba", "pycolmap", "opencv-python-headless", "av", "warp-lang")


def doctor(*, selftest: bool = False) -> None:
    """Print versions, processors, free memory and disk, the GPU with its driver, and which weights are here.

    Args:
        selftest: Compare every kernel of this machine with its reference and time the rasterizer; about a minute, and
            some more where kernels are compiled first.
    """
    rows = {
        "python": platform.python_version(),
        "system": platform.platform(),
        "processors": str(os.cpu_count()),
        "memory": _memory(),
        "disk here": _disk(Path.cwd()),
        "disk of the cache": _disk(store.directory()),
        **{name: _version(name) for name in _PACKAGES},
        "GPU driver": _driver(),
        "CUDA": _cuda(),
        "accelerator": _accelerator(),
        **{f"weights {entry.name}": whereabouts(entry.name) for entry in store.MANIFEST},
    }
    print("\n".join(f"{name:<24} {value}" for name, value in rows.items()))
    if selftest:
        _selftest()


def _selftest() -> None:
    """Print the table of checks and that of times. Raises DeviceError where a kernel is wrong."""
    from swimm3r.selftest import check_kernels, measure_speed

    print(f"\n{'kernel':<44} {'device':<8} {'error':<10} {'allowed':<10}")
    failed = []
    for check in check_kernels():
        verdict = "" if check.passed else "WRONG"
        print(f"{check.kernel:<44} {check.device:<8} {check.error:<10.1e} {check.allowed:<10.0e} {verdict}", flush=True)
        failed += [] if check.passed else [f"{check.kernel} ({check.device})"]
    print("\nrasterizer, one pass with gradients")
    for speed in measure_speed():
        print(f"{speed.device:<8} {speed}", flush=True)
    if failed:
        raise DeviceError(
            f"{len(failed)} kernels of this computer do not agree with their references: {', '.join(failed)}",
            cause="a defective driver or compiler, an unstable processor or GPU, or kernels compiled for another",
            hint="an issue with this output; until then --map-device cpu where only CUDA is wrong",
        )
    print("\nEvery kernel agrees with its reference.")


def _version(package: str) -> str:
    try:
        return version(package)
    except PackageNotFoundError:
        return "not installed (optional)" if package == "warp-lang" else "MISSING: pip install swimm3r again"


def _memory() -> str:
    free = memory.available_mb()
    left = "" if free is None else f", {free / 1e3:.1f} GB free for this program"
    try:
        total = os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES")
    except (AttributeError, ValueError, OSError):  # Windows has no sysconf
        return f"unknown{left}"
    return f"{total / 1e9:.1f} GB{left}"


def _disk(folder: Path) -> str:
    """Free space on the disk of a folder, or of the nearest one above it that exists."""
    there = next(path for path in (folder, *folder.parents) if path.exists())
    return f"{shutil.disk_usage(there).free / 1e9:.0f} GB free ({there})"


def _driver() -> str:
    """NVIDIA's driver by its own tool, which works without PyTorch's support for CUDA."""
    tool = shutil.which("nvidia-smi")
    if tool is None:
        return "none (no nvidia-smi)"
    query = [tool, "--query-gpu=driver_version,name,memory.total,memory.free", "--format=csv,noheader"]
    try:
        told = subprocess.run(query, capture_output=True, text=True, timeout=20, check=False)
    except subprocess.TimeoutExpired:
        return "nvidia-smi does not answer"
    if told.returncode:
        return f"nvidia-smi fails: {(told.stdout + told.stderr).strip().splitlines()[0]}"
    return "; ".join(line.strip() for line in told.stdout.splitlines())


def _cuda() -> str:
    """The CUDA that PyTorch was built for."""
    import torch

    built = torch.version.cuda
    if built is None:
        return "not supported by this PyTorch"
    return f"{built}, {'usable' if torch.cuda.is_available() else 'not usable: no GPU, or a driver that is too old'}"


def _accelerator() -> str:
    import torch

    if torch.cuda.is_available():
        properties = torch.cuda.get_device_properties(0)
        free, total = torch.cuda.mem_get_info(0)
        power = f"sm_{properties.major}{properties.minor}"
        return f"{properties.name}, {power}, {free / 1e9:.1f} of {total / 1e9:.1f} GB free"
    if torch.backends.mps.is_available():
        return "Apple MPS"
    return "none: everything runs on the processor, only slower"
