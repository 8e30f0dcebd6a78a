"""The plan's numbers against the ones the specification counts, and its bounds against the graphs themselves."""

import pytest
import torch

from swimm3r.sfm.features.pair_graph import make_pairs, parse_graph
from swimm3r.sfm.mast3r.network import Architecture
from swimm3r.sfm.mast3r_sfm.cost_estimate import Plan, most_pairs, multiplications


def test_multiplications_of_the_published_network():
    encode, pair = multiplications(Architecture(), 512 * 384)
    assert 2 * encode == pytest.approx(0.52e12, rel=0.02)
    assert 2 * pair == pytest.approx(1.97e12, rel=0.02)


@pytest.mark.parametrize(
    "text", ["complete", "swin-3", "swin-3-cyclic", "logwin-3", "oneref-1", "retrieval-4-3", "video", "video-2-1"]
)
@pytest.mark.parametrize("n", [2, 5, 30])
def test_no_graph_has_more_pairs_than_planned(text: str, n: int):
    graph = parse_graph(text)
    similarity = torch.rand(n, n, generator=torch.Generator().manual_seed(n))
    found = len(make_pairs(n, graph, similarity))
    assert found <= most_pairs(n, graph) <= max(2 * found + 4, n * (n - 1) // 2)


def test_the_plan_reads_like_a_sentence():
    text = str(Plan(frames=120, pairs=720, minutes=338.4, memory_mb=6021.3, disk_mb=801.0))
    assert text.startswith("Plan: 120 frames, up to 720 pairs, about 338 min, 6,021 MB of memory")
