"""A primitive as seen from one direction: the conditional of its joint Gaussian, and of its Beta opacity.

Derived in docs/derivations/beta-primitives.md#conditioning.

With V = [[V11, V12], [V21, V22]], G = V12 V22^-1, x = q - mu_q, lambda = min(B_q / 4, 1), V22 = Lc Lc^T, y = Lc^-1 x:

    mean        m = mu + G diag(lambda) x
    covariance  S = V11 - G diag(lambda) V21
    opacity     o prod_j (1 - tanh y_j^2)^B_qj

This is the plain form, any D and dtype, by autograd; `cpu_conditioning` is the fast one and its closed-form gradient.
"""

import math
from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor
from torch.nn.functional import softplus

from swimm3r.splat.primitives.beta import BetaPrimitives, kernel_exponent
from swimm3r.splat.projection.pixel_filter import smoothed
from swimm3r.splat.settings import RenderSettings


@dataclass(frozen=True)
class Conditioned:
    """Primitives in one view, still in the world."""

    mean: Float[Tensor, "n 3"]
    covariance: Float[Tensor, "n 3 3"]  # symmetric only where all lambda_j are equal
    opacity: Float[Tensor, " n"]


def rotation_block(skew_entries: Float[Tensor, "n 3"], rotation: str = "first_order") -> Float[Tensor, "n 3 3"]:
    """R of the entries (a01, a02, a12): I + A, which stretches where A is not small, or exp(A)."""
    a01, a02, a12 = skew_entries.unbind(-1)
    o = torch.zeros_like(a01)
    A = torch.stack([o, a01, a02, -a01, o, a12, -a02, -a12, o], -1).unflatten(-1, (3, 3))
    if rotation == "exponential":
        return torch.linalg.matrix_exp(A)
    return torch.eye(3, dtype=A.dtype, device=A.device) + A


def factor(p: BetaPrimitives, rotation: str = "first_order") -> Float[Tensor, "n d d"]:
    """L with V = L L^T; lower triangular but for its spatial block."""
    s = softplus(p.scale)
    d = s.shape[-1]
    row, column = torch.tril_indices(d, d, offset=-1)
    rest = row >= 3
    L = s.new_zeros(len(s), d, d)
    L[:, row[rest], column[rest]] = p.lower[:, 3:]
    spatial = rotation_block(p.lower[:, :3], rotation) * s[:, None, :3]
    L = L + torch.diag_embed(torch.cat([torch.zeros_like(s[:, :3]), s[:, 3:]], -1))
    return L + torch.nn.functional.pad(spatial, (0, d - 3, 0, d - 3))


def queries(
    xyz: Float[Tensor, "n 3"], center: Float[Tensor, "3"], time: Float[Tensor, ""] | None = None
) -> Float[Tensor, "n c"]:
    """The query of the conditioning: unit direction camera -> primitive in world axes, then time in 0..1."""
    direction = torch.nn.functional.normalize(xyz - center, dim=-1)
    return direction if time is None else torch.cat([direction, time.to(direction).expand(len(xyz), 1)], -1)


def condition(p: BetaPrimitives, query: Float[Tensor, "n c"], rotation: str = "first_order") -> Conditioned:
    """Mean, covariance and opacity of primitives given their queries."""
    L = factor(p, rotation)
    V = L @ L.mT
    V11, V12, V22 = V[:, :3, :3], V[:, :3, 3:], V[:, 3:, 3:]
    B = 4 * torch.exp(p.beta[:, 1:])
    Lc = torch.linalg.cholesky_ex(V22).L  # positive by its making: to check it, a GPU would have to be waited for
    x = (query - p.query_mean)[..., None]
    half = torch.linalg.solve_triangular(Lc, V12.mT, upper=False)  # cholesky_solve goes matrix by matrix on a GPU
    G = torch.linalg.solve_triangular(Lc.mT, half, upper=True).mT
    G = G * (B / 4).clamp(max=1)[:, None]
    y = torch.linalg.solve_triangular(Lc, x, upper=False)[..., 0]
    log_share = math.log(2) - softplus(2 * y * y)  # ln(1 - tanh y^2) without its cancellation
    return Conditioned(
        mean=p.xyz + (G @ x)[..., 0],
        covariance=V11 - G @ V12.mT,
        opacity=torch.sigmoid(p.opacity) * torch.exp((B * log_share).sum(-1)),
    )


def symmetric(covariance: Float[Tensor, "n 3 3"], form: str) -> Float[Tensor, "n 3 3"]:
    """The covariance a camera sees, of one that need not be symmetric (`RenderSettings.covariance`)."""
    if form == "upper":
        return covariance.triu() + covariance.triu(1).mT
    return (covariance + covariance.mT) / 2


def conditioned_in_view(
    p: BetaPrimitives, center: Float[Tensor, "3"], settings: RenderSettings, time: Float[Tensor, ""] | None = None
) -> Conditioned:
    """Primitives as a camera at `center` sees them, with symmetric covariances."""
    return shown(p, queries(p.xyz, center, time), settings)


def shown(p: BetaPrimitives, query: Float[Tensor, "n c"], settings: RenderSettings) -> Conditioned:
    """Primitives of given queries as they are drawn: with symmetric covariances, no smaller than the filter's."""
    seen = condition(p, query, settings.rotation)
    covariance = smoothed(symmetric(seen.covariance, settings.covariance), kernel_exponent(p), p.footprint, settings)
    return Conditioned(seen.mean, covariance, seen.opacity)
