"""A tree over frames along which poses are chained: frame = parent o relative pose, from the root outwards.

A step of the optimizer on one relative pose moves everything that hangs on it, which is what a loop of a hundred frames
needs. Composing along the tree takes log2(depth) batched products (pointer jumping), not one per frame.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np
import torch
from jaxtyping import Float, Int64
from scipy.cluster.hierarchy import linkage
from scipy.sparse import coo_array, csr_array
from scipy.sparse.csgraph import breadth_first_order, minimum_spanning_tree
from scipy.spatial.distance import squareform
from torch import Tensor

_FULL_PAIR = 3  # matches per block that make a pair count as perfect


@dataclass(frozen=True)
class KinematicTree:
    """Each frame's parent; the root is its own."""

    root: int
    parent: Int64[Tensor, " n"]
    order: tuple[int, ...]  # breadth first from the root


def kinematic_tree(
    matches: Float[np.ndarray, "n n"], blocks: Sequence[int], method: Literal["ward", "spanning"] = "ward"
) -> KinematicTree:
    """The tree of frames with so many matches between them (symmetric) and so many blocks each.

    Raises ValueError where "spanning" finds the frames not connected.
    """
    n = len(matches)
    if n == 1:
        return KinematicTree(0, torch.zeros(1, dtype=torch.int64), (0,))
    edges = _ward_edges(matches, np.asarray(blocks)) if method == "ward" else _spanning_edges(matches)
    return rooted_tree(edges, n)


def rooted_tree(edges: Sequence[tuple[int, int]], n: int) -> KinematicTree:
    """The tree of n frames with these edges, rooted near its middle; neither order nor direction of edges matters."""
    # breadth-first search visits a frame's neighbors as they are stored: i < j, sorted, as the reference has them
    a, b = np.array(sorted((min(edge), max(edge)) for edge in edges)).T
    graph = coo_array((np.ones(len(a)), (a, b)), shape=(n, n)).tocsr()
    root = _middle(graph)
    order, predecessor = breadth_first_order(graph, root, directed=False)
    predecessor[root] = root
    return KinematicTree(root, torch.from_numpy(predecessor.astype(np.int64)), tuple(order.tolist()))


def compose(
    tree: KinematicTree, rotation: Float[Tensor, "n 3 3"], translation: Float[Tensor, "n 3"]
) -> tuple[Float[Tensor, "n 3 3"], Float[Tensor, "n 3"]]:
    """Poses in the world from poses relative to the parent; the root's is in the world already."""
    jump = tree.parent.to(rotation.device)
    frames = torch.arange(len(jump), device=rotation.device)
    R, t = rotation, translation
    done = frames == tree.root
    while not bool(done.all()):
        grow = ~done
        joined = torch.where(grow[:, None], (R[jump] @ t[..., None])[..., 0] + t[jump], t)
        R, t = torch.where(grow[:, None, None], R[jump] @ R, R), joined
        done, jump = done | done[jump], jump[jump]
    return R, t


def _ward_edges(matches: Float[np.ndarray, "n n"], blocks: np.ndarray) -> list[tuple[int, int]]:
    closeness = np.minimum(1, matches / (_FULL_PAIR * np.minimum(blocks[:, None], blocks[None, :])))
    np.fill_diagonal(closeness, 1)
    distance = np.where(closeness > 0, 1 - closeness, 2.0)
    np.fill_diagonal(distance, 0)
    closeness = closeness.copy()
    representative = list(range(len(matches)))
    edges = []
    for left, right, *_ in linkage(squareform(distance, checks=False), method="ward"):
        a, b = representative[int(left)], representative[int(right)]
        edges.append((a, b))
        chosen = a if closeness[a].sum() > closeness[b].sum() else b
        closeness[chosen] = np.maximum(closeness[a], closeness[b])
        representative.append(chosen)
    return edges


def _spanning_edges(matches: Float[np.ndarray, "n n"]) -> list[tuple[int, int]]:
    tree = minimum_spanning_tree(csr_array(-np.triu(matches, 1))).tocoo()
    if tree.nnz != len(matches) - 1:
        raise ValueError("the frames do not hang together through matches")
    return list(zip(tree.coords[0].tolist(), tree.coords[1].tolist(), strict=True))


def _middle(graph: csr_array) -> int:
    """A frame far from both ends of the longest path; the order of visits stands for distance, as in the reference."""

    def visit(start: int) -> tuple[int, np.ndarray]:
        order = breadth_first_order(graph, start, directed=False, return_predecessors=False)
        rank = np.empty(len(order), dtype=np.int64)
        rank[order] = np.arange(len(order))
        return int(order[-1]), rank

    end, _ = visit(0)
    other, rank_a = visit(end)
    _, rank_b = visit(other)
    return int(np.argmax(np.minimum(rank_a, rank_b)))
