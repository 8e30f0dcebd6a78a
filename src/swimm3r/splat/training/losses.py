"""The terms of Eq. 18, each a mean; `recipes.uwbs` weighs and adds them. Images are channels first."""

import math
from dataclasses import dataclass
from typing import Any

import torch
from jaxtyping import Bool, Float
from torch import Tensor
from torch.nn.functional import conv2d, softplus

from swimm3r.medium import expected_colors
from swimm3r.raster import RasterOutput
from swimm3r.splat.primitives.beta import BetaPrimitives
from swimm3r.splat.training import ssim_cpu

_NEAREST = 1e-3  # of the scene's unit: the least depth whose inverse is taken
_LEAST_WEIGHT = 1e-12  # of an image's edge-aware weights together, below which none of its depths counts


@dataclass(frozen=True)
class Photometric:
    """Eq. 14 and its two parts; the parts are for the record."""

    loss: Float[Tensor, ""]
    l1: float | Tensor
    ssim: float | Tensor


def photometric(
    render: Float[Tensor, "3 h w"], target: Float[Tensor, "3 h w"], seen: Bool[Tensor, "*c h w"], ssim_weight: float
) -> Photometric:
    """(1 - w) L1 + w (1 - SSIM) (Eq. 14), SSIM zero-padded; pixels or values not `seen` count as matched."""
    match render.device.type, render.dtype:
        case "cpu", torch.float32:
            known, whole = ssim_cpu.photometric, bool(seen.all())  # most are, and a copy takes a third of the time
        case "cuda", torch.float32:
            from swimm3r.splat.training import ssim_cuda

            known, whole = ssim_cuda.photometric, False  # the CPU would have to wait for the device to learn it
        case _:
            return _photometric_plainly(render, target, seen, ssim_weight)
    if not whole:
        target = torch.where(seen, target, render.detach())
    l1, ssim, gradient = known(render, target, ssim_weight)
    value = torch.as_tensor((1 - ssim_weight) * l1 + ssim_weight * (1 - ssim))
    if not whole:
        gradient = torch.where(seen, gradient, 0.0)
    return Photometric(_KnownGradient.apply(render, value, gradient), l1, ssim)


def _photometric_plainly(
    render: Float[Tensor, "3 h w"], target: Float[Tensor, "3 h w"], seen: Bool[Tensor, "*c h w"], ssim_weight: float
) -> Photometric:
    """`photometric` in torch operations, for other devices and precisions, and as the oracle of the fast forms."""
    still = render.detach()
    target, render = torch.where(seen, target, still), torch.where(seen, render, still)
    l1, ssim = (render - target).abs().mean(), mean_ssim(render, target)
    loss = (1 - ssim_weight) * l1 + ssim_weight * (1 - ssim)
    return Photometric(loss, l1.detach(), ssim.detach())


class _KnownGradient(torch.autograd.Function):
    """A value whose gradient has been computed along with it."""

    @staticmethod
    def forward(ctx: Any, x: Tensor, value: Tensor, gradient: Tensor) -> Tensor:
        ctx.save_for_backward(gradient)
        return value.clone()

    @staticmethod
    @torch.autograd.function.once_differentiable
    def backward(ctx: Any, *cotangents: Tensor) -> tuple[Tensor | None, ...]:
        (gradient,) = ctx.saved_tensors
        return cotangents[0] * gradient, None, None


def mean_ssim(x: Float[Tensor, "3 h w"], y: Float[Tensor, "3 h w"]) -> Float[Tensor, ""]:
    """Mean SSIM, 11 x 11 Gaussian window of sigma 1.5, zero padding, in torch operations."""
    offsets = torch.arange(ssim_cpu.WINDOW, dtype=x.dtype, device=x.device) - ssim_cpu.HALF
    weights = torch.exp(-0.5 * (offsets / ssim_cpu.SIGMA) ** 2)
    window = torch.outer(weights, weights)[None, None] / weights.sum() ** 2

    def blur(v: Tensor) -> Tensor:
        return conv2d(v[:, None], window, padding=ssim_cpu.HALF)[:, 0]

    mx, my = blur(x), blur(y)
    sx, sy, sxy = blur(x * x) - mx * mx, blur(y * y) - my * my, blur(x * y) - mx * my
    C1, C2 = float(ssim_cpu.C1), float(ssim_cpu.C2)
    S = (2 * mx * my + C1) * (2 * sxy + C2) / ((mx * mx + my * my + C1) * (sx + sy + C2))
    return S.mean()


def mean_opacity(p: BetaPrimitives) -> Float[Tensor, ""]:
    """L_opa (Eq. 15): what keeps primitives that explain nothing from living on."""
    return torch.sigmoid(p.opacity).mean()


def mean_scale(p: BetaPrimitives, ubs_bug: bool = False) -> Float[Tensor, ""]:
    """L_scale (Eq. 15), of the spatial scales of all primitives; UBS's slip takes all of three primitives."""
    scale = p.scale[:3] if ubs_bug else p.scale[:, :3]
    return softplus(scale.contiguous()).mean()  # across a stride it takes three times as long


def oversize(p: BetaPrimitives, radius: Float[Tensor, " n"], limit: float) -> Float[Tensor, ""]:
    """L_rad (Eq. 17): mean spatial scale of the primitives whose radius exceeds `limit` pixels, 0 for none."""
    large = (radius > limit)[:, None]
    if large.device.type == "cpu" and not bool(large.any()):  # a GPU would have to be waited for
        return p.scale.new_zeros(())
    scales = torch.where(large, softplus(p.scale[:, :3]), 0.0)
    return scales.sum() / (3 * large.sum()).clamp(min=1)


