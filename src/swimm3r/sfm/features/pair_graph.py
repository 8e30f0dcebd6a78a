"""Pair graphs: the pairs of n frames that are compared.

A pair (i, j) is unordered here and written with i < j, once; the network's two passes per pair are the caller's matter.
The reference's lists differ in habits that change nothing (a frame paired with itself where a cyclic window wraps,
order, both directions): `reference_pairs` has them, for comparison only.
"""

import re
from collections.abc import Sequence

import numpy as np
from jaxtyping import Float
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components
from torch import Tensor

from swimm3r.errors import UsageError
from swimm3r.sfm.mast3r.settings import (
    Complete,
    LogWindow,
    OneReference,
    PairGraph,
    Retrieval,
    SlidingWindow,
    VideoPairs,
)

Pairs = list[tuple[int, int]]


def parse_graph(text: str) -> PairGraph:
    """The graph that a text names.

        complete    swin[-K][-cyclic]    logwin[-K][-cyclic]    oneref[-FRAME]    retrieval[-KEYS-K]
        video[-WINDOW-CLOSURES]

    Raises UsageError for anything else, a number that does not parse included.
    """
    name, *fields = text.split("-")
    numbers = [int(f) for f in fields if re.fullmatch(r"\d+", f)]
    words = [f for f in fields if not re.fullmatch(r"\d+", f)]
    cyclic = words == ["cyclic"]
    match name, len(numbers), words:
        case "complete", 0, []:
            return Complete()
        case "swin", 0 | 1, ["cyclic" | "noncyclic"] | []:
            return SlidingWindow(*numbers, cyclic=cyclic)
        case "logwin", 0 | 1, ["cyclic" | "noncyclic"] | []:
            return LogWindow(*numbers, cyclic=cyclic)
        case "oneref", 0 | 1, []:
            return OneReference(*numbers)
        case "retrieval", 0 | 2, []:
            return Retrieval(*numbers)
        case "video", 0 | 2, []:
            return VideoPairs(*numbers)
    raise UsageError(
        f"there is no pair graph {text!r}",
        cause="a mistyped name or number",
        hint="video, complete, swin-5, swin-5-cyclic, logwin-4, oneref-0 or retrieval-20-10",
    )


def make_pairs(n: int, graph: PairGraph, similarity: Float[Tensor, "n n"] | None = None) -> Pairs:
    """The pairs of a graph over n frames, sorted, each once, no frame with itself.

    `similarity` (larger is more alike, rows are queries) is needed by Retrieval, and by Video for its loop closures.
    Raises UsageError where it is missing or the graph does not fit the number of frames.
    """
    match graph:
        case OneReference(frame) if not 0 <= frame < n:
            raise UsageError(
                f"the reference frame {frame} is not one of the {n} frames",
                cause="frames count from 0",
                hint=f"oneref-0 to oneref-{n - 1}",
            )
        case VideoPairs():
            found = video_pairs(n, graph, _needed(similarity, n) if graph.closures else None)
        case _:
            found = reference_pairs(n, graph, similarity)
    return sorted({(min(pair), max(pair)) for pair in found if pair[0] != pair[1]})


def reference_pairs(n: int, graph: PairGraph, similarity: Float[Tensor, "n n"] | None = None) -> Pairs:
    """The pairs as the reference lists them: unsorted, with its self-pairs."""
    match graph:
        case Complete():
            return [(i, j) for i in range(n) for j in range(i)]
        case SlidingWindow(size, cyclic):
            return _window(n, range(1, size + 1), cyclic)
        case LogWindow(size, cyclic):
            offsets = [2**k for k in range(size)]
            found = _window(n, [*offsets, *(-o for o in offsets)], cyclic)
            return [(i, j) for i, j in found if i != j]  # here the reference does drop them
        case OneReference(frame):
            return [(frame, j) for j in range(n) if j != frame]
        case Retrieval():
            return retrieval_pairs(_needed(similarity, n), graph)
        case VideoPairs():
            raise ValueError("the reference has no video graph")


