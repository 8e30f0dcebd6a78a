"""The objective term by term, against numbers worked out by hand and against its limits."""

from collections.abc import Callable
from dataclasses import replace

import pytest
import torch

from swimm3r.medium import Medium, add_water
from swimm3r.sfm.mast3r.network import Mast3r
from swimm3r.sfm.mast3r.settings import ObjectiveSettings
from swimm3r.sfm.student.losses import (
    LossTerms,
    anchor_loss,
    dim_color,
    features,
    forward_loss,
    inverse_loss,
    known_water_loss,
    overshoot_loss,
    physics_terms,
    squared_distance,
)

PAPER = ObjectiveSettings()
ALL = torch.ones(1, 1, 2, dtype=torch.bool)


def image(*pixels: tuple[float, float, float]) -> torch.Tensor:
    return torch.tensor([[pixels]])


def scene(b: int = 2, seed: int = 0) -> tuple[torch.Tensor, torch.Tensor, Medium]:
    """Clear image, ray depth and a hazy water per frame."""
    generator = torch.Generator().manual_seed(seed)
    J, z = torch.rand(b, 6, 8, 3, generator=generator), 0.5 + 3 * torch.rand(b, 6, 8, generator=generator)
    draws = torch.rand(3, b, 1, 1, 3, generator=generator)
    return (
        J,
        z,
        Medium(*(v.expand(b, 6, 8, 3) for v in (0.3 + 0.3 * draws[0], 0.2 + 0.5 * draws[1], 0.2 + 0.5 * draws[2]))),
    )


def test_the_paper_weighs_encoder_and_decoder_by_a_half_descriptors_by_two_and_the_rest_by_one():
    ones = [torch.tensor([v]) for v in (1.0, 10.0, 100.0, 1e3, 1e4, 1e5, 1e6, 1e7, 1e8)]
    assert LossTerms(*ones).total(PAPER).item() == 0.5 + 5.0 + 200.0 + 1e3 + 1e4 + 1e5 + 0.5e6
    told = replace(PAPER, known_water=4.0)
    assert LossTerms(*ones).total(told).item() == pytest.approx(LossTerms(*ones).total(PAPER).item() + 4e7, rel=1e-6)


def test_squared_distances_by_hand():
    teacher = (torch.tensor([[[1.0, 2.0], [3.0, 4.0]]]),)
    student = (torch.tensor([[[1.0, 0.0], [0.0, 4.0]]]),)
    assert squared_distance(teacher, student, "sum").tolist() == [13.0]
    assert squared_distance(teacher, student, "token").tolist() == [6.5]
    assert squared_distance(teacher, student, "mean").tolist() == [3.25]
    both = squared_distance(teacher + teacher, student + teacher, "sum")
    assert both.tolist() == [6.5]  # the second view agrees


def test_nothing_flows_back_into_the_teacher():
    teacher, student = torch.ones(1, 2, 3, requires_grad=True), torch.zeros(1, 2, 3, requires_grad=True)
    squared_distance((teacher,), (student,), "mean").sum().backward()
    assert teacher.grad is None
    assert student.grad is not None


def test_an_unknown_reduction_is_refused():
    x = (torch.zeros(1, 1, 1),)
    with pytest.raises(ValueError, match="median"):
        squared_distance(x, x, "median")


def test_forward_loss_by_hand():
    J, I = image((0.8, 0.4, 0.2), (0.5, 0.5, 0.5)), image((0.5, 0.5, 0.5), (0.5, 0.5, 0.5))
    ln2 = torch.log(torch.tensor(2.0)).item()
    medium = Medium(torch.tensor([0.6, 0.6, 0.6]), torch.tensor([ln2, ln2, ln2]), torch.tensor([2 * ln2] * 3))
    # at z = 1: T_D = 1/2, T_B = 1/4, so I-> = J/2 + 0.45 = 0.85, 0.65, 0.55; at z = 0 it is J
    z = torch.tensor([[[1.0, 0.0]]])
    torch.testing.assert_close(forward_loss(I, J, z, ALL, medium), torch.tensor([(0.35 + 0.15 + 0.05 + 0) / 2]))


def test_inverse_loss_by_hand_keeps_what_overshoots():
    restored, J = image((1.5, -0.25, 0.5), (0.0, 0.0, 0.0)), image((1.0, 0.0, 0.5), (0.0, 0.0, 0.0))
    torch.testing.assert_close(inverse_loss(restored, J, ALL), torch.tensor([0.375]))


def test_overshoot_by_hand_and_none_inside_the_range():
    torch.testing.assert_close(
        overshoot_loss(image((1.5, -0.5, 0.5), (0.0, 1.0, 3.0)), ALL), torch.tensor([(0.25 + 0.25 + 4.0) / 2])
    )
    assert overshoot_loss(torch.rand(1, 1, 2, 3), ALL).item() == 0


