"""Scores over the part of a view that training frames measured or saw."""

import pytest
import torch

from swimm3r.evaluate import NotComputed
from swimm3r.pipeline.scores.part_scores import covered_scores, mean_part, observed_scores


def test_the_covered_score_looks_at_covered_pixels_alone():
    render, target = torch.full((20, 20, 3), 0.5), torch.full((20, 20, 3), 0.5)
    target[:, :10] = 0.6
    target[:, 10:] = 0.9
    left = torch.zeros(20, 20, dtype=torch.bool)
    left[:, :10] = True
    seen = torch.ones(20, 20, dtype=torch.bool)
    scores = covered_scores(render, target, seen, left)
    assert scores.share == 0.5
    assert scores.psnr == pytest.approx(20.17, abs=0.01)  # 25 of 255
    assert isinstance(covered_scores(render, target, seen, ~seen).psnr, NotComputed)


def test_the_observed_score_looks_at_observed_pixels_alone():
    render, target = torch.full((20, 20, 3), 0.5), torch.full((20, 20, 3), 0.6)
    target[:, 5:] = 0.9
    seen, left = torch.ones(20, 20, dtype=torch.bool), torch.zeros(20, 20, dtype=torch.bool)
    left[:, :5] = True
    scores = observed_scores(render, target, seen, left)
    assert scores.share == 0.25
    assert scores.psnr == pytest.approx(20.17, abs=0.01)
    assert scores.sharpness == 0  # the render is flat; half of the edge in the frame is on a pixel that counts
    nothing = observed_scores(render, target, seen, ~seen)
    assert nothing.share == 0
    assert isinstance(nothing.psnr, NotComputed)
    assert isinstance(observed_scores(render, target, seen, None).share, NotComputed)
    mean = mean_part([scores, nothing])
    assert mean.share == 0.125
    assert mean.psnr == scores.psnr
    with pytest.raises(ValueError, match="no frames"):
        mean_part([])
