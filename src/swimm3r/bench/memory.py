"""The cost of a piece of work, measured in a process of its own."""

import sys
from collections.abc import Callable
from concurrent.futures import ProcessPoolExecutor
from concurrent.futures.process import BrokenProcessPool
from multiprocessing import get_context
from pathlib import Path
from typing import TypeVar

import torch

from swimm3r.errors import DeviceError
from swimm3r.evaluate import NotComputed
from swimm3r.memory import MB, peak_since_reset_mb

Result = TypeVar("Result")
_RESET = Path("/proc/self/clear_refs")


def in_own_process(work: Callable[..., Result], *given: object) -> Result:
    """The result of `work(*given)` in a fresh process: no kernels are loaded yet, no memory is left over.

    All of it is sent between processes, so `work` is a module's function or a `partial` of one. Raises its errors, and
    DeviceError where the process was ended from outside.
    """
    try:
        with ProcessPoolExecutor(1, get_context("spawn")) as pool:
            return pool.submit(work, *given).result()
    except BrokenProcessPool as error:
        raise DeviceError(
            "the process that was measured was ended from outside",
            cause="most likely the computer ran out of memory",
            hint="fewer --jobs, or close other programs; the same command then goes on from here",
        ) from error


def with_peak_mb(work: Callable[[], Result]) -> tuple[Result, dict[str, float | NotComputed]]:
    """The result, and the peaks while it was made: `peak_mb` of the process, `peak_vram_mb` where CUDA was used.

    The process's peak is what Linux counts from a reset on, so what lay in memory before is in it.
    """
    before: NotComputed | None = None
    try:
        _RESET.write_text("5")  # VmHWM starts anew from what is resident now
    except OSError:
        before = NotComputed(f"{sys.platform} does not let a process reset its peak of memory")
    cuda = torch.cuda.is_available() and torch.cuda.is_initialized()
    if cuda:
        torch.cuda.reset_peak_memory_stats()
    result = work()
    peaks: dict[str, float | NotComputed] = {"peak_mb": before if before is not None else peak_since_reset_mb()}
    if torch.cuda.is_available() and torch.cuda.is_initialized():
        peaks["peak_vram_mb"] = torch.cuda.max_memory_allocated() / MB
    return result, peaks
