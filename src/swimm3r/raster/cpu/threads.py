"""Ranges of independent work on several threads; the kernels release the GIL."""

import os
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from contextvars import ContextVar
from functools import lru_cache

import numpy as np
import torch
from jaxtyping import Int

from swimm3r.devices import torch_threads

_kernels: ContextVar[int | None] = ContextVar("threads of the kernels", default=None)


def kernel_threads() -> int:
    """Number of threads that a kernel is spread over: torch's, those before where these are for kernels alone."""
    return _kernels.get() or torch.get_num_threads()


@contextmanager
def threads_for_kernels_alone() -> Iterator[None]:
    """Kernels keep the threads that they have, torch computes on one.

    For code whose operations between kernels are small: on several threads they take no less time and more processor
    time, and their sums are rounded by the number of threads.
    """
    before = _kernels.set(kernel_threads())
    try:
        with torch_threads(1):
            yield
    finally:
        _kernels.reset(before)


@lru_cache(maxsize=4)
def _pool(threads: int, process: int) -> ThreadPoolExecutor:
    """Kept for the life of the process; a forked child makes its own."""
    return ThreadPoolExecutor(threads, thread_name_prefix="kernels")


def spread(work: Callable[[int, int], None], n: int, at_least: int = 1) -> None:
    """Call work(first, beyond) until 0..n is done, in pieces of `at_least` or more."""
    threads = min(kernel_threads(), max(1, n // at_least))
    if threads == 1:
        work(0, n)
    else:
        _run(work, [n * k // (2 * threads) for k in range(2 * threads + 1)], threads)


def spread_by_cost(work: Callable[[int, int], None], cost: Int[np.ndarray, " ends"]) -> None:
    """Call work(first, beyond) over ranges of 0..n of about equal cost, which is given cumulated."""
    n, threads = len(cost) - 1, kernel_threads()
    if threads == 1 or n < 2:
        work(0, n)
        return
    shares = np.linspace(0, int(cost[-1]), 8 * threads + 1)[1:-1]
    _run(work, np.unique(np.concatenate([[0], np.searchsorted(cost, shares), [n]])).tolist(), threads)


def _run(work: Callable[[int, int], None], edges: list[int], threads: int) -> None:
    for done in _pool(threads, os.getpid()).map(work, edges[:-1], edges[1:]):
        assert done is None
