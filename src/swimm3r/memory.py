"""Main memory: what this process has used at most, what is left, giving it back, and what running out looks like.

Sizes are in MB of 10^6 bytes. Torch-free, so that the command line can ask before anything large is loaded.
"""

import ctypes
import errno
import math
import sys
from pathlib import Path

from swimm3r.errors import DeviceError

MB = 10**6
_STATUS = Path("/proc/self/status")
_CGROUP = Path("/sys/fs/cgroup")  # version 2, of containers
_PHRASES = (  # libraries that name no type for it
    "can't allocate memory",  # torch's allocator
    "cannot allocate memory",  # the operating system's words
    "can't start new thread",  # a thread's stack is memory, too
    "std::bad_alloc",  # pycolmap
    "failed to map segment from shared object",  # the dynamic linker, of a library that is loaded late
    "insufficient memory",  # OpenCV
    "out of memory",  # CUDA
)


def peak_mb() -> float | None:
    """Peak resident memory of this process so far, MB; None on Windows, which does not say."""
    if sys.platform == "win32":
        return None
    import resource

    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    return peak * (1 if sys.platform == "darwin" else 1024) / MB


def peak_since_reset_mb() -> float:
    """Peak resident memory since /proc/self/clear_refs was last written to, MB; Linux only."""
    return _status_kib("VmHWM") * 1024 / MB


def available_mb() -> float | None:
    """Memory that this process can still take, MB: the least that computer, container and its own limit leave.

    None where unknown.
    """
    if sys.platform != "linux":
        return None
    import resource

    meminfo = Path("/proc/meminfo").read_text(encoding="utf-8")
    left = _kib(meminfo, "MemAvailable") * 1024
    limit, _ = resource.getrlimit(resource.RLIMIT_AS)
    if limit != resource.RLIM_INFINITY:
        left = min(left, limit - _status_kib("VmSize") * 1024)
    left = min(left, _left_in_container())
    return max(left, 0) / MB


def _left_in_container() -> float:
    """Bytes that cgroup version 2 leaves; pages that only cache files are given up where memory is short."""
    limit = _CGROUP / "memory.max"
    if not limit.is_file() or (most := limit.read_text(encoding="utf-8").strip()) == "max":
        return math.inf
    used = int((_CGROUP / "memory.current").read_text(encoding="utf-8"))
    statistics = (_CGROUP / "memory.stat").read_text(encoding="utf-8").splitlines()
    return int(most) - used + sum(int(line.split()[1]) for line in statistics if line.startswith("inactive_file "))


def return_freed() -> None:
    """Return memory that was freed to the operating system.

    The C library keeps freed blocks for later ones of their size. After a part of a run that made many small ones they
    serve nothing, and the next part's memory adds to them. Nothing happens where the C library cannot (all but glibc).
    """
    if sys.platform != "linux":
        return
    trim = getattr(ctypes.CDLL(None), "malloc_trim", None)
    if trim is not None:
        trim(0)


def out_of_memory(error: BaseException) -> DeviceError | None:
    """The failure in the user's words where memory ran out, by its type or by the words of the library; else None."""
    is_memory = isinstance(error, MemoryError) or (isinstance(error, OSError) and error.errno == errno.ENOMEM)
    is_library = isinstance(error, RuntimeError | OSError | ImportError) or type(error).__module__.split(".")[0] in (
        "cv2",
        "av",
    )
    text = str(error)
    if not is_memory and not (is_library and any(phrase in text.lower() for phrase in _PHRASES)):
        return None
    first = (text.splitlines() or [""])[0].strip()
    return DeviceError(
        "the computer's memory is too small for this" + (f" ({first})" if first else ""),
        cause="other programs hold much of it, a limit is set (ulimit -v, a container), or the frames are large",
        hint="close other programs, or a smaller --long-side and --splat.densify.cap-max, or --preset fast",
    )


def _status_kib(name: str) -> int:
    return _kib(_STATUS.read_text(encoding="utf-8"), name)


def _kib(text: str, name: str) -> int:
    """A line of Linux's tables of sizes: `VmHWM:   12345 kB`, by which it means KiB."""
    return int(next(line for line in text.splitlines() if line.startswith(f"{name}:")).split()[1])
