"""Depth scores: hand-made numbers, what alignment forgives and what it does not."""

import math
import weakref

import pytest
import torch

from swimm3r.evaluate import NotComputed
from swimm3r.evaluate.depth import DepthAlignment, depth_scores


def some_depths(n: int = 3) -> list[torch.Tensor]:
    g = torch.Generator().manual_seed(0)
    return [1 + 4 * torch.rand(12, 17, generator=g, dtype=torch.float64) for _ in range(n)]


def test_two_pixels_by_hand():
    scores = depth_scores([(torch.tensor([[1.1, 3.0]]), torch.tensor([[1.0, 2.0]]))], "none")
    assert scores.absrel == pytest.approx((0.1 + 0.5) / 2, rel=1e-6)
    assert scores.delta_125 == 50
    assert scores.rmse_log == pytest.approx(math.sqrt((math.log(1.1) ** 2 + math.log(1.5) ** 2) / 2), rel=1e-6)
    assert scores.variant == "none"


def test_scores_keep_double_precision():
    true, predicted = torch.tensor([[3.0]], dtype=torch.float64), torch.tensor([[3.1]], dtype=torch.float64)
    assert depth_scores([(predicted, true)], "none").absrel == pytest.approx(0.1 / 3.0, rel=1e-14)


def test_median_alignment_forgives_one_scale_per_frame():
    true = some_depths()
    scaled = [s * z for s, z in zip((0.2, 3.0, 11.0), true, strict=True)]
    per_frame = depth_scores(zip(scaled, true, strict=True), "median")
    assert per_frame.absrel == pytest.approx(0, abs=1e-12)
    assert per_frame.delta_125 == 100
    absrel = depth_scores(zip(scaled, true, strict=True), "sequence_median").absrel
    assert isinstance(absrel, float)
    assert absrel > 0.3


def test_sequence_alignment_forgives_one_scale_for_all_frames():
    true = some_depths()
    assert depth_scores([(0.3 * z, z) for z in true], "sequence_median").rmse_log == pytest.approx(0, abs=1e-12)
    assert depth_scores([(0.3 * z, z) for z in true], "none").absrel == pytest.approx(0.7)


def test_median_of_an_even_number_of_pixels_is_the_middle():
    scores = depth_scores([(torch.tensor([[1.0, 2.0, 4.0, 8.0]]), torch.tensor([[1.0, 1.0, 1.0, 1.0]]))], "median")
    assert scores.absrel == pytest.approx((2 / 3 + 1 / 3 + 1 / 3 + 5 / 3) / 4)


def test_unknown_pixels_do_not_count_and_their_share_is_told():
    true = torch.tensor([[1.0, 2.0, 0.0, math.inf, 3.0]])
    predicted = torch.tensor([[1.0, math.nan, 5.0, 5.0, 0.0]])
    scores = depth_scores([(predicted, true)], "none")
    assert scores.absrel == 0
    assert scores.coverage == pytest.approx(1 / 3)


def test_far_pixels_can_be_left_out():
    true, predicted = torch.tensor([[1.0, 5.0]]), torch.tensor([[1.0, 50.0]])
    assert depth_scores([(predicted, true)], "none", max_depth=5.0).absrel == 0


def test_frames_count_alike_whatever_their_size():
    true = [torch.ones(1, 1), torch.ones(10, 10)]
    predicted = [torch.full((1, 1), 1.5), torch.ones(10, 10)]
    scores = depth_scores(zip(predicted, true, strict=True), "none")
    assert scores.absrel == pytest.approx(0.25)
    assert scores.delta_125 == pytest.approx(50)


def test_nothing_in_common_is_no_score():
    scores = depth_scores([(torch.zeros(2, 2), torch.ones(2, 2))])
    assert isinstance(scores.absrel, NotComputed)
    assert scores.frames == 0
    with pytest.raises(ValueError, match="pixels"):
        depth_scores([(torch.ones(2, 2), torch.ones(2, 3))])


@pytest.mark.parametrize("align", ["none", "median"])
def test_one_pair_of_maps_is_held_at_a_time(align: DepthAlignment):
    alive: list[weakref.ref[torch.Tensor]] = []

    def pairs():
        for z in some_depths(4):
            assert sum(each() is not None for each in alive) <= 1  # the one that was scored last
            predicted = 1.1 * z
            alive.append(weakref.ref(predicted))
            yield predicted, z
            del predicted

    assert depth_scores(pairs(), align).frames == 4