def edge_weight(rgb: Float[Tensor, "3 h w"], scale: float) -> Float[Tensor, "h w"]:
    """w_n of Eq. 13 before it is normalized: mean of e^(-scale |dI/dx|) and e^(-scale |dI/dy|), 1 where I is flat."""
    right, down = edge_weights(rgb, scale)
    return (right + down) / 2


def edge_weights(rgb: Float[Tensor, "3 h w"], scale: float = 1.0) -> tuple[Float[Tensor, "h w"], Float[Tensor, "h w"]]:
    """e^(-scale |dI/dx|) and e^(-scale |dI/dy|), 1 in the last column and row.

    |dI| is the mean over the channels of the absolute difference to the next pixel.
    """
    right = torch.nn.functional.pad(rgb.diff(dim=2).abs().mean(0), (0, 1))
    down = torch.nn.functional.pad(rgb.diff(dim=1).abs().mean(0), (0, 0, 0, 1))
    return torch.exp(-scale * right), torch.exp(-scale * down)


def depth_error(
    images: RasterOutput, z_depth: Float[Tensor, "h w"], weight: Float[Tensor, "h w"], least_alpha: float
) -> Float[Tensor, ""]:
    """L_depth (Eq. 13): sum of w_n log(1 + |1/D^ - 1/D|) over the pixels of known depth that the map covers.

    D^ is the expected depth, `z_depth` D (0 = unknown). The weights are normalized to a sum of 1 over those pixels; the
    paper prints a sum beside means and so leaves their sum open.
    """
    inverse, w = _where_known(images, z_depth, weight, least_alpha)
    return (w * torch.log1p((inverse - 1 / z_depth.clamp(min=_NEAREST)).abs())).sum()


def in_front(
    images: RasterOutput, z_depth: Float[Tensor, "h w"], weight: Float[Tensor, "h w"], least_alpha: float
) -> Float[Tensor, ""]:
    """Weighted mean of max(D / D^ - 1, 0)^2 over the pixels of known depth D that the map covers; 0 for none.

    It keeps the map from standing in front of measured surfaces, the more the farther it does. Depth behind them counts
    nothing, for beside silhouettes measured depth is too small rather than too large.
    """
    inverse, w = _where_known(images, z_depth, weight, least_alpha)
    return (w * (z_depth * inverse - 1).clamp(min=0).square()).sum()


def off_guess(
    images: RasterOutput, z_depth: Float[Tensor, "h w"], slack: float, least_alpha: float
) -> Float[Tensor, ""]:
    """Mean over the image of max(|ln(D^ / D)| - ln slack, 0)^2, D a guessed depth, 0 where there is none.

    A guess is no measurement: off by the factor `slack` at most, the map is at no cost. As a mean over the image it
    decides where images leave depth open, and gives way where several of them show it.
    """
    counted = (z_depth > 0) & (images.alpha.detach() > least_alpha)
    nearness = z_depth * images.alpha / images.z_depth.clamp(min=_NEAREST * least_alpha)
    off = torch.where(counted, nearness, 1.0).log().abs() - math.log(slack)
    return off.clamp(min=0).square().mean()


def _where_known(
    images: RasterOutput, z_depth: Float[Tensor, "h w"], weight: Float[Tensor, "h w"], least_alpha: float
) -> tuple[Float[Tensor, "h w"], Float[Tensor, "h w"]]:
    """1 / D^, and weights with a sum of 1 over the pixels of known depth that the map covers; 0 on others."""
    counted = (z_depth > 0) & (images.alpha.detach() > least_alpha)
    w = torch.where(counted, weight, 0.0)
    inverse = images.alpha / images.z_depth.clamp(min=_NEAREST * least_alpha)
    return inverse, w / w.sum().clamp(min=_LEAST_WEIGHT)


def uncovered(images: RasterOutput, surface: Bool[Tensor, "h w"]) -> Float[Tensor, ""]:
    """Mean of 1 - alpha over the pixels that show a surface; 0 where none does."""
    return torch.where(surface, 1 - images.alpha, 0.0).sum() / surface.sum().clamp(min=1)


def drawn_on_water(images: RasterOutput, open_water: Bool[Tensor, "h w"]) -> Float[Tensor, ""]:
    """Mean of alpha over the pixels that look past every surface; 0 where none does."""
    return torch.where(open_water, images.alpha, 0.0).sum() / open_water.sum().clamp(min=1)


def outside_gamut(p: BetaPrimitives, radius: Float[Tensor, " n"]) -> Float[Tensor, ""]:
    """Mean squared excess of clear colors over 0..1, of the primitives in view (`radius` > 0); 0 for none."""
    in_view = (radius > 0)[:, None]
    excess = p.rgb - p.rgb.detach().clamp(0, 1)
    return torch.where(in_view, excess.square(), 0.0).sum() / (3 * in_view.sum()).clamp(min=1)


def hidden_colors(
    p: BetaPrimitives, arriving: Float[Tensor, "n 3"], radius: Float[Tensor, " n"], half: float
) -> Float[Tensor, ""]:
    """Mean squared distance of clear colors in channels that the water hides from those that the others let expect.

    A primitive in view (`radius` > 0) is expected to have the mean hue of those in view whose channels are all seen, at
    the brightness of its own seen channels. A channel of whose light the share a is `arriving` (T_D, times the light of
    a lamp) is seen to a^2 / (a^2 + half^2); the rest of it counts. 0 for no primitive in view.
    """
    in_view = (radius > 0)[:, None]
    with torch.no_grad():
        known = arriving.square() / (arriving.square() + half**2)
        expected = expected_colors(p.rgb.clamp(0, 1), known, in_view)
    off = (1 - known) * (p.rgb - expected).square()
    return torch.where(in_view, off, 0.0).sum() / (3 * in_view.sum()).clamp(min=1)
