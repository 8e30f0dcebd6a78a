"""Gaussians multiply where their projected centers are pulled about (3DGS, Kerbl et al. 2023; AbsGS, Ye et al. 2024).

A small one that is pulled hard is doubled, a large one replaced by two of its own shape, drawn from it. The pull is the
mean length of the projected center's gradient, in half images, over the steps that had it in the image.
"""

import math

import torch
from jaxtyping import Float
from torch import Tensor

from swimm3r.devices import CPU
from swimm3r.splat.densify.rows import Round
from swimm3r.splat.optimizer import Moments
from swimm3r.splat.primitives.beta import select
from swimm3r.splat.primitives.gaussian import GaussianPrimitives, shape_factor
from swimm3r.splat.projection.view_camera import Projection, ViewCamera

_SHRINK = math.log(1.6)


def nothing_seen(n: int, device: torch.device = CPU) -> dict[str, Tensor]:
    """Statistics of n Gaussians before any step: sums and counts of gradients, and the largest radius."""
    return {name: torch.zeros(n, device=device) for name in ("pull", "times", "radius")}


def remembered(
    memory: dict[str, Tensor], gradient: Float[Tensor, "n 2"], projection: Projection, view: ViewCamera
) -> dict[str, Tensor]:
    """The memory after one more step, whose centers' gradient (per pixel) and projection are given."""
    size = torch.tensor([view.width, view.height]).to(gradient)
    at, reach = projection.primitives.mean2d.detach(), projection.radius[:, None]
    shown = ((at > -reach) & (at < size + reach)).all(-1) & (projection.radius > 0)
    pull = torch.linalg.vector_norm(gradient * size / 2, dim=-1)
    return {
        "pull": memory["pull"] + torch.where(shown, pull, 0.0),
        "times": memory["times"] + shown,
        "radius": torch.where(shown, memory["radius"].maximum(projection.radius), memory["radius"]),
    }


def multiply(
    p: GaussianPrimitives,
    memory: dict[str, Tensor],
    least_pull: float,
    large: float,
    most: int,
    rng: torch.Generator,
) -> Round[GaussianPrimitives]:
    """Double the small and split the `large` among those pulled harder than `least_pull`, up to `most` in all.

    Where there is no room for all, the hardest pulled come first.
    """
    n = len(p.xyz)
    pull = memory["pull"] / memory["times"].clamp(min=1)
    room = max(0, most - n)
    asked = (pull > least_pull).nonzero()[:, 0]
    if len(asked) > room:
        asked = asked[torch.argsort(pull[asked], descending=True, stable=True)[:room]].sort().values
    halves = p.scale[asked].amax(-1).exp() > large
    split = asked[halves]
    source = torch.cat([torch.arange(n, device=asked.device), asked])
    q = GaussianPrimitives(*(values.clone() for values in select(p, source)))
    both = torch.cat([split, n + halves.nonzero()[:, 0]])  # one half takes the place of the whole
    part = select(q, both)
    eps = torch.randn(len(both), 3, 1, generator=rng).to(q.xyz)
    q.xyz[both] += (shape_factor(part) @ eps)[..., 0]
    q.scale[both] -= _SHRINK
    restarted = torch.cat([split, torch.arange(n, len(source), device=split.device)])
    return Round(q, source, source, restarted, added=len(asked))


def dimmed(
    p: GaussianPrimitives, moments: dict[str, Moments], most: float
) -> tuple[GaussianPrimitives, dict[str, Moments]]:
    """No opacity above `most`, and the optimizer's memory of opacities gone."""
    m = moments["opacity"]
    still = Moments(torch.zeros_like(m.first), torch.zeros_like(m.second), m.steps)
    return p._replace(opacity=p.opacity.clamp(max=math.log(most / (1 - most)))), {**moments, "opacity": still}
