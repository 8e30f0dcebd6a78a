"""The water as a field over ray directions: A_phi of Eq. 10.

    (Binf, beta_B, beta_D)(u, t) = sigma_med[A_phi(SH(d(u)), gamma(t))]

SH are the real spherical harmonics of degrees 0..3 of the pixel's unit ray in world axes. gamma(t), in dynamic maps
alone, is a learned linear map of sines and cosines of octaves of t, 0..1 over the clip: it is defined at times that no
training frame has. A_phi is a 1x1 convolutional network with ReLU hidden layers, sigma_med a sigmoid for Binf and a
softplus for the betas, which are per unit of ray depth. The field is smooth, so it is evaluated on a grid of pixels and
interpolated in between (stride 1 is exact).

Under a lamp on the camera, u are the directions in the camera's axes, as light and backscatter move with it, and Binf
is multiplied by the pattern of the lamp's backscatter (`splat.medium.lamp`).
"""

import math
from dataclasses import dataclass
from typing import TypeVar

import torch
from jaxtyping import Float
from torch import Tensor, nn
from torch.nn.functional import sigmoid, softplus

from swimm3r.lamp import Lamp, veil_pattern
from swimm3r.medium import Medium
from swimm3r.raster import MediumMaps
from swimm3r.splat.medium.affine_colors import AffineColors
from swimm3r.splat.medium.lamp import CameraLamp
from swimm3r.splat.primitives.beta import inverse_softplus
from swimm3r.splat.primitives.spherical_harmonics import HARMONICS, spherical_harmonics
from swimm3r.splat.projection.view_camera import ViewCamera
from swimm3r.splat.shared_settings import MediumFieldSettings


