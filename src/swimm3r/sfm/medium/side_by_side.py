"""Frames worked on side by side by threads, their results in the frames' order."""

import os
from collections import deque
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from typing import TypeVar

from swimm3r.devices import torch_threads

Result = TypeVar("Result")
_MOST = 8  # threads: more wait for the interpreter


def in_order(work: Callable[[int], Result], items: Sequence[int], threads: int = 0) -> Iterator[Result]:
    """`work(item)` of every item, made by several threads and given in the order of the items.

    At most two results per thread wait to be taken. Torch computes with one thread inside: the frames are many.
    """
    threads = threads or min(_MOST, os.cpu_count() or 1)
    waiting: deque[Future[Result]] = deque()
    with torch_threads(1), ThreadPoolExecutor(threads) as pool:
        try:
            for item in items:
                waiting.append(pool.submit(work, item))
                if len(waiting) >= 2 * threads:
                    yield waiting.popleft().result()
            while waiting:
                yield waiting.popleft().result()
        finally:
            for future in waiting:
                future.cancel()
