"""Gray is luma, but for images whose texture is in channels that luma hardly counts."""

import numpy as np
import torch

from swimm3r.imaging.gray import LUMA, gray_levels, strongest, texture_moments, weights_for_features

EVERYWHERE = torch.ones(96, 128, dtype=torch.bool)


def textured(by: tuple[float, float, float], noise: float = 0.004) -> torch.Tensor:
    """An image whose texture has a share in each channel, with a camera's noise."""
    rng = torch.Generator().manual_seed(0)
    texture = torch.rand(1, 1, 32, 43, generator=rng)
    texture = torch.nn.functional.interpolate(texture, (96, 128), mode="bicubic", align_corners=False)[0, 0]
    return 0.3 + 0.3 * texture[..., None] * torch.tensor(by) + noise * torch.randn(96, 128, 3, generator=rng)


def test_luma_where_no_other_gray_shows_much_more():
    for by in ((1.0, 1.0, 1.0), (0.5, 1.0, 0.9), (1.0, 0.8, 0.6)):
        assert torch.equal(weights_for_features(textured(by), EVERYWHERE), LUMA)


def test_the_channel_that_the_texture_is_in_where_luma_hardly_shows_it():
    weights = weights_for_features(textured((0.02, 0.1, 1.0)), EVERYWHERE)
    assert weights[2] > 0.85
    torch.testing.assert_close(weights.sum(), torch.tensor(1.0))


def test_luma_where_there_is_no_texture_and_where_nothing_is_seen():
    assert torch.equal(weights_for_features(torch.full((96, 128, 3), 0.4), EVERYWHERE), LUMA)
    assert torch.equal(weights_for_features(textured((0, 0, 1.0)), ~EVERYWHERE), LUMA)


def test_what_a_mask_hides_does_not_count():
    image = textured((1.0, 1.0, 1.0))
    image[:, 64:] = textured((0.0, 0.0, 3.0))[:, 64:]
    left = EVERYWHERE.clone()
    left[:, 60:] = False
    assert torch.equal(weights_for_features(image, left), LUMA)
    assert weights_for_features(image, EVERYWHERE)[2] > 0.6


def test_moments_are_those_of_texture_and_not_of_slow_light():
    slow = torch.linspace(0.3, 0.5, 128).expand(96, 128)[..., None] * torch.tensor([1.0, 0, 0])
    moments = texture_moments(textured((0.0, 1.0, 0.0), noise=0.0) + slow, EVERYWHERE, 480)
    assert moments[1, 1] > 20 * moments[0, 0]
    assert strongest(moments)[1] > 0.98 * LUMA.norm()


def test_levels_are_the_weighted_mean():
    image = torch.rand(4, 5, 3)
    np.testing.assert_array_equal(gray_levels(image), (image @ LUMA * 255).round().byte().numpy())
    blue = gray_levels(image, torch.tensor([0.0, 0.0, 1.0]))
    np.testing.assert_array_equal(blue, (image[..., 2] * 255).round().byte().numpy())
