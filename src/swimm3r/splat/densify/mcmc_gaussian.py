"""Relocation, growth and noise for Gaussians (3DGS-MCMC; docs/derivations/compared-methods.md#mcmc-gs).

A Gaussian of opacity o that n of them replace gives each o' = 1 - (1 - o)^(1/n), and so that together they look as
before along a line through their middle, scales times

    o / sum_{j=1..n} C(n, j) (-1)^(j-1) o'^j / sqrt(j)
"""

import torch
from jaxtyping import Float, Int
from torch import Tensor

from swimm3r.splat.densify.mcmc_beta import draw_rows, shared_opacity
from swimm3r.splat.densify.rows import Round, in_place, unchanged
from swimm3r.splat.primitives.beta import select
from swimm3r.splat.primitives.gaussian import GaussianPrimitives, shape_factor

_MOST_COPIES = 51
_GATE = 100.0  # sharpness of the noise's


def scale_factor(opacity: Float[Tensor, "*n"], copies: Float[Tensor, "*n"]) -> Float[Tensor, "*n"]:
    """Factor of the scales where `copies` Gaussians replace one; in float64."""
    o, n = opacity.double(), copies.double()
    share = 1 - (1 - o) ** (1 / n)
    total, choose = torch.zeros_like(o), torch.ones_like(o)
    for j in range(1, _MOST_COPIES + 1):
        choose = choose * (n - j + 1) / j  # C(n, j), 0 from j = n + 1 on
        total = total - choose * (-share) ** j / j**0.5
    return o / total


def relocate_and_grow(
    p: GaussianPrimitives, target: int, min_opacity: float, rng: torch.Generator
) -> Round[GaussianPrimitives]:
    """Dead Gaussians take a share of a live one, drawn by opacity; then more are drawn until `target` exist."""
    n = len(p.xyz)
    opacity = torch.sigmoid(p.opacity)
    dead, alive = (opacity <= min_opacity).nonzero()[:, 0], (opacity > min_opacity).nonzero()[:, 0]
    if not len(alive):
        return unchanged(p)
    source = torch.arange(n, device=dead.device)
    restarted = [source[:0]]
    if len(dead):
        drawn = alive[draw_rows(opacity[alive], len(dead), rng)]
        p = _shared(p, drawn, min_opacity)
        source[dead] = drawn
        p = select(p, source)
        restarted.append(drawn)
    added = max(0, target - n)
    if added:
        drawn = draw_rows(torch.sigmoid(p.opacity), added, rng)
        p = _shared(p, drawn, min_opacity)
        p = select(p, torch.cat([torch.arange(n, device=drawn.device), drawn]))
        source = torch.cat([source, source[drawn]])
        restarted += [drawn, torch.arange(n, n + added, device=drawn.device)]
    # the places of the dead keep their memory, as gsplat has it
    return in_place(p, source, n, torch.cat(restarted).unique(), len(dead))


def noise(p: GaussianPrimitives, rate: float, min_opacity: float, rng: torch.Generator) -> Float[Tensor, "n 3"]:
    """Random displacement Sigma eps within each Gaussian's own shape, of those near death only."""
    opacity = torch.sigmoid(p.opacity)
    at = (opacity < min_opacity + 0.2).nonzero()[:, 0]  # the gate is below 1e-8 beyond
    L = shape_factor(select(p, at))
    gate = torch.sigmoid(-_GATE * (opacity[at] - min_opacity))
    eps = torch.randn(len(at), 3, 1, generator=rng).to(gate) * rate * gate[:, None, None]
    moved = torch.zeros_like(p.xyz)
    moved[at] = (L @ (L.mT @ eps))[..., 0]
    return moved


def _shared(p: GaussianPrimitives, drawn: Int[Tensor, " m"], least: float) -> GaussianPrimitives:
    """Opacity and scale of the drawn, each as its share of all its copies; the others keep their bits."""
    copies = (torch.bincount(drawn, minlength=len(p.xyz)) + 1).clamp(max=_MOST_COPIES)
    rows = (copies > 1).nonzero()[:, 0]
    o, n = torch.sigmoid(p.opacity[rows]).double(), copies[rows].double()
    opacity, scale = p.opacity.clone(), p.scale.clone()
    opacity[rows] = shared_opacity(o, n, least).logit().to(opacity)
    scale[rows] += scale_factor(o, n).log()[:, None].to(scale)
    return p._replace(opacity=opacity, scale=scale)
