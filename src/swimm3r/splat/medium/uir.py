"""3D-UIR's medium (Yuan et al. 2025): backscatter and attenuation, each explicit and with a network of its own.

    (Binf, beta_B)(u) = sigma_med[B_phi(SH(d(u)))],   beta_D(u) = sigma_med[D_phi(SH(d(u)))]

The sources at hand do not state the inputs or sizes of the networks: both are that of WaterSplatting, and the image is
formed along the ray as in every recipe with a field (`splat.medium.field`).
"""

import torch
from jaxtyping import Float
from torch import Tensor, nn

from swimm3r.splat.gaussian_settings import AffineColorSettings
from swimm3r.splat.medium.affine_colors import AffineColors
from swimm3r.splat.medium.field import MediumField, at_random, medium_network
from swimm3r.splat.shared_settings import MediumFieldSettings


class _SideBySide(nn.Module):
    """The outputs of two networks with the same inputs, one behind the other."""

    def __init__(self, backscatter: nn.Module, attenuation: nn.Module) -> None:
        super().__init__()
        self.backscatter, self.attenuation = backscatter, attenuation

    def forward(self, features: Float[Tensor, "h w f"]) -> Float[Tensor, "h w 9"]:
        return torch.cat([self.backscatter(features), self.attenuation(features)], -1)


class UirField(MediumField):
    """The networks of the medium, and those of the Gaussians' colors."""

    def __init__(self, medium: MediumFieldSettings, colors: AffineColorSettings) -> None:
        super().__init__(medium)
        if medium.model == "network":
            self.network = nn.Sequential(_SideBySide(medium_network(medium, 6), medium_network(medium, 3)))
        self.affine_colors = AffineColors(colors)


def initial_uir_field(
    medium: MediumFieldSettings, colors: AffineColorSettings, xyz: Float[Tensor, "n 3"], rng: torch.Generator
) -> UirField:
    """A medium at random over Gaussians at `xyz`, working units, whose colors are their own."""
    field = at_random(UirField(medium, colors), rng)
    assert field.affine_colors is not None
    last = field.affine_colors.color[-1]
    assert isinstance(last, nn.Linear)
    with torch.no_grad():
        last.weight.zero_()
        last.bias.zero_()
        field.affine_colors.fit_box(xyz)
    return field
