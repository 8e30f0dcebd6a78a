"""How what moves travels: optical flow to the frames before and after, and primitives that go along with it."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Bool, Float, Shaped, UInt8
from torch import Tensor
from torch.nn.functional import grid_sample, interpolate

from swimm3r.cameras import Cameras, unproject
from swimm3r.splat.conditioning import rotation_block
from swimm3r.splat.primitives import BetaPrimitives, inverse_softplus
from swimm3r.splat.views import View

_RETURN = 1.5  # pixels within which flow there and back must end where it began
_FLOW_SIDE = 240  # flow is found on pictures halved until their long side is below twice as many pixels


@dataclass(frozen=True)
class Following:
    """Where pixels of one frame are in another."""

    camera: Cameras
    after: float  # time between the two, lengths of the clip; negative for an earlier frame
    pixels: Float[Tensor, "n 2"]
    leads: Bool[Tensor, " n"]  # whether the flow back ends where it began

    def velocity(self, xyz: Float[Tensor, "n 3"], z_depth: Float[Tensor, " n"]) -> Float[Tensor, "n 3"]:
        """Of what was at `xyz`, lengths per clip; it is taken to be as far from the other camera, too."""
        return (unproject(self.camera, self.pixels[None], z_depth[None])[0] - xyz) / self.after


def followed(
    view: View, mask: Bool[Tensor, "h w"], other: View, other_mask: Bool[Tensor, "h w"], pixels: Float[Tensor, "n 2"]
) -> Following | None:
    """Pixels of the moving parts of one frame in another; None where the two frames cannot be compared.

    Flow is sought between the moving parts alone, before an even grey: the ground, which moves otherwise, would lead it
    astray.
    """
    assert view.time is not None
    assert other.time is not None
    if other.rgb.shape != view.rgb.shape or other.time == view.time:
        return None
    mine, others = _on_grey(view, mask), _on_grey(other, other_mask)
    moved = pixels + _sampled(_flow(mine, others), pixels)
    returned = moved + _sampled(_flow(others, mine), moved)
    leads = torch.linalg.vector_norm(returned - pixels, dim=-1) < _RETURN
    return Following(other.camera, float(other.time - view.time), moved, leads)


def mean_velocity(
    xyz: Float[Tensor, "n 3"], z_depth: Float[Tensor, " n"], ways: Sequence[Following]
) -> Float[Tensor, "n 3"]:
    """Mean over the frames to which the flow leads, lengths per clip; 0 where it leads to none."""
    total, found = torch.zeros_like(xyz), torch.zeros(len(xyz), 1)
    for way in ways:
        leads = way.leads[:, None].float()
        total += leads * way.velocity(xyz, z_depth)
        found += leads
    return total / found.clamp(min=1)


def travelling(
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
    1.7 times as much across the travel, because I + A turns the long axis V11 = radius^2 I + duration^2 v v^T towards
    the travel and stretches what it turns. `duration` is their scale in time, in lengths of the clip.
    """
    n, speed = len(xyz), torch.linalg.vector_norm(velocity, dim=-1)
    still = speed < 1e-9
    along = velocity / speed.clamp(min=1e-9)[:, None]
    along[still] = along.new_tensor([1.0, 0, 0])
    axis = along.abs().argmax(-1)  # the nearest axis is turned, by less than 55 degrees
    rows = torch.arange(n)
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
        opacity=torch.full((n,), opacity).logit(),
        beta=torch.zeros(n, 5),
        scale=inverse_softplus(spread),
        lower=torch.cat([skew, xyz.new_zeros(n, 12), lower, xyz.new_zeros(n, 3)], -1),
    )
    return BetaPrimitives(*(values.float() for values in made))


def _on_grey(view: View, mask: Bool[Tensor, "h w"]) -> UInt8[np.ndarray, "H W"]:
    """What moves in a frame, before an even grey: the ground, which moves otherwise, must not lead the flow astray."""
    import cv2

    grey = cv2.cvtColor((255 * view.rgb).byte().permute(1, 2, 0).numpy(), cv2.COLOR_RGB2GRAY)
    grey[full_size(mask, view).numpy() == 0] = 128
    return grey


def _flow(first: UInt8[np.ndarray, "h w"], second: UInt8[np.ndarray, "h w"]) -> Float[Tensor, "2 h w"]:
    """How far every pixel of one picture has gone in another, pixels (x, y)."""
    import cv2

    flow = cv2.DISOpticalFlow.create(cv2.DISOPTICAL_FLOW_PRESET_MEDIUM)
    flow.setFinestScale(max(0, int(np.log2(max(first.shape) / _FLOW_SIDE))))
    return torch.from_numpy(flow.calc(first, second, None)).permute(2, 0, 1)  # pyright: ignore


def _sampled(maps: Float[Tensor, "c h w"], pixels: Float[Tensor, "n 2"]) -> Float[Tensor, "n c"]:
    """Values of maps at pixels, bilinear; those of the border beyond it."""
    size = torch.tensor([maps.shape[2], maps.shape[1]])
    at = (2 * pixels / size - 1).reshape(1, 1, -1, 2).to(maps)
    return grid_sample(maps[None], at, padding_mode="border", align_corners=False)[0, :, 0].mT


def full_size(values: Shaped[Tensor, "h w"], view: View) -> Float[Tensor, "H W"]:
    """The values of a smaller picture's pixels, at the size of a view's own."""
    return interpolate(values[None, None].float(), view.rgb.shape[1:], mode="nearest")[0, 0]
