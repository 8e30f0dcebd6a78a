"""Ranges of independent work on as many threads as torch uses; the kernels release the GIL."""

import os
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from functools import lru_cache

import torch


@lru_cache(maxsize=4)
def _pool(threads: int, process: int) -> ThreadPoolExecutor:
    """Kept for the life of the process; a forked child makes its own."""
    return ThreadPoolExecutor(threads, thread_name_prefix="splat")


def spread(work: Callable[[int, int], None], n: int, at_least: int = 1) -> None:
    """Call work(first, beyond) until 0..n is done, in pieces of `at_least` or more."""
    threads = min(torch.get_num_threads(), max(1, n // at_least))
    if threads == 1:
        work(0, n)
        return
    edges = [n * k // (2 * threads) for k in range(2 * threads + 1)]
    for done in _pool(threads, os.getpid()).map(work, edges[:-1], edges[1:]):
        assert done is None