def test_the_dim_color_is_each_channels_own_five_percent_quantile():
    ramp = torch.linspace(0, 1, 101)[torch.randperm(101, generator=torch.Generator().manual_seed(0))]
    I = torch.stack([ramp, 1 - ramp / 2, ramp.flip(0) * 0 + 0.3], -1)[None, None]
    torch.testing.assert_close(
        dim_color(I, torch.ones(1, 1, 101, dtype=torch.bool)), torch.tensor([[0.05, 0.525, 0.3]])
    )


def test_the_dim_color_looks_at_valid_pixels_only():
    I = image((0.0, 0.0, 0.0), (0.4, 0.5, 0.6))
    valid = torch.tensor([[[False, True]]])
    torch.testing.assert_close(dim_color(I, valid), torch.tensor([[0.4, 0.5, 0.6]]))


def test_anchor_by_hand():
    torch.testing.assert_close(
        anchor_loss(torch.tensor([[0.5, 0.5, 0.5]]), torch.tensor([[0.1, 0.5, 0.8]])), torch.tensor([0.25])
    )


def test_the_true_water_leaves_only_the_anchor():
    J, z, medium = scene()
    terms = physics_terms(add_water(J, z, medium), J, z, torch.ones_like(z, dtype=torch.bool), medium, PAPER)
    for name in ("forward", "inverse", "overshoot"):
        assert getattr(terms, name).max() < 1e-5, name
    assert (terms.anchor > 0).all()


def test_in_haze_the_anchor_pulls_the_true_veil_down_and_nothing_else_moves_it():
    """Reason for the setting `anchor`: Q_0.05 is below Binf where the dimmest pixels are near."""
    J, z, medium = scene()
    J = 0.02 + 0.96 * J  # strictly inside, so that no term sits on its kink
    I = add_water(J, z, medium)
    everywhere = torch.ones_like(z, dtype=torch.bool)
    Binf = medium.Binf.clone().requires_grad_()
    terms = physics_terms(I, J, z, everywhere, replace(medium, Binf=Binf), PAPER)
    (saturation,) = torch.autograd.grad((terms.overshoot + 0.5 * terms.anchor).sum(), Binf)
    assert (dim_color(I, everywhere) < medium.Binf[:, 0, 0]).all()
    assert (saturation[:, 0, 0] > 0).all()  # descending lowers Binf
    assert (saturation[:, 1:] == 0).all()


def test_clear_water_makes_forward_and_inverse_the_plain_difference():
    J, z, _ = scene()
    I = (J + 0.1).clamp(max=1)
    none = Medium(*(torch.zeros_like(J) for _ in range(3)))
    terms = physics_terms(I, J, z, torch.ones_like(z, dtype=torch.bool), none, PAPER)
    plain = (I - J).abs().sum(-1).flatten(1).mean(1)
    torch.testing.assert_close(terms.forward, plain)
    torch.testing.assert_close(terms.inverse, plain)


def test_far_away_the_inverse_divides_by_the_floor_and_stays_finite():
    J, z, medium = scene()
    far = torch.full_like(z, 1e4)
    I = (medium.Binf + 0.01).requires_grad_()
    terms = physics_terms(I, J, far, torch.ones_like(z, dtype=torch.bool), medium, PAPER)
    torch.testing.assert_close(terms.inverse, (0.01 / 0.05 - J).abs().sum(-1).flatten(1).mean(1), atol=1e-5, rtol=0)
    (gradient,) = torch.autograd.grad(terms.inverse.sum(), I)
    assert torch.isfinite(gradient).all()


def test_beyond_the_floor_under_t_d_the_inverse_loss_pulls_the_true_veil_down_and_leaves_beta_d_alone():
    """A bias of Eq. 6 itself: where T_D < eps_inv the true water restores too dark an image."""
    J, z, medium = scene()
    far = z + 30
    I = add_water(J, far, medium)
    everywhere = torch.ones_like(z, dtype=torch.bool)
    assert torch.exp(-medium.beta_D * far[..., None]).max() < PAPER.min_transmittance
    unknown = replace(medium, Binf=medium.Binf.clone().requires_grad_(), beta_D=medium.beta_D.clone().requires_grad_())
    terms = physics_terms(I, J, far, everywhere, unknown, PAPER)
    assert terms.forward.max() < 1e-6  # it is the true water
    assert (terms.inverse > 0.1).all()
    Binf, beta_D = torch.autograd.grad(terms.inverse.sum(), [unknown.Binf, unknown.beta_D])
    assert (Binf.mean((1, 2)) > 0).all()  # descending lowers the veil
    assert (beta_D == 0).all()