class MediumField(nn.Module):
    """The network, the unit it answers in, and the pixels between the directions it is asked for."""

    length: Tensor  # scene units per working unit; betas are divided by it

    def __init__(self, settings: MediumFieldSettings, dynamic: bool = False, lamp: Lamp | None = None) -> None:
        super().__init__()
        self.lamp = None if lamp is None or settings.model == "none" else CameraLamp(lamp)
        self.stride = settings.stride
        self.affine_colors: AffineColors | None = None  # of Gaussians by the camera; None where colors are their own
        width = settings.time_features if dynamic else 0
        self.gamma = nn.Linear(2 * settings.frequencies, width) if dynamic else None
        self.network = medium_network(settings, 9, HARMONICS + width)
        if settings.model == "none":
            self.gamma, self.network = None, nn.Sequential()
        self.register_buffer("length", torch.ones(()))

    @property
    def is_clear(self) -> bool:
        """Return whether there is no water, wherever one looks."""
        return not len(self.network)

    def forward(
        self, directions: Float[Tensor, "h w 3"], time: Float[Tensor, ""] | None = None
    ) -> Float[Tensor, "9 h w"]:
        """Binf, beta_B and beta_D, in this order, of unit directions in world axes, at a time in 0..1 of the clip.

        Under a lamp directions are in camera axes, and Binf is without the pattern of the backscatter.
        """
        if self.is_clear:
            return directions.new_zeros(9, *directions.shape[:2])
        features = spherical_harmonics(directions)
        if self.gamma is not None:
            assert time is not None
            octaves = math.pi * 2.0 ** torch.arange(self.gamma.in_features // 2).to(features)
            angles = octaves * time.to(features)
            now = self.gamma(torch.cat([angles.sin(), angles.cos()]))
            features = torch.cat([features, now.expand(*features.shape[:2], -1)], -1)
        raw = self.network(features)
        return torch.cat([sigmoid(raw[..., :3]), softplus(raw[..., 3:]) / self.length], -1).permute(2, 0, 1)

    @torch.no_grad()
    def keep_gray(self) -> None:
        """Make the channels alike, in place, as the mean of them."""
        if self.is_clear:
            return
        last = self.network[-1]
        assert isinstance(last, nn.Linear)
        for values in (last.weight, last.bias):
            if values is not None:
                channels = values.unflatten(0, (3, 3))  # of Binf, beta_B and beta_D
                channels.copy_(channels.mean(1, keepdim=True).expand_as(channels))


def medium_network(settings: MediumFieldSettings, outputs: int, inputs: int = HARMONICS) -> nn.Sequential:
    """The layers that settings ask for."""
    activation, layers = nn.ReLU if settings.activation == "relu" else nn.Sigmoid, []
    for _ in range(settings.layers):
        layers += [nn.Linear(inputs, settings.hidden, bias=settings.biases), activation()]
        inputs = settings.hidden
    return nn.Sequential(*layers, nn.Linear(inputs, outputs, bias=settings.biases))


Field = TypeVar("Field", bound=MediumField)
NO_WATER = MediumField(MediumFieldSettings(model="none"))
"""Clear water before black."""


@dataclass(frozen=True)
class FieldGrid:
    """The field on a grid of one camera's pixels, corners included."""

    values: Float[Tensor, "9 gh gw"]
    step: tuple[float, float]  # pixels between neighbors, down and right
    veil: Float[Tensor, "gh gw"] | None = None  # pattern of a lamp's backscatter; None in daylight


def initial_field(
    medium: Medium | None,
    settings: MediumFieldSettings,
    rng: torch.Generator,
    dynamic: bool = False,
    lamp: Lamp | None = None,
) -> MediumField:
    """A field that is `medium` (coefficients per working unit) everywhere; without one, gray and thin water.

    Without biases it cannot be, and begins at random.
    """
    field = at_random(MediumField(settings, dynamic, lamp), rng)
    if settings.model == "none" or not settings.biases:
        return field
    with torch.no_grad():
        gray = torch.full((3,), 0.5)
        start = medium or Medium(gray, torch.full((3,), settings.prior), torch.full((3,), settings.prior))
        last = field.network[-1]
        assert isinstance(last, nn.Linear)
        assert last.bias is not None
        last.weight.zero_()  # the last layer learns first, from the medium as it is
        betas = torch.cat([start.beta_B, start.beta_D]).float().clamp(min=1e-3)
        last.bias.copy_(torch.cat([start.Binf.float().clamp(0.01, 0.99).logit(), inverse_softplus(betas)]))
    return field


def at_random(field: Field, rng: torch.Generator) -> Field:
    """A field whose layers are drawn anew, in place: torch's own default, but from our generator."""
    with torch.no_grad():
        for layer in field.modules():
            if isinstance(layer, nn.Linear):
                bound = 1 / math.sqrt(layer.weight.shape[1])
                layer.weight.uniform_(-bound, bound, generator=rng)
                if layer.bias is not None:
                    layer.bias.uniform_(-bound, bound, generator=rng)
    return field


def in_unit(field: MediumField, length: float) -> MediumField:
    """The trained field itself, now in the scene's own unit, `length` of which are a working unit."""
    field.length.fill_(length)
    return field


def grid_of(field: MediumField, view: ViewCamera, stride: int, time: Float[Tensor, ""] | None = None) -> FieldGrid:
    """The field on about every stride-th pixel of a view, at a time in 0..1; the pose may carry a gradient."""
    rows, columns = (max(2, math.ceil((size - 1) / stride) + 1) for size in (view.height, view.width))
    y = torch.linspace(0.5, view.height - 0.5, rows, device=view.R.device)
    x = torch.linspace(0.5, view.width - 0.5, columns, device=view.R.device)
    rays = view.rays(x, y)
    rays = rays if field.lamp else rays @ view.R  # R^T to the world
    directions = torch.nn.functional.normalize(rays, dim=-1).to(field.length)
    step = ((view.height - 1) / (rows - 1), (view.width - 1) / (columns - 1))
    veil = None if field.lamp is None else veil_pattern(directions, field.lamp.lamp)
    return FieldGrid(field(directions, time), step, veil)


def medium_at_pixels(grid: FieldGrid, height: int, width: int) -> MediumMaps:
    """The field at every pixel, betas per unit of ray depth."""
    Binf, beta_B, beta_D = grid.values.split(3)
    if grid.veil is not None:
        Binf = Binf * grid.veil
    if grid.values.shape[1:] != (height, width):
        # as matrix products: torch's own bilinear interpolation takes four times as long on a processor
        rows, columns = grid.values.shape[1:]
        down, right = _hats(rows, height, grid.values), _hats(columns, width, grid.values)
        Binf, beta_B, beta_D = (down @ values @ right.mT for values in (Binf, beta_B, beta_D))
    return MediumMaps(Binf, beta_B=beta_B, beta_D=beta_D)


def _hats(few: int, many: int, like: Tensor) -> Float[Tensor, "many few"]:
    """Weights of linear interpolation from `few` to `many` places along an edge whose ends they share."""
    at = torch.linspace(0, few - 1, many, dtype=torch.float64, device=like.device)
    return (1 - (at[:, None] - torch.arange(few, device=like.device)).abs()).clamp(min=0).to(like)


def ray_lengths(view: ViewCamera) -> Float[Tensor, "h w"]:
    """Lengths of the pixels' rays at z = 1."""
    x, y = (torch.arange(size, device=view.R.device) + 0.5 for size in (view.width, view.height))
    return torch.linalg.vector_norm(view.rays(x, y), dim=-1)


def per_z_depth(maps: MediumMaps, view: ViewCamera) -> MediumMaps:
    """Betas for a rasterizer that blends z depth: times the length of the pixel's ray at z = 1, which is exact."""
    length = ray_lengths(view).to(maps.Binf)
    return MediumMaps(maps.Binf, maps.beta_D * length, maps.beta_B * length)


def smoothness(grid: FieldGrid) -> Float[Tensor, ""]:
    """L_smooth (Eq. 16): mean absolute difference of neighboring pixels, down plus right, of all nine maps.

    Along an interpolated edge the differences between pixels add up to those between grid points, so those over the
    step have the same mean wherever neighboring edges slope the same way.
    """
    down, right = grid.values.diff(dim=1), grid.values.diff(dim=2)
    return down.abs().mean() / grid.step[0] + right.abs().mean() / grid.step[1]
