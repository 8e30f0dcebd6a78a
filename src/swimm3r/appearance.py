"""Frames that a camera exposed and balanced each by itself: their maps from the colors that the dive has.

    I_f = e^(s_f) (M_f S + b_f),    mean of M_f = identity, mean of b_f = 0, mean of s_f = 0

S being the colors on average over the dive, water included. The shading s_f is what local tone mapping, and light that
moves, do to one frame's colors: it changes smoothly over the image, and is 0 where the dive shows none,

    s = sum_k h_k B_k,    B_k(x, y) = cos(pi i x) cos(pi j y),    (i, j) != (0, 0)

with x and y across and down the image from 0 to 1, and h_k numbers per channel, which fits make alike: light and
local tone mapping change all channels together, and water does not. The constant is left out: it is the frame's
exposure and white balance.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor

_ACROSS, _DOWN = 4, 3  # cosines: a gain changes over a third of the image at the fastest

ORDERS = tuple((i, j) for i in range(_ACROSS) for j in range(_DOWN) if i + j > 0)
"""The (i, j) of the coefficients of a shading, in their order."""


@dataclass(frozen=True)
class ColorFit:
    """The way from colors that were rendered to those of a frame: affine, and then shaded where there is a shading."""

    maps: Float[Tensor, "3 4"]
    shading: Float[Tensor, "k 3"] | None


@dataclass(frozen=True)
class FrameColors:
    """The maps and shadings of some frames; identity on average."""

    names: tuple[str, ...]
    maps: Float[Tensor, "n 3 4"]
    shading: Float[Tensor, "n k 3"] | None = None  # None where gains do not change over the image

    def common(self, name: str, rgb: Float[Tensor, "3 h w"]) -> Float[Tensor, "3 h w"]:
        """A frame's colors as the dive has them on average."""
        k = self.names.index(name)
        if self.shading is not None:
            rgb = rgb / shading_gains(self.shading[k].to(rgb.device), *rgb.shape[1:])
        M = self.maps[k]
        inverse, offset = torch.linalg.inv(M[:, :3].double()).float(), M[:, 3, None, None]
        return torch.einsum("ij,jhw->ihw", inverse.to(rgb.device), rgb - offset.to(rgb.device))

    def tensors(self) -> tuple[Tensor, ...]:
        """Maps, and shadings if there are any."""
        return (self.maps,) if self.shading is None else (self.maps, self.shading)

    def refitted(self, fits: Sequence[ColorFit]) -> "FrameColors":
        """The maps after `fits`, from what the map shows to each frame in the common colors of before.

        Shadings add up, as they would if maps did not mix channels; later fits find what that leaves.
        """
        old, new = self.maps.double(), torch.stack([fit.maps for fit in fits]).double()
        matrix = old[..., :3] @ new[..., :3]
        offset = (old[..., :3] @ new[..., 3:])[..., 0] + old[..., 3]
        maps = about_identity(torch.cat([matrix, offset[..., None]], -1)).float()
        if self.shading is None:
            return FrameColors(self.names, maps)
        shading = self.shading + torch.stack([fit.shading for fit in fits if fit.shading is not None])
        return FrameColors(self.names, maps, shading - shading.mean(0))


def identity_maps(count: int) -> Float[Tensor, "f 3 4"]:
    """The maps of frames whose colors do not change."""
    return torch.eye(3, 4).repeat(count, 1, 1)


def about_identity(maps: Float[Tensor, "f 3 4"]) -> Float[Tensor, "f 3 4"]:
    """The same maps of other common colors: those of which they are the identity on average."""
    mean = maps.double().mean(0)
    matrix = maps[..., :3].double() @ torch.linalg.inv(mean[:, :3])
    offset = maps[..., 3].double() - matrix @ mean[:, 3]
    return torch.cat([matrix, offset[..., None]], -1).to(maps)


def cosines(xy: Float[Tensor, "p 2"]) -> Float[Tensor, "p k"]:
    """B_k at positions in the image, 0..1."""
    x, y = xy.unbind(-1)
    return torch.stack([torch.cos(torch.pi * i * x) * torch.cos(torch.pi * j * y) for i, j in ORDERS], -1)


def image_cosines(height: int, width: int) -> Float[Tensor, "k h w"]:
    """B_k at the centers of an image's pixels."""
    across, down = _along(width), _along(height)
    return torch.stack([down[j][:, None] * across[i] for i, j in ORDERS])


def shading_gains(shading: Float[Tensor, "k 3"], height: int, width: int) -> Float[Tensor, "3 h w"]:
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
