"""Number of threads that this process may use: its share where several processes work side by side."""

import os
import sys

_VARIABLES = (  # each library reads its own when it is loaded
    "OMP_NUM_THREADS",
    "NUMBA_NUM_THREADS",
    "MKL_NUM_THREADS",
    "OPENBLAS_NUM_THREADS",
    "OPENCV_FOR_THREADS_NUM",
)


def thread_count() -> int:
    """$OMP_NUM_THREADS where it is set, as in every process that `run_tasks` starts; else the cores of this process."""
    given = os.environ.get("OMP_NUM_THREADS", "")
    return int(given) if given.isdecimal() and int(given) > 0 else core_count()


def core_count() -> int:
    """Number of cores that this process may run on."""
    if hasattr(os, "sched_getaffinity"):
        return len(os.sched_getaffinity(0))
    return os.cpu_count() or 1  # macOS and Windows have no affinity to ask for


def thread_variables(threads: int) -> dict[str, str]:
    """The environment of a process that uses so many threads."""
    return {**dict.fromkeys(_VARIABLES, str(threads)), "OMP_WAIT_POLICY": "PASSIVE"}


def limit_threads(threads: int) -> None:
    """Let libraries that are loaded from now on, and torch in any case, use so many threads."""
    os.environ.update(thread_variables(threads))
    if "torch" in sys.modules:
        sys.modules["torch"].set_num_threads(threads)