def test_what_is_not_valid_is_never_read():
    J, z, medium = scene()
    I = add_water(J, z, medium)
    valid = torch.rand(z.shape, generator=torch.Generator().manual_seed(5)) > 0.3
    wrong_beta = (1.3 * medium.beta_D).requires_grad_()
    wrong = replace(medium, beta_D=wrong_beta)

    def loss(I, J, z):
        terms = physics_terms(I, J, z, valid, wrong, PAPER)
        return (terms.forward + terms.inverse + terms.overshoot + terms.anchor).sum()

    clean = loss(I, J, z)
    (expected,) = torch.autograd.grad(clean, wrong_beta)
    spoiled = [torch.where(valid if t.ndim == 3 else valid[..., None], t, torch.nan) for t in (I, J, z)]
    dirty = loss(*spoiled)
    (gradient,) = torch.autograd.grad(dirty, wrong_beta)
    torch.testing.assert_close(dirty, clean)
    torch.testing.assert_close(gradient, expected)
    assert (gradient[~valid] == 0).all()


def test_a_frame_without_any_valid_pixel_contributes_nothing():
    J, z, medium = scene()
    valid = torch.ones_like(z, dtype=torch.bool)
    valid[1] = False
    terms = physics_terms(J, J, z, valid, medium, PAPER)
    assert all(getattr(terms, name)[1] == 0 for name in ("forward", "inverse", "overshoot", "anchor"))
    assert terms.forward[0] > 0


def test_a_batch_is_the_mean_of_its_frames():
    J, z, medium = scene()
    I = (add_water(J, z, medium) + 0.05).clamp(0, 1)
    valid = torch.rand(z.shape, generator=torch.Generator().manual_seed(5)) > 0.5
    together = physics_terms(I, J, z, valid, medium, PAPER)
    for k in range(2):
        own = Medium(*(v[k : k + 1] for v in (medium.Binf, medium.beta_D, medium.beta_B)))
        one = slice(k, k + 1)
        alone = physics_terms(I[one], J[one], z[one], valid[one], own, PAPER)
        for name in ("forward", "inverse", "overshoot", "anchor"):
            torch.testing.assert_close(getattr(alone, name)[0], getattr(together, name)[k])


def test_known_water_by_hand():
    ln2 = torch.log(torch.tensor(2.0)).item()
    drawn = torch.tensor([[[0.4, 0.4, 0.4], [ln2, ln2, 2 * ln2], [ln2, ln2, ln2]]])
    found = Medium(torch.tensor([0.4, 0.8, 0.4]), torch.tensor([ln2, ln2, ln2]), torch.tensor([ln2, ln2, ln2]))
    # at z = 1 blue's T_D is 1/2 instead of 1/4, green's B 0.4 instead of 0.2; at z = 0 any water is right
    z = torch.tensor([[[1.0, 0.0]]])
    torch.testing.assert_close(known_water_loss(z, ALL, found, drawn), torch.tensor([(0.25 + 0.2) / 2]))


def test_only_frames_whose_water_was_drawn_are_compared_with_it():
    _, z, medium = scene()
    drawn = torch.stack([medium.Binf[:, 0, 0], medium.beta_D[:, 0, 0], medium.beta_B[:, 0, 0]], dim=1)
    z[:, 0, 0] = torch.nan
    assert (known_water_loss(z, ~z.isnan(), medium, drawn) < 1e-6).all()
    drawn[1] = torch.nan
    far_off = replace(medium, beta_D=(medium.beta_D + 1).requires_grad_())
    found = known_water_loss(z, ~z.isnan(), far_off, drawn)
    found.sum().backward()
    assert found[0] > 0.1
    assert found[1] == 0
    assert far_off.beta_D.grad is not None
    assert far_off.beta_D.grad[0].abs().sum() > 0
    assert (far_off.beta_D.grad[1] == 0).all()
    assert far_off.beta_D.grad.isfinite().all()


@pytest.fixture(scope="module")
def network(make_small_network: Callable[[], Mast3r]) -> Mast3r:
    return make_small_network()


def test_features_are_the_levels_the_objective_names(network: Mast3r):
    a, b = (network.encode(torch.rand(1, 3, 32, 48)) for _ in range(2))
    views = network.decode(a, b)
    found = features(network, a, b, PAPER)
    assert torch.equal(found.encoder[1], b.tokens)
    assert [torch.equal(f, v.tokens[-1]) for f, v in zip(found.decoder, views, strict=True)] == [True, True]
    assert found.descriptors[0].shape == (1, 32, 48, 6)
    torch.testing.assert_close(found.descriptors[1].norm(dim=-1), torch.ones(1, 32, 48))
    assert len(features(network, a, b, replace(PAPER, decoder_levels="all")).decoder) == 8
    encoder_only = features(network, a, b, replace(PAPER, decoder=0.0, descriptors=0.0))
    assert (encoder_only.decoder, encoder_only.descriptors) == ((), ())
