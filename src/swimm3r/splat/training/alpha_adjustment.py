"""Opacities adjusted by depth and viewing direction early in training (OceanSplat, Kweon & Park 2026).

    alpha_i' = (1 - w) alpha_i + w phi(alpha_i, z_i, v_i)

phi is a small network that can dim Gaussians by where they stand before a camera, as those do that take the place of
the medium. w is 1 at first and falls to 0; a finished map is drawn with the Gaussians' own opacities.
"""

import torch
from jaxtyping import Float
from torch import Tensor, nn

from swimm3r.splat.gaussian_settings import AlphaAdjustmentSettings
from swimm3r.splat.primitives.spherical_harmonics import HARMONICS, spherical_harmonics

_LEAST = 1e-6  # of an opacity that has a logit in float32


class AlphaNetwork(nn.Module):
    """phi: sigmoid(logit alpha + f(alpha, z, harmonics of v)), f with one hidden layer of sigmoids and no biases."""

    def __init__(self, hidden: int) -> None:
        super().__init__()
        self.hidden = nn.Linear(2 + HARMONICS, hidden, bias=False)
        self.last = nn.Linear(hidden, 1, bias=False)

    def forward(
        self, opacity: Float[Tensor, " n"], z: Float[Tensor, " n"], direction: Float[Tensor, "n 3"]
    ) -> Float[Tensor, " n"]:
        """Opacities, 0..1, of Gaussians by their own ones (logits), depths and unit directions from the camera."""
        features = torch.cat([torch.sigmoid(opacity)[:, None], z[:, None], spherical_harmonics(direction)], -1)
        return torch.sigmoid(opacity + self.last(torch.sigmoid(self.hidden(features)))[:, 0])


def adjustment_weight(settings: AlphaAdjustmentSettings, share: float) -> float:
    """w at a share of the run: 1 up to `end`, then linear to 0 over `fade`."""
    if share <= settings.end:
        return 1.0
    return max(0.0, 1 - (share - settings.end) / settings.fade) if settings.fade else 0.0


def adjusted_opacity(
    network: AlphaNetwork,
    opacity: Float[Tensor, " n"],
    z: Float[Tensor, " n"],
    direction: Float[Tensor, "n 3"],
    w: float,
) -> Float[Tensor, " n"]:
    """Logits of alpha'."""
    alpha = (1 - w) * torch.sigmoid(opacity) + w * network(opacity, z, direction)
    return alpha.clamp(_LEAST, 1 - _LEAST).logit()
