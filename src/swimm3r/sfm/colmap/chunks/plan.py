"""The cut of a long clip into chunks of frames that overlap.

Chunks are windows along an order in which frames that share matches stand near each other: time for a video, for
others the reverse Cuthill-McKee order of the graph of verified pairs, which keeps the distance between matched frames
small. Cost is that of sorting.
"""

from collections.abc import Iterable, Sequence

import numpy as np
from jaxtyping import Int
from scipy.sparse import coo_array
from scipy.sparse.csgraph import reverse_cuthill_mckee


def plan_chunks(order: Sequence[int], size: int, overlap: int) -> list[tuple[int, ...]]:
    """Windows of nearly equal length, at most `size`, along an order; neighbors share at least `overlap` frames."""
    assert overlap < size, "chunks that follow each other are one and the same"
    n = len(order)
    if n <= size:
        return [tuple(sorted(order))]
    count = -(-(n - overlap) // (size - overlap))
    starts = np.linspace(0, n - size, count).round().astype(int)
    return [tuple(sorted(order[start : start + size])) for start in starts.tolist()]


def order_by_matches(frames: int, pairs: Iterable[tuple[int, int]]) -> Int[np.ndarray, " n"]:
    """Frames 0..n-1 in an order that keeps matched ones near each other."""
    ends = np.array(sorted(pairs), np.int64).reshape(-1, 2)
    both = np.concatenate([ends, ends[:, ::-1]])
    graph = coo_array((np.ones(len(both)), both.T), shape=(frames, frames)).tocsr()
    return np.asarray(reverse_cuthill_mckee(graph, symmetric_mode=True), np.int64)
