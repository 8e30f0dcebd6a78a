"""Gains that change smoothly over a frame: what local tone mapping, and light that moves, do to one frame's colors.

    e^s(x, y),    s = sum_k h_k B_k,    B_k(x, y) = cos(pi i x) cos(pi j y),    (i, j) != (0, 0)

with x and y across and down the image from 0 to 1, and h_k one number per channel. The constant is left out: it is the
frame's exposure and white balance (`imaging.frame_colors`).
"""

import torch
from jaxtyping import Float
from torch import Tensor

_ACROSS, _DOWN = 4, 3  # cosines: a gain changes over a third of the image at the fastest

ORDERS = tuple((i, j) for i in range(_ACROSS) for j in range(_DOWN) if i + j > 0)
"""The (i, j) of the coefficients of a shading, in their order."""


def cosines(xy: Float[Tensor, "p 2"]) -> Float[Tensor, "p k"]:
    """B_k at positions in the image, 0..1."""
    x, y = xy.unbind(-1)
    return torch.stack([torch.cos(torch.pi * i * x) * torch.cos(torch.pi * j * y) for i, j in ORDERS], -1)


def image_cosines(height: int, width: int) -> Float[Tensor, "k h w"]:
    """B_k at the centers of an image's pixels."""
    across, down = _along(width), _along(height)
    return torch.stack([down[j][:, None] * across[i] for i, j in ORDERS])


def gains(shading: Float[Tensor, "k 3"], height: int, width: int) -> Float[Tensor, "3 h w"]:
    """e^s over an image."""
    table = shading.new_zeros(3, _DOWN, _ACROSS)
    for k, (i, j) in enumerate(ORDERS):
        table[:, j, i] = shading[k]
    across, down = (_along(size).to(shading) for size in (width, height))
    return (down[:_DOWN].mT @ table @ across[:_ACROSS]).exp()


def _along(size: int) -> Float[Tensor, "k n"]:
    at = (torch.arange(size) + 0.5) / size
    order = torch.arange(max(_ACROSS, _DOWN))
    return torch.cos(torch.pi * order[:, None] * at)
