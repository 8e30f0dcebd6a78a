"""The tree that poses are chained along."""

import numpy as np
import pytest
import torch

from swimm3r.geometry import so3_exp
from swimm3r.sfm.alignment.kinematic_tree import compose, kinematic_tree, rooted_tree


def chain(n: int) -> np.ndarray:
    matches = np.zeros((n, n))
    for i in range(n - 1):
        matches[i, i + 1] = matches[i + 1, i] = 100 + i
    return matches


@pytest.mark.parametrize("method", ["ward", "spanning"])
@pytest.mark.parametrize("n", [1, 2, 9, 40])
def test_tree_reaches_every_frame_from_its_root(method, n: int):
    tree = kinematic_tree(chain(n), [96] * n, method)
    assert sorted(tree.order) == list(range(n))
    assert tree.order[0] == tree.root == int(tree.parent[tree.root])
    for f in range(n):
        steps = 0
        while f != tree.root:
            f, steps = int(tree.parent[f]), steps + 1
            assert steps < n


def test_root_of_a_chain_is_its_middle():
    assert kinematic_tree(chain(9), [96] * 9, "spanning").root == 4


def test_tree_prefers_the_pairs_with_most_matches():
    matches = chain(5)
    matches[0, 4] = matches[4, 0] = 1
    tree = kinematic_tree(matches, [96] * 5, "spanning")
    edges = {tuple(sorted((f, int(tree.parent[f])))) for f in range(5) if f != tree.root}
    assert edges == {(0, 1), (1, 2), (2, 3), (3, 4)}


def test_ward_tree_spans_even_frames_without_matches():
    matches = chain(4)
    matches[2:, :2] = matches[:2, 2:] = 0
    assert len(kinematic_tree(matches, [96] * 4, "ward").order) == 4
    with pytest.raises(ValueError, match="do not hang together"):
        kinematic_tree(matches, [96] * 4, "spanning")


@pytest.mark.parametrize("method", ["ward", "spanning"])
def test_composed_pose_is_the_parents_times_its_own(method):
    n = 37
    generator = torch.Generator().manual_seed(0)
    R = so3_exp(torch.randn(n, 3, generator=generator, dtype=torch.float64))
    t = torch.randn(n, 3, generator=generator, dtype=torch.float64)
    tree = kinematic_tree(chain(n), [96] * n, method)
    world_R, world_t = compose(tree, R, t)
    torch.testing.assert_close(world_R[tree.root], R[tree.root])
    for f in tree.order[1:]:
        p = int(tree.parent[f])
        torch.testing.assert_close(world_R[f], world_R[p] @ R[f])
        torch.testing.assert_close(world_t[f], world_R[p] @ t[f] + world_t[p])


def test_root_depends_neither_on_the_order_nor_on_the_direction_of_edges():
    edges = [(3, 0), (1, 4), (4, 0), (2, 1), (5, 2), (6, 2), (3, 7)]
    first = rooted_tree(edges, 8)
    generator = np.random.default_rng(0)
    for _ in range(20):
        mixed = [edges[k] if generator.random() < 0.5 else edges[k][::-1] for k in generator.permutation(len(edges))]
        tree = rooted_tree(mixed, 8)
        assert (tree.root, tree.order) == (first.root, first.order)
        assert tree.parent.tolist() == first.parent.tolist()
