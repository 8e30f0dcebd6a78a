"""`swimm3r doctor`: what this machine offers and what is missing, as a block to copy into an issue."""

import os
import platform
import shutil
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path

_PACKAGES = ("swimm3r", "torch", "numpy", "scipy", "numba", "pycolmap", "opencv-python-headless", "av", "warp-lang")


def doctor() -> None:
    """Print versions, processors, memory, disk and accelerators."""
    rows = {
        "python": platform.python_version(),
        "system": platform.platform(),
        "processors": str(os.cpu_count()),
        "memory": _memory(),
        "disk here": f"{shutil.disk_usage(Path.cwd()).free / 1e9:.0f} GB free",
        **{name: _version(name) for name in _PACKAGES},
        "accelerator": _accelerator(),
    }
    print("\n".join(f"{name:<24} {value}" for name, value in rows.items()))


def _version(package: str) -> str:
    try:
        return version(package)
    except PackageNotFoundError:
        return "not installed (optional)" if package == "warp-lang" else "MISSING: pip install swimm3r again"


def _memory() -> str:
    try:
        total = os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES")
    except (AttributeError, ValueError, OSError):  # Windows has no sysconf
        return "unknown"
    return f"{total / 1e9:.0f} GB"


def _accelerator() -> str:
    import torch

    if torch.cuda.is_available():
        properties = torch.cuda.get_device_properties(0)
        return f"{properties.name}, {properties.total_memory / 1e9:.0f} GB, CUDA {torch.version.cuda}"
    if torch.backends.mps.is_available():
        return "Apple MPS"
    return "none: everything runs on the processor, only slower"
