"""Gains that change smoothly over an image."""

import torch

from swimm3r.appearance import ORDERS, cosines, image_cosines, shading_gains
from swimm3r.cameras import pixel_grid

HEIGHT, WIDTH = 30, 44


def test_an_image_has_the_cosines_of_its_pixels_places():
    at = pixel_grid(HEIGHT, WIDTH) / torch.tensor([WIDTH, HEIGHT])
    of_places = cosines(at.reshape(-1, 2)).reshape(HEIGHT, WIDTH, -1).permute(2, 0, 1)
    torch.testing.assert_close(of_places, image_cosines(HEIGHT, WIDTH), atol=1e-5, rtol=0)


def test_gains_are_the_exponential_of_the_sum_of_cosines():
    shading = 0.2 * torch.randn(len(ORDERS), 3, generator=torch.Generator().manual_seed(0))
    slow = torch.einsum("kc,khw->chw", shading, image_cosines(HEIGHT, WIDTH)).exp()
    torch.testing.assert_close(shading_gains(shading, HEIGHT, WIDTH), slow, atol=1e-5, rtol=0)


def test_the_mean_of_logarithms_is_none():
    shading = torch.randn(len(ORDERS), 3, generator=torch.Generator().manual_seed(0))
    assert shading_gains(shading, HEIGHT, WIDTH).log().mean((1, 2)).abs().max() < 1e-5
