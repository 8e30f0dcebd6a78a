"""Primitives move to where they are needed: relocation, growth and noise (MCMC-GS; for Beta kernels as UBS has it).

    o' = 1 - (1 - o)^(1/n)

is the opacity of each of the n copies that replace a primitive of opacity o; scale and exponent stay (UBS). Where the
kernel is v, 1 at its center and 0 at its rim, they let (1 - o' v)^n of the light pass instead of 1 - o v. The two are
equal at center and rim; in between the copies block more, for n = 2 by o'^2 v (1 - v). No o', scale and exponent mend
that for all v at once, as (1 - (1 - o v)^(1/n)) / o' is not a Beta kernel.
"""

import torch
from jaxtyping import Float, Int
from torch import Tensor

from swimm3r.splat.densify.rows import Round, in_place
from swimm3r.splat.primitives.beta import BetaPrimitives, select
from swimm3r.splat.projection.conditioning import rotation_block
from swimm3r.splat.settings import DensifySettings

_LARGEST = 1 - 2.0**-23
_GATE = 100.0  # sharpness of the noise's gates


def shared_opacity(opacity: Float[Tensor, "*n"], copies: Float[Tensor, "*n"], least: float) -> Float[Tensor, "*n"]:
    """Opacity of each of `copies` primitives that take the place of one and block as much light at its center."""
    return (1 - (1 - opacity) ** (1 / copies)).clamp(least, _LARGEST)


def relocate_and_grow(
    p: BetaPrimitives, target: int, min_opacity: float, rng: torch.Generator
) -> Round[BetaPrimitives]:
    """Dead primitives take half of a live one, drawn by opacity; then more are drawn from all until `target` exist."""
    opacity = torch.sigmoid(p.opacity)
    n = len(opacity)
    source = torch.arange(n, device=opacity.device)
    dead = (opacity <= min_opacity).nonzero()[:, 0]
    alive = (opacity > min_opacity).nonzero()[:, 0]
    restarted = [source[:0]]
    if len(dead) and len(alive):
        drawn = alive[draw_rows(opacity[alive], len(dead), rng)]
        opacity = _shared(opacity, drawn, min_opacity)
        source[dead] = drawn
        opacity[dead] = opacity[drawn]
        restarted.append(drawn)
    added = max(0, target - n) if len(alive) else 0
    if added:
        drawn = draw_rows(opacity, added, rng)
        opacity = _shared(opacity, drawn, min_opacity)
        source = torch.cat([source, source[drawn]])
        opacity = torch.cat([opacity, opacity[drawn]])
        restarted += [drawn, torch.arange(n, n + added, device=drawn.device)]
    moved = select(p, source)
    changed = source != torch.arange(len(source), device=source.device)
    touched = torch.cat(restarted).unique()
    raw = moved.opacity.clone()
    rows = torch.cat([touched, changed.nonzero()[:, 0]]).unique()
    raw[rows] = opacity[rows].logit()  # untouched rows keep their bits
    # as UBS: sources and copies start anew, not the places of the dead
    return in_place(moved._replace(opacity=raw), source, n, touched, len(dead) if len(alive) else 0)


def noise(
    p: BetaPrimitives, rate: float, settings: DensifySettings, rotation: str, rng: torch.Generator
) -> Float[Tensor, "n 3"]:
    """Random displacement within each primitive's own shape, V11 eps, of those near death only."""
    opacity = torch.sigmoid(p.opacity)
    at = (opacity < settings.min_opacity + 0.2).nonzero()[:, 0]  # both gates are below 1e-8 beyond
    q, o = select(p, at), opacity[at]
    L = rotation_block(q.lower[:, :3], rotation) * torch.nn.functional.softplus(q.scale[:, None, :3])
    gate = (1 - o) ** _GATE if settings.noise_gate == "power" else torch.sigmoid(-_GATE * (o - settings.min_opacity))
    eps = torch.randn(len(at), 3, 1, generator=rng).to(o) * rate * gate[:, None, None]
    moved = torch.zeros_like(p.xyz)
    moved[at] = (L @ (L.mT @ eps))[..., 0]
    return moved


def draw_rows(weights: Float[Tensor, " n"], count: int, rng: torch.Generator) -> Int[Tensor, " count"]:
    """Rows drawn with replacement; by the cumulative sum, as torch.multinomial stops at 2^24 categories."""
    edges = weights.double().cumsum(0)
    drawn = torch.rand(count, generator=rng, dtype=torch.float64).to(edges)
    return torch.searchsorted(edges, drawn * edges[-1]).clamp(max=len(weights) - 1)


def _shared(opacity: Float[Tensor, " n"], drawn: Int[Tensor, " m"], least: float) -> Float[Tensor, " n"]:
    copies = torch.bincount(drawn, minlength=len(opacity)) + 1
    return torch.where(copies > 1, shared_opacity(opacity, copies.to(opacity), least), opacity)
