"""Parts of a clip brought into common axes: a spanning tree of their links first, then all links at once.

The sum over links (a, b) of rho(|S_a x_a - S_b x_b| f / (s_b z_b)), pixels over the points they share, is minimized
over the similarities S of all parts; rho is the soft L1 norm. Links closed around a loop, where the survey came back,
spread their gap over the loop; one that still misses by far afterwards joined things that only look alike, and goes.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float
from scipy.optimize import least_squares
from scipy.sparse import coo_array
from scipy.sparse.csgraph import breadth_first_order, connected_components, minimum_spanning_tree
from scipy.spatial.transform import Rotation

from swimm3r.sfm.colmap.chunks.links import Link
from swimm3r.sim3 import IDENTITY, Sim3

_BEND = 4.0  # pixels at which a residual begins to count less
_FALSE = 40.0  # median pixels by which a link may miss under the best similarities


@dataclass(frozen=True)
class Joined:
    """Parts in common axes."""

    from_part: dict[int, Sim3]  # by part
    residuals: tuple[float, ...]  # median pixels of each link that was used


def join_parts(count: int, links: Sequence[Link], focal: float) -> list[Joined]:
    """Groups of parts that hang together, each in the axes of one of its parts; single parts are groups, too."""
    used = list(links)
    while True:
        groups = [_solve(members, used, focal) for members in _groups(count, used)]
        place = {part: group.from_part[part] for group in groups for part in group.from_part}
        wrong = [k for k, each in enumerate(used) if np.median(_missed(each, place, focal)) > _FALSE]
        if not wrong:
            return groups
        worst = max(wrong, key=lambda k: float(np.median(_missed(used[k], place, focal))))
        used.pop(worst)


def _groups(count: int, links: Sequence[Link]) -> list[list[int]]:
    ends = np.array([(each.a, each.b) for each in links], np.int64).reshape(-1, 2)
    graph = coo_array((np.ones(len(ends)), ends.T), shape=(count, count))
    number, label = connected_components(graph, directed=False)
    return [np.flatnonzero(label == k).tolist() for k in range(number)]


def _solve(members: Sequence[int], links: Sequence[Link], focal: float) -> Joined:
    """Similarities of connected parts, the first part's axes held."""
    inside = [each for each in links if each.a in members]
    place = _along_tree(members, inside)
    if len(members) == 1:
        return Joined(place, ())
    rows = {part: k for k, part in enumerate(members[1:])}
    start = [place[part] for part in members[1:]]

    def moved(x: Float[np.ndarray, " p"]) -> dict[int, Sim3]:
        out = {members[0]: place[members[0]]}
        for part, k in rows.items():
            scale, turn, shift = x[7 * k], x[7 * k + 1 : 7 * k + 4], x[7 * k + 4 : 7 * k + 7]
            first = start[k]
            R = Rotation.from_rotvec(turn).as_matrix()
            out[part] = Sim3(first.scale * float(np.exp(scale)), R @ first.R, first.t + first.scale * shift)
        return out

    def residuals(x: Float[np.ndarray, " p"]) -> Float[np.ndarray, " r"]:
        now = moved(x)
        return np.concatenate([_residual(each, now, focal).ravel() for each in inside])

    found = least_squares(
        residuals,
        np.zeros(7 * len(rows)),
        jac_sparsity=_sparsity(inside, rows),
        method="trf",
        loss="soft_l1",
        f_scale=_BEND,
        x_scale="jac",
        max_nfev=60,
    )
    place = moved(found.x)
    return Joined(place, tuple(float(np.median(_missed(each, place, focal))) for each in inside))


def _along_tree(members: Sequence[int], links: Sequence[Link]) -> dict[int, Sim3]:
    """Similarities along the spanning tree of the best supported links."""
    row = {part: k for k, part in enumerate(members)}
    ends = np.array([(row[each.a], row[each.b]) for each in links], np.int64).reshape(-1, 2)
    cost = np.array([1 / each.support for each in links])
    graph = coo_array((cost, ends.T), shape=(len(members), len(members)))
    tree = minimum_spanning_tree(graph.tocsr())
    order, parent = breadth_first_order(tree, 0, directed=False)
    by_ends = {(each.a, each.b): each for each in links}
    place = {members[0]: IDENTITY}
    for k in order[1:].tolist():
        child, above = members[k], members[int(parent[k])]
        each = by_ends[min(child, above), max(child, above)]
        place[child] = place[above].after(each.inverse_to(above))
    return place


def _residual(each: Link, place: dict[int, Sim3], focal: float) -> Float[np.ndarray, "n 3"]:
    """Distances between a link's points in common axes, in pixels of the frames that observe them."""
    a, b = place[each.a], place[each.b]
    return (a(each.xyz_a) - b(each.xyz_b)) * (focal / (b.scale * each.depth_b))[:, None]


def _missed(each: Link, place: dict[int, Sim3], focal: float) -> Float[np.ndarray, " n"]:
    return np.linalg.norm(_residual(each, place, focal), axis=1)


def _sparsity(links: Sequence[Link], rows: dict[int, int]) -> coo_array:
    """The parameters that each residual depends on."""
    at, columns, first = [], [], 0
    for each in links:
        count = 3 * len(each.xyz_a)
        for part in (each.a, each.b):
            if part in rows:
                at.append(np.repeat(np.arange(first, first + count), 7))
                columns.append(np.tile(np.arange(7 * rows[part], 7 * rows[part] + 7), count))
        first += count
    shape = (first, 7 * len(rows))
    row, column = np.concatenate(at), np.concatenate(columns)
    return coo_array((np.ones(len(row)), (row, column)), shape=shape)
