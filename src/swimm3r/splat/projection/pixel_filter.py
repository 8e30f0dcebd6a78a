"""Filters that keep primitives no smaller than pixels (docs/derivations/beta-primitives.md#filters).

With a the extent of a primitive's shape matrix per unit of its kernel's covariance, and h its footprint, that is the
finest pixel of a training image at its place, Mip-Splatting's filters (Yu et al. 2024) are

    S' = S + a h^2 / 12 I        Sigma2' = Sigma2 + a / 12 I        o' = o sqrt(det Sigma2 / det Sigma2')

The dilation of 3DGS and UBS is Sigma2' = Sigma2 + d I with d = 0.3 px^2, whatever the kernel, and keeps o.
"""

from typing import NamedTuple

import torch
from jaxtyping import Float
from torch import Tensor

from swimm3r.raster import Primitives2D
from swimm3r.splat.gaussian_settings import GaussianRenderSettings
from swimm3r.splat.settings import RenderSettings

PIXEL = 1 / 12
"""Variance of a square pixel, pixels^2: of both filters, in training pixels the one and in the view's the other."""
_LEAST_SHARE = 1e-6  # of a determinant that is left: float32 knows no smaller one


class Widening(NamedTuple):
    """Additions to the shape matrices of primitives as linear functions of the kernel's exponent B: u + v B."""

    world: tuple[float, float]  # times the squared footprint
    plane: tuple[float, float]  # px^2


def widening(settings: RenderSettings | GaussianRenderSettings) -> Widening:
    """The additions that settings ask for. A Beta kernel's a is 2 (B + 2), a Gaussian's is 1."""
    if settings.antialiasing == "dilation":
        return Widening((0.0, 0.0), (settings.dilation, 0.0))
    if isinstance(settings, GaussianRenderSettings):
        return Widening((PIXEL, 0.0), (PIXEL, 0.0))
    return Widening((4 * PIXEL, 2 * PIXEL), (4 * PIXEL, 2 * PIXEL))


def smoothed(
    covariance: Float[Tensor, "n 3 3"],
    exponent: Float[Tensor, " n"],
    footprint: Float[Tensor, " n"],
    settings: RenderSettings | GaussianRenderSettings,
) -> Float[Tensor, "n 3 3"]:
    """S'. Footprints are measured: no gradient reaches them."""
    added = linear(widening(settings).world, exponent) * footprint.detach().square()
    return covariance + torch.diag_embed(added[:, None].expand(-1, 3))


def linear(of_exponent: tuple[float, float], exponent: Float[Tensor, " n"]) -> Float[Tensor, " n"]:
    """u + v B."""
    return of_exponent[0] + of_exponent[1] * exponent


def with_light_kept(p: Primitives2D, settings: RenderSettings | GaussianRenderSettings) -> Primitives2D:
    """Opacities of widened primitives that let the light through which they did before.

    With w the addition and C the conic, the inverse of Sigma2', det Sigma2 / det Sigma2' = det(I - w C).
    """
    if settings.antialiasing == "dilation":
        return p
    A, B, C = p.conic.unbind(-1)
    w = linear(widening(settings).plane, p.beta)
    left = 1 - w * (A + C) + w * w * (A * C - B * B)
    return p._replace(opacity=p.opacity * torch.sqrt(left.clamp(_LEAST_SHARE, 1)))
