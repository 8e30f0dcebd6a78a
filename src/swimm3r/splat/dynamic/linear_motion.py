"""Primitives that go along a straight way for a while: what moves, in a map whose primitives depend on time."""

from dataclasses import dataclass

import torch
from jaxtyping import Float, Int
from torch import Tensor
from torch.nn.functional import softplus

from swimm3r.splat.primitives.beta import BetaPrimitives, inverse_softplus
from swimm3r.splat.projection.conditioning import rotation_block

LONGEST = 0.4  # scale in time of what travels, lengths of the clip


def traveling(
    xyz: Float[Tensor, "n 3"],
    velocity: Float[Tensor, "n 3"],
    direction: Float[Tensor, "n 3"],
    time: float,
    *,
    radius: Float[Tensor, " n"],
    duration: float,
    rgb: Float[Tensor, "n 3"],
    opacity: float,
) -> BetaPrimitives:
    """Primitives, D = 7, which are at `xyz` at `time` and move at `velocity` (lengths per clip) while they last.

    Conditioned on time t their mean is xyz + velocity (t - time), exactly; their standard deviation is `radius`, up to
    1.7 times as much across the travel, because I + A turns the long axis V11 = radius^2 I + duration^2 v v^T toward
    the travel and stretches what it turns. `duration` is their scale in time, in lengths of the clip.
    """
    n, speed = len(xyz), torch.linalg.vector_norm(velocity, dim=-1)
    still = speed < 1e-9
    along = velocity / speed.clamp(min=1e-9)[:, None]
    along[still] = along.new_tensor([1.0, 0, 0])
    axis = along.abs().argmax(-1)  # the nearest axis is turned, by less than 55 degrees
    rows = torch.arange(n, device=xyz.device)
    cosine = along[rows, axis].abs()
    unit = torch.zeros_like(along)
    unit[rows, axis] = along[rows, axis].sign()
    kx, ky, kz = (torch.linalg.cross(unit, along) / cosine[:, None]).unbind(-1)  # axis times tangent of the turn
    scale = (radius * cosine.sqrt())[:, None].repeat(1, 3)
    scale[rows, axis] = cosine * (radius.square() + (duration * speed).square()).sqrt()
    skew = torch.stack([-kz, ky, -kx], -1)
    M = rotation_block(skew) * scale[:, None]
    lower = torch.linalg.solve(M, velocity[..., None])[..., 0] * duration**2  # V12 = M lower = v duration^2
    own = (duration**2 - lower.square().sum(-1)).clamp(min=(1e-3 * duration) ** 2).sqrt()
    spread = torch.cat([scale, torch.ones(n, 3).to(scale), own[:, None]], -1)
    made = BetaPrimitives(
        xyz=xyz,
        query_mean=torch.cat([direction, direction.new_full((n, 1), time)], -1),
        rgb=rgb,
        opacity=xyz.new_full((n,), opacity).logit(),
        beta=xyz.new_zeros(n, 5),
        scale=inverse_softplus(spread),
        lower=torch.cat([skew, xyz.new_zeros(n, 12), lower, xyz.new_zeros(n, 3)], -1),
        footprint=xyz.new_zeros(n),
    )
    return BetaPrimitives(*(values.float() for values in made))


@dataclass(frozen=True)
class Ways:
    """Times and paths of primitives that exist for a part of the clip only."""

    rows: Int[Tensor, " m"]
    values: dict[str, Float[Tensor, "m c"]]  # by the parameters' names


def ways(p: BetaPrimitives) -> Ways:
    """Of primitives, D = 7; color, opacity and the place at the middle of the time are no part of a way."""
    in_time = softplus(p.scale[:, 6]).square() + p.lower[:, 15:].square().sum(-1)  # V22's last entry
    rows = (in_time < (1.1 * LONGEST) ** 2).nonzero()[:, 0]
    return Ways(rows, {name: getattr(p, name)[rows].clone() for name in ("query_mean", "beta", "scale", "lower")})
