"""Opacities that a network adjusts early in training."""

import pytest
import torch
from torch.autograd import gradcheck
from torch.nn.functional import normalize

from swimm3r.splat.gaussian_settings import AlphaAdjustmentSettings
from swimm3r.splat.training.alpha_adjustment import AlphaNetwork, adjusted_opacity, adjustment_weight


def given(n: int = 6) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor]:
    rng = torch.Generator().manual_seed(0)
    direction = normalize(torch.randn(n, 3, generator=rng).double(), dim=-1)
    return torch.randn(n, generator=rng).double(), 1 + torch.rand(n, generator=rng).double(), direction


def network(last: float) -> AlphaNetwork:
    torch.manual_seed(0)
    made = AlphaNetwork(8).double()
    with torch.no_grad():
        made.last.weight.mul_(last)
    return made


def test_a_network_that_has_not_learned_changes_nothing():
    opacity, z, direction = given()
    for w in (0.0, 0.3, 1.0):
        torch.testing.assert_close(adjusted_opacity(network(0.0), opacity, z, direction, w), opacity)


def test_at_its_end_the_adjustment_is_the_identity_whatever_was_learned():
    opacity, z, direction = given()
    learned = network(30.0)
    assert (adjusted_opacity(learned, opacity, z, direction, 1.0) - opacity).abs().max() > 0.5
    off = [(adjusted_opacity(learned, opacity, z, direction, w) - opacity).abs().max() for w in (1.0, 0.1, 0.01, 0.0)]
    assert off[0] > off[1] > off[2] > off[3]
    assert off[3] < 1e-9


def test_the_adjusted_opacity_is_the_published_mixture():
    opacity, z, direction = given()
    learned, w = network(5.0), 0.4
    mixed = (1 - w) * torch.sigmoid(opacity) + w * learned(opacity, z, direction)
    torch.testing.assert_close(torch.sigmoid(adjusted_opacity(learned, opacity, z, direction, w)), mixed)


def test_the_weight_is_1_first_then_falls_to_0():
    settings = AlphaAdjustmentSettings(end=0.2, fade=0.2)
    weights = [adjustment_weight(settings, share) for share in (0.0, 0.2, 0.3, 0.4, 1.0)]
    assert weights == pytest.approx([1, 1, 0.5, 0, 0])
    assert adjustment_weight(AlphaAdjustmentSettings(end=0.2, fade=0.0), 0.21) == 0


def test_it_has_the_gradients_of_opacity_and_network():
    opacity, z, direction = given()
    learned = network(3.0)
    opacity.requires_grad_()

    def run(opacity, hidden, last):
        features = {"hidden.weight": hidden, "last.weight": last}
        phi = torch.func.functional_call(learned, features, (opacity, z, direction))
        return 0.4 * torch.sigmoid(opacity) + 0.6 * phi

    assert gradcheck(run, (opacity, learned.hidden.weight, learned.last.weight))
    torch.testing.assert_close(
        torch.autograd.grad(torch.sigmoid(adjusted_opacity(learned, opacity, z, direction, 0.6)).sum(), opacity),
        torch.autograd.grad(run(opacity, learned.hidden.weight, learned.last.weight).sum(), opacity),
    )
