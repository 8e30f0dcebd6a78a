"""The two-view losses against their printed formulas, worked out by hand, and what must not matter to them."""

import math

import pytest
import torch
from torch import Tensor

from swimm3r.sfm.distillation.two_view_losses import (
    TrueMatches,
    TruePoints,
    matching_errors,
    matching_loss,
    pointmap_loss,
    regression_errors,
    two_view_loss,
)
from swimm3r.sfm.mast3r.network import Descriptors, Pointmap


@pytest.fixture
def views() -> tuple[TruePoints, TruePoints]:
    """Two views of 2 x 3 pixels, one pixel of each unknown."""
    generator = torch.Generator().manual_seed(0)
    points = torch.rand(2, 1, 2, 3, 3, generator=generator) + 1
    valid = torch.ones(2, 1, 2, 3, dtype=torch.bool)
    valid[0, 0, 0, 0] = valid[1, 0, 1, 2] = False
    return TruePoints(points[0], valid[0]), TruePoints(points[1], valid[1])


def predicted(points: tuple[Tensor, Tensor], confidence: float) -> tuple[Pointmap, Pointmap]:
    one, two = (Pointmap(p, torch.full(p.shape[:3], confidence)) for p in points)
    return one, two


METRES, ANY_UNIT = torch.tensor([True]), torch.tensor([False])


def test_points_are_compared_in_units_of_their_mean_distance(views: tuple[TruePoints, TruePoints]):
    known = torch.cat([v.points[v.valid] for v in views])
    s = known.norm(dim=-1).mean()
    shift = torch.tensor([0.3, 0.0, 0.4])
    moved = views[0].points + shift, views[1].points + shift
    for error, view in zip(regression_errors(moved, views, METRES), views, strict=True):
        torch.testing.assert_close(error[view.valid], torch.full((5,), 0.5) / s)


def test_scale_counts_only_where_lengths_are_metres(views: tuple[TruePoints, TruePoints]):
    twice = (2 * views[0].points, 2 * views[1].points)
    own, metres = (regression_errors(twice, views, metric) for metric in (ANY_UNIT, METRES))
    for k, view in enumerate(views):
        assert own[k][view.valid].max() < 1e-6
        assert metres[k][view.valid].min() > 0.5


def test_exact_points_cost_minus_the_logarithm_of_the_confidence(views: tuple[TruePoints, TruePoints]):
    exact = predicted((views[0].points, views[1].points), 3.0)
    torch.testing.assert_close(pointmap_loss(exact, views, METRES), torch.tensor(-2 * 0.2 * math.log(3.0)))


def test_unknown_pixels_say_nothing(views: tuple[TruePoints, TruePoints]):
    points = [v.points.clone() for v in views]
    points[0][0, 0, 0] = 1e6
    exact = predicted((points[0], points[1]), 1.0)
    torch.testing.assert_close(pointmap_loss(exact, views, METRES), torch.tensor(0.0))


def test_confidence_in_the_sky_is_punished(views: tuple[TruePoints, TruePoints]):
    sky = TruePoints(views[0].points, views[0].valid, ~views[0].valid)
    low, high = (
        pointmap_loss(predicted((sky.points, views[1].points), c), (sky, views[1]), METRES) for c in (1.0, 3.0)
    )
    torch.testing.assert_close(low, torch.tensor(2.0 / 6))  # one pixel of six is sky, its error counts as 2
    torch.testing.assert_close(high, torch.tensor(3 * 2.0 / 6 - 2 * 0.2 * math.log(3.0)))


def test_matching_error_of_two_rows_by_hand():
    first = torch.tensor([[[1.0, 0.0], [0.0, 1.0]]])
    second = torch.tensor([[[1.0, 0.0], [1.0, 0.0]]])  # the second of them is wrong
    found = matching_errors(first, second, least_share=0.0)
    right = math.log(2) + math.log1p(math.exp(-20.0))  # both of the other view look alike, T = 0.05
    wrong = math.log(2) + 20 + math.log1p(math.exp(-20.0))
    torch.testing.assert_close(found, torch.tensor([[right, wrong]]))
    torch.testing.assert_close(matching_errors(first, second)[0, 0], torch.tensor(right))


def test_a_match_rarer_than_the_least_share_costs_no_more_and_teaches_nothing():
    first = torch.tensor([[[1.0, 0.0], [0.0, 1.0]]], requires_grad=True)
    second = torch.tensor([[[-1.0, 0.0], [1.0, 0.0]]])  # both rows of the first view belong to the wrong one
    bound = 2 * -math.log(1e-8)
    found = matching_errors(first, second)
    torch.testing.assert_close(found[0, 0], torch.tensor(bound))
    found[0, 0].backward()
    assert first.grad is not None
    assert (first.grad == 0).all()
    assert matching_errors(first, second, least_share=0.0)[0, 0] > bound


def test_only_true_matches_are_rows_but_all_are_wrong_answers():
    generator = torch.Generator().manual_seed(0)
    maps = [torch.nn.functional.normalize(torch.randn(1, 2, 3, 4, generator=generator), dim=-1) for _ in range(2)]
    two = torch.full((1, 2, 3), 2.0)
    views = Descriptors(maps[0], two), Descriptors(maps[1], two)
    index = torch.arange(6)[None]
    valid = torch.tensor([[True, True, False, False, False, False]])
    errors = matching_errors(maps[0].flatten(1, 2), maps[1].flatten(1, 2))[0, :2]
    expected = (2 * errors - 10 * math.log(2.0)).mean()
    torch.testing.assert_close(matching_loss(views, TrueMatches(index, index, valid)), expected)
    nothing = matching_loss(views, TrueMatches(index, index, torch.zeros_like(valid)))
    torch.testing.assert_close(nothing, torch.tensor(0.0))


def test_the_whole_loss_weighs_matching_by_0_075(views: tuple[TruePoints, TruePoints]):
    generator = torch.Generator().manual_seed(0)
    maps = [torch.nn.functional.normalize(torch.randn(1, 2, 3, 4, generator=generator), dim=-1) for _ in range(2)]
    two = torch.full((1, 2, 3), 2.0)
    described = Descriptors(maps[0], two), Descriptors(maps[1], two)
    index = torch.arange(6)[None]
    matches = TrueMatches(index, index, torch.ones(1, 6, dtype=torch.bool))
    points = predicted((views[1].points, views[0].points), 1.5)
    total = two_view_loss(points, described, views, matches, METRES)
    parts = pointmap_loss(points, views, METRES) + 0.075 * matching_loss(described, matches)
    torch.testing.assert_close(total, parts)