def video_pairs(n: int, graph: VideoPairs, similarity: Float[Tensor, "n n"] | None) -> Pairs:
    """A window along the sequence and, per frame, the most similar far-away frames, a window apart from each other."""
    found = _window(n, range(1, graph.window + 1), cyclic=False)
    if similarity is None:
        return found
    order = np.argsort(-similarity.numpy(), axis=1, kind="stable")
    for i in range(n):
        chosen: list[int] = []
        for j in order[i]:
            if len(chosen) == graph.closures:
                break
            if abs(i - j) >= graph.gap and all(abs(j - k) > graph.window for k in chosen):
                chosen.append(int(j))
        found += [(i, j) for j in chosen]
    return found


def retrieval_pairs(similarity: Float[Tensor, "n n"], graph: Retrieval) -> Pairs:
    """Key frames all paired; each other frame with its nearest key frame; each frame with its most similar ones."""
    distance = 1 - similarity.numpy()
    n = len(distance)
    keys = farthest_frames(distance, min(graph.key_frames, n), graph.seed)
    found = {(a, b) for i, a in enumerate(keys) for b in keys[i + 1 :]}
    if keys:
        for i in set(range(n)) - set(keys):
            j = keys[int(np.argmin(distance[i, keys]))]
            found.add((min(i, j), max(i, j)))
    for i in range(n):
        for j in np.argsort(distance[i], kind="stable")[: graph.neighbors]:
            if i != j:
                found.add((min(i, int(j)), max(i, int(j))))
    return list(found)


def farthest_frames(distance: Float[np.ndarray, "n n"], count: int, seed: int) -> list[int]:
    """Frames far apart: the first is drawn, each next one is the farthest from all before it."""
    if count == 0:
        return []
    chosen = [int(np.random.RandomState(seed).choice(len(distance)))]  # the reference's generator
    nearest = distance[chosen[0]].copy()
    while len(chosen) < count:
        nearest[chosen] = -np.inf
        chosen.append(int(np.argmax(nearest)))
        nearest = np.minimum(nearest, distance[chosen[-1]])
    return chosen


def within(pairs: Pairs, span: int, cyclic_over: int | None = None) -> Pairs:
    """Only pairs at most `span` frames apart; around the end of a closed sequence of `cyclic_over` frames if given."""

    def apart(i: int, j: int) -> int:
        d = abs(i - j)
        return d if cyclic_over is None else min(d, cyclic_over - d)

    return [(i, j) for i, j in pairs if apart(i, j) <= span]


def both_directions(pairs: Pairs) -> Pairs:
    """The pairs followed by their mirror images."""
    return pairs + [(j, i) for i, j in pairs]


def groups(n: int, pairs: Sequence[tuple[int, int]]) -> list[list[int]]:
    """The frames that hang together through pairs, the largest group first."""
    i, j = np.array(pairs, dtype=np.int64).reshape(-1, 2).T
    count, label = connected_components(coo_array((np.ones(len(i)), (i, j)), shape=(n, n)), directed=False)
    members = [np.flatnonzero(label == k).tolist() for k in range(count)]
    return sorted(members, key=lambda group: (-len(group), group))


def _window(n: int, offsets: Sequence[int], cyclic: bool) -> Pairs:
    found = set()
    for i in range(n):
        for offset in offsets:
            j = (i + offset) % n if cyclic else i + offset
            if 0 <= j < n:
                found.add((min(i, j), max(i, j)))
    return list(found)


def _needed(similarity: Float[Tensor, "n n"] | None, n: int) -> Float[Tensor, "n n"]:
    if similarity is None:
        raise UsageError(
            "this pair graph needs to know which frames look alike",
            cause="no similarity matrix was computed",
            hint="compute one with sfm.retrieval, or take a window graph (swin-5)",
        )
    if len(similarity) != n:
        raise ValueError(f"similarities of {len(similarity)} frames were given for {n} frames")
    return similarity
