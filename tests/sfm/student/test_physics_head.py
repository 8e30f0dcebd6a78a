"""The head that reads the water: shapes, ranges, and what a change of unit does."""

import pytest
import torch

from swimm3r.medium import add_water, remove_water
from swimm3r.sfm.mast3r.network import Architecture, Encoded, Mast3r
from swimm3r.sfm.student.physics_head import PhysicsHead, WaterMaps, ray_depth_of


def encoded(b: int = 2, h: int = 2, w: int = 3, channels: int = 24, spread: float = 1.0) -> Encoded:
    generator = torch.Generator().manual_seed(2)
    tokens = spread * torch.randn(b, h * w, channels, generator=generator)
    return Encoded(tokens, torch.zeros(b, h * w, 2, dtype=torch.int64), 16 * h, 16 * w)


def head(channels: int = 24) -> PhysicsHead:
    with torch.random.fork_rng():
        torch.manual_seed(0)
        return PhysicsHead(channels)


def wild_head() -> PhysicsHead:
    """Far from its start, as training may drive it."""
    h = head()
    with torch.no_grad():
        h.curve.weight.mul_(100)
        h.frame.weight.mul_(100)
    return h


def test_every_pixel_has_a_curve_and_every_frame_one_veil():
    water = head()(encoded())
    assert water.Binf.shape == water.beta_B.shape == (2, 3)
    assert water.curve.a.shape == water.curve.d.shape == (2, 32, 48, 3)
    medium = water.at(torch.ones(2, 32, 48))
    assert medium.beta_D.shape == medium.Binf.shape == medium.beta_B.shape == (2, 32, 48, 3)
    assert (medium.beta_B == medium.beta_B[:, :1, :1]).all()


def test_coefficients_stay_physical_whatever_the_tokens_are():
    water = wild_head()(encoded(spread=3.0))
    assert ((water.Binf > 0) & (water.Binf < 1)).all()
    assert (water.beta_B > 0).all()
    c = water.curve
    assert (c.a >= 0).all()
    assert (c.c >= 0).all()
    assert (c.b <= 0).all()
    assert (c.d <= 0).all()
    T_D = torch.exp(-water.at(torch.full((2, 32, 48), 4.0)).beta_D * 4.0)
    assert ((T_D >= 0) & (T_D <= 1)).all()


def test_training_starts_from_clear_coastal_water():
    water = head()(encoded())
    medium = water.at(torch.full((2, 32, 48), 2.0))
    assert ((medium.beta_D > 0.2) & (medium.beta_D < 0.45)).all()
    assert ((medium.Binf - 0.35).abs() < 0.1).all()


def test_attenuation_follows_sea_thrus_double_exponential_at_every_pixel():
    water = wild_head()(encoded())
    z = torch.rand(2, 32, 48, generator=torch.Generator().manual_seed(1)) * 5
    y, x = 7, 30
    c = water.curve
    expected = c.a[1, y, x] * torch.exp(c.b[1, y, x] * z[1, y, x]) + c.c[1, y, x] * torch.exp(c.d[1, y, x] * z[1, y, x])
    torch.testing.assert_close(water.at(z).beta_D[1, y, x], expected)
    assert water.curve.a[0].std() > 0.01  # not one value for the whole frame


def test_a_change_of_the_scenes_unit_changes_no_image():
    water, scale = wild_head()(encoded()), 7.3
    generator = torch.Generator().manual_seed(4)
    z, J = torch.rand(2, 32, 48, generator=generator) * 4, torch.rand(2, 32, 48, 3, generator=generator)
    I = add_water(J, z, water.at(z))
    scaled = water.rescaled(scale)
    torch.testing.assert_close(add_water(J, scale * z, scaled.at(scale * z)), I)
    torch.testing.assert_close(remove_water(I, scale * z, scaled.at(scale * z)), remove_water(I, z, water.at(z)))


def test_a_scale_that_is_not_positive_is_refused():
    with pytest.raises(ValueError, match="positive"):
        head()(encoded()).rescaled(0.0)


def test_frames_of_a_batch_do_not_see_each_other():
    both, h = encoded(), wild_head()
    alone = Encoded(both.tokens[1:], both.positions[1:], both.height, both.width)
    for name in ("Binf", "beta_B"):
        torch.testing.assert_close(getattr(h(alone), name)[0], getattr(h(both), name)[1])


def test_a_patchs_curve_knows_the_rest_of_its_frame():
    e, h = encoded(), wild_head()
    other = e.tokens.clone()
    other[:, -1] *= -1
    moved = h(Encoded(other, e.positions, e.height, e.width)).curve.a[:, 0, 0] - h(e).curve.a[:, 0, 0]
    assert (moved.abs() > 1e-4).all()  # the corner of another patch, out of reach of the interpolation


def test_the_head_is_light_on_the_published_network():
    with torch.device("meta"):
        assert sum(p.numel() for p in PhysicsHead(1024).parameters()) == 193_366


def test_it_reads_the_encoder_of_the_network_and_its_gradient_reaches_the_tokens():
    network = Mast3r(
        Architecture(64, 2, 1, 64, 4, 1, dpt_layer_dims=(4, 6, 8, 10), dpt_feature_dim=8, dpt_last_dims=(4, 4),
                     local_hidden_dim=64, descriptor_dim=6)
    )  # fmt: skip
    tokens = network.encode(torch.zeros(1, 3, 32, 48))
    tokens = Encoded(tokens.tokens.detach().requires_grad_(), tokens.positions, tokens.height, tokens.width)
    water: WaterMaps = head(64)(tokens)
    water.at(torch.ones(1, 32, 48)).beta_D.sum().backward()
    assert tokens.tokens.grad is not None
    assert tokens.tokens.grad.abs().sum() > 0


def test_portrait_batches_are_refused():
    e = encoded()
    with pytest.raises(ValueError, match="upright"):
        head()(Encoded(e.tokens, e.positions, e.height, e.width, torch.ones(2, dtype=torch.bool)))


def test_ray_depth_is_the_distance_not_the_z():
    torch.testing.assert_close(ray_depth_of(torch.tensor([[3.0, 0.0, 4.0]])), torch.tensor([5.0]))
