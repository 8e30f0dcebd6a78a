"""Pair graphs: the reference's lists, and what a graph must be whatever the method."""

import json
from pathlib import Path

import pytest
import torch

from swimm3r.errors import UsageError
from swimm3r.sfm.features import pair_graph
from swimm3r.sfm.mast3r.settings import Complete, LogWindow, OneReference, Retrieval, SlidingWindow, VideoPairs

GRAPHS = [Complete(), SlidingWindow(3), SlidingWindow(20, cyclic=True), LogWindow(3), OneReference(2), Retrieval(4, 3)]


@pytest.fixture(scope="module")
def vectors(shared: Path) -> dict:
    return json.loads((shared / "vectors" / "mast3r" / "pairs.json").read_text())


def alike(n: int) -> torch.Tensor:
    points = torch.rand(n, 3, generator=torch.Generator().manual_seed(n), dtype=torch.float64)
    return torch.exp(-torch.cdist(points, points))


@pytest.mark.shared
def test_graphs_reproduce_the_reference(vectors: dict):
    assert len(vectors["scene_graphs"]) == 216
    for case in vectors["scene_graphs"]:
        name = case["scene_graph"]
        if name.startswith(("swin", "logwin")) and "noncyclic" not in name:
            name += "-cyclic"
        n, prefilter = case["n"], case["prefilter"]
        got = pair_graph.reference_pairs(n, pair_graph.parse_graph(name))
        if case["symmetrize"]:
            got = pair_graph.both_directions(got)
        if prefilter is not None:
            got = pair_graph.within(got, int(prefilter[3:]), n if prefilter.startswith("cyc") else None)
        expected = [tuple(p) for p in case["pairs"]]
        if name.startswith(("complete", "oneref")):
            assert got == expected, case
        assert sorted(got) == sorted(expected), case


@pytest.mark.shared
def test_retrieval_graphs_reproduce_the_reference(vectors: dict):
    similarity = torch.tensor(vectors["sim"], dtype=torch.float64)
    for case in vectors["retrieval"]:
        graph = Retrieval(case["Na"], case["k"], seed=case["numpy_seed"])
        keys = pair_graph.farthest_frames(1 - similarity.numpy(), case["Na"], case["numpy_seed"])
        assert keys == case["keyimgs"]
        assert sorted(pair_graph.retrieval_pairs(similarity, graph)) == sorted(tuple(p) for p in case["pairs"])
    fps = vectors["fps"]
    assert pair_graph.farthest_frames(1 - similarity.numpy(), fps["N"], fps["numpy_seed"]) == fps["indices"]


@pytest.mark.parametrize("graph", [*GRAPHS, VideoPairs(2, 1, 3)], ids=lambda g: type(g).__name__)
@pytest.mark.parametrize("n", [3, 9])
def test_pairs_come_once_ordered_and_never_join_a_frame_to_itself(graph, n: int):
    found = pair_graph.make_pairs(n, graph, alike(n))
    assert found == sorted(set(found))
    assert all(0 <= i < j < n for i, j in found)
    assert len(pair_graph.groups(n, found)) == 1


def test_video_graph_is_the_window_and_the_loops():
    n = 40
    similarity = torch.full((n, n), 0.1, dtype=torch.float64)
    similarity[35, 3], similarity[35, 4], similarity[35, 12], similarity[35, 34] = 0.9, 0.8, 0.7, 0.95
    found = pair_graph.make_pairs(n, VideoPairs(window=2, closures=2, gap=10), similarity)
    assert {(i, j) for i, j in found if j - i <= 2} == {(i, i + d) for i in range(n) for d in (1, 2) if i + d < n}
    assert (3, 35) in found
    assert (12, 35) in found  # frame 4 would only say again what frame 3 says
    assert (4, 35) not in found
    assert all(j - i <= 2 or j - i >= 10 for i, j in found)


def test_video_graph_without_closures_needs_no_similarities():
    assert pair_graph.make_pairs(3, VideoPairs(window=1, closures=0)) == [(0, 1), (1, 2)]
    with pytest.raises(UsageError, match="which frames look alike"):
        pair_graph.make_pairs(3, VideoPairs())
    with pytest.raises(UsageError, match="which frames look alike"):
        pair_graph.make_pairs(3, Retrieval())


def test_frames_that_no_pair_joins_are_told_apart():
    assert pair_graph.groups(6, [(0, 3), (4, 5), (3, 2)]) == [[0, 2, 3], [4, 5], [1]]
    assert pair_graph.groups(2, []) == [[0], [1]]


@pytest.mark.parametrize(
    ("text", "graph"),
    [
        ("complete", Complete()),
        ("swin", SlidingWindow()),
        ("swin-5-cyclic", SlidingWindow(5, cyclic=True)),
        ("logwin-2-noncyclic", LogWindow(2)),
        ("oneref-7", OneReference(7)),
        ("retrieval-12-4", Retrieval(12, 4)),
        ("video", VideoPairs()),
        ("video-5-1", VideoPairs(5, 1)),
    ],
)
def test_graph_has_a_short_name(text: str, graph):
    assert pair_graph.parse_graph(text) == graph


@pytest.mark.parametrize("text", ["", "swim-3", "swin-x", "swin-3-4", "retrieval-20-1-10-1", "complete-3", "oneref--1"])
def test_graph_name_that_does_not_parse_is_refused(text: str):
    with pytest.raises(UsageError, match="no pair graph"):
        pair_graph.parse_graph(text)


def test_reference_frame_must_exist():
    with pytest.raises(UsageError, match="reference frame 5 is not one of the 3"):
        pair_graph.make_pairs(3, OneReference(5))
