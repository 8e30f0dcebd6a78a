"""The rasterizer as the paper writes it, in torch: slow, dense, the oracle of the fast ones.

    V(u) = sum_i T_i (e^{-beta_B z_{i-1}} - e^{-beta_B z_i}) + T_{K+1} e^{-beta_B z_K},  z_0 = 0       (Eq. 11)
    I(u) = sum_i T_i alpha_i c_i e^{-beta_D z_i} + B_inf V(u),  T_i = prod_{j<i} (1 - alpha_j)         (Eq. 12)

Every pixel meets every primitive, so memory is pixels x primitives: for scenes of a few hundred primitives.
"""

from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from swimm3r.raster.records import ALPHA_MAX, T_MIN, Kernel, MediumMaps, Primitives2D, RasterOutput, SggBuffers


@dataclass(frozen=True)
class Blend:
    """One or many pixels blended over k primitives, front to back."""

    w: Float[Tensor, "*pixels k"]  # T_i alpha_i
    T: Float[Tensor, "*pixels k+1"]  # transmittance before each primitive, and after the last
    V: Float[Tensor, "*pixels 3"]
    attenuated: Float[Tensor, "*pixels 3"]  # sum w c e^{-beta_D z}
    clear: Float[Tensor, "*pixels 3"]
    rgb: Float[Tensor, "*pixels 3"]
    z_depth: Float[Tensor, "*pixels"]
    alpha: Float[Tensor, "*pixels"]


@dataclass(frozen=True)
class AlphaAdjoint:
    """dL/dalpha_i by branch (docs/derivations/compositing.md#branches-of-the-adjoint); they add up to the full one."""

    clear: Float[Tensor, "*pixels k"]  # the image loss, as if it looked at the water-free image
    attenuation: Float[Tensor, "*pixels k"]
    backscatter: Float[Tensor, "*pixels k"]
    depth: Float[Tensor, "*pixels k"]  # losses on z_depth
    other: Float[Tensor, "*pixels k"]  # losses on the clear image and on alpha

    @property
    def geo(self) -> Float[Tensor, "*pixels k"]:
        """The geometry branch of Alg. 1."""
        return self.clear + self.depth + self.other

    @property
    def med(self) -> Float[Tensor, "*pixels k"]:
        """The medium branch of Alg. 1."""
        return self.attenuation + self.backscatter


def beta_kernel(r2: Float[Tensor, "*x"], exponent: Float[Tensor, "*x"]) -> Float[Tensor, "*x"]:
    """(1 - r2)^exponent inside the support 0 <= r2 < 1, else 0; r2 is the squared Mahalanobis distance, not halved."""
    inside = (r2 >= 0) & (r2 < 1)
    u = torch.where(inside, 1 - r2, torch.ones_like(r2))  # 1 outside, where the power and its gradient are not used
    return torch.where(inside, u**exponent, torch.zeros_like(r2))


def gaussian_kernel(r2: Float[Tensor, "*x"], exponent: Float[Tensor, "*x"]) -> Float[Tensor, "*x"]:
    """e^(-exponent r2); an exponent of 1/2 is the Gaussian of 3DGS."""
    return torch.exp(-exponent * r2)


def transmittance(alpha: Float[Tensor, "*pixels k"]) -> Float[Tensor, "*pixels k+1"]:
    """T_1 = 1 before the first primitive, T_{i+1} = T_i (1 - alpha_i)."""
    return torch.cat([alpha.new_ones(*alpha.shape[:-1], 1), torch.cumprod(1 - alpha, -1)], -1)


def blend(
    alpha: Float[Tensor, "*pixels k"], color: Float[Tensor, "k 3"], z: Float[Tensor, " k"], medium: MediumMaps
) -> Blend:
    """Eqs. 11 and 12, literally. Primitives stand front to back; medium maps are [*pixels, 3] here.

    A pair with alpha = 0 changes nothing, so skipped pairs may stay in the list.
    """
    Binf, beta_D, beta_B = medium
    T = transmittance(alpha)
    w = T[..., :-1] * alpha
    z_with_0 = torch.cat([z.new_zeros(1), z])
    E_B = torch.exp(-beta_B[..., None, :] * z_with_0[:, None])  # [*pixels, k + 1, 3]
    E_D = torch.exp(-beta_D[..., None, :] * z[:, None])
    V = (T[..., :-1, None] * (E_B[..., :-1, :] - E_B[..., 1:, :])).sum(-2) + T[..., -1:] * E_B[..., -1, :]
    attenuated = (w[..., None] * color * E_D).sum(-2)
    return Blend(w, T, V, attenuated, w @ color, attenuated + Binf * V, w @ z, 1 - T[..., -1])


def split_alpha_adjoint(
    alpha: Float[Tensor, "*pixels k"],
    color: Float[Tensor, "k 3"],
    z: Float[Tensor, " k"],
    medium: MediumMaps,
    cotangent: RasterOutput,
) -> AlphaAdjoint:
    """dL/dalpha of each branch, in closed form; maps are [*pixels, 3] or [*pixels].

    Derived in docs/derivations/compositing.md#the-adjoint-of-alpha.

    The loss depends on alpha only through sum_i w_i e_i, with a payload e_i per branch; back to front,
    dL/dalpha_i = T_i (e_i - R_{i+1}),  R_i = alpha_i e_i + (1 - alpha_i) R_{i+1}.
    """
    Binf, beta_D, beta_B = medium
    g = cotangent.rgb
    T = transmittance(alpha)
    E_B = torch.exp(-beta_B[..., None, :] * z[:, None])
    E_D = torch.exp(-beta_D[..., None, :] * z[:, None])
    payloads = (
        g @ color.T,
        (g[..., None, :] * color * (E_D - 1)).sum(-1),
        -((g * Binf)[..., None, :] * E_B).sum(-1),
        cotangent.z_depth[..., None] * z,
        cotangent.clear @ color.T + cotangent.alpha[..., None],
    )

    def adjoint(e: Tensor) -> Tensor:
        R = alpha.new_zeros(alpha.shape[:-1])
        out = torch.empty_like(alpha)
        for i in reversed(range(alpha.shape[-1])):
            out[..., i] = T[..., i] * (e[..., i] - R)
            R = alpha[..., i] * e[..., i] + (1 - alpha[..., i]) * R
        return out

    return AlphaAdjoint(*(adjoint(e) for e in payloads))


def _accepted(alpha: Float[Tensor, "p k"]) -> Bool[Tensor, "p k"]:
    """Pairs that a pixel blends: all until the first that would bring T to T_MIN or below; that one is left out."""
    T = alpha.new_ones(alpha.shape[0])
    live = torch.ones_like(T, dtype=torch.bool)
    accepted = torch.zeros_like(alpha, dtype=torch.bool)
    for i in range(alpha.shape[1]):
        T_next = T * (1 - alpha[:, i])
        live = live & (T_next > T_MIN)
        accepted[:, i] = live & (alpha[:, i] > 0)
        T = torch.where(live, T_next, T)
    return accepted


@dataclass(frozen=True)
class _Pairs:
    """Every pixel against every drawn primitive, front to back."""

    order: Tensor  # [k] indices of the drawn primitives
    dx: Tensor  # [p, k] center minus pixel
    dy: Tensor
    r2: Tensor
    alpha: Tensor  # 0 where the pair is skipped
    capped: Tensor


def _pairs(p: Primitives2D, height: int, width: int, alpha_min: float, kernel: Kernel) -> _Pairs:
    """Alpha of every pair, with the cut-offs of docs/derivations/beta-primitives.md#kernel."""
    A, B, C = p.conic.unbind(-1)
    drawn = (p.depth > 0) & p.depth.isfinite() & (A * C - B * B > 0) & (A > 0)
    order = torch.argsort(p.depth, stable=True)
    order = order[drawn[order]]
    y, x = torch.meshgrid(
        torch.arange(height, dtype=p.mean2d.dtype) + 0.5, torch.arange(width, dtype=p.mean2d.dtype) + 0.5, indexing="ij"
    )
    mean, (A, B, C) = p.mean2d[order], p.conic[order].unbind(-1)
    dx = mean[:, 0] - x.reshape(-1, 1).to(mean)
    dy = mean[:, 1] - y.reshape(-1, 1).to(mean)
    r2 = A * dx * dx + 2 * B * dx * dy + C * dy * dy
    fade = gaussian_kernel if kernel == "gaussian" else beta_kernel
    raw = p.opacity[order] * fade(r2, p.beta[order].expand_as(r2))
    alpha = raw.clamp(max=ALPHA_MAX)
    alpha = torch.where(alpha.detach() >= alpha_min, alpha, torch.zeros_like(alpha))
    alpha = torch.where(_accepted(alpha.detach()), alpha, torch.zeros_like(alpha))
    return _Pairs(order, dx, dy, r2, alpha, raw > ALPHA_MAX)


def _per_pixel(maps: Float[Tensor, "c h w"]) -> Float[Tensor, "p c"]:
    return maps.reshape(maps.shape[0], -1).T


def render(
    p: Primitives2D, medium: MediumMaps, height: int, width: int, alpha_min: float, kernel: Kernel
) -> RasterOutput:
    """The four images in the inputs' precision; differentiable."""
    pairs = _pairs(p, height, width, alpha_min, kernel)
    water = MediumMaps(*(_per_pixel(m) for m in medium))
    out = blend(pairs.alpha, p.color[pairs.order], p.depth[pairs.order], water)
    return RasterOutput(
        out.rgb.T.reshape(3, height, width),
        out.clear.T.reshape(3, height, width),
        out.z_depth.reshape(height, width),
        out.alpha.reshape(height, width),
    )


def sgg(
    p: Primitives2D,
    medium: MediumMaps,
    height: int,
    width: int,
    alpha_min: float,
    kernel: Kernel,
    cotangent: RasterOutput,
) -> SggBuffers:
    """The buffers of Alg. 1 from the closed forms; p and medium carry no gradient."""
    pairs = _pairs(p, height, width, alpha_min, kernel)
    order = pairs.order
    water = MediumMaps(*(_per_pixel(m) for m in medium))
    g = RasterOutput(
        _per_pixel(cotangent.rgb),
        _per_pixel(cotangent.clear),
        cotangent.z_depth.reshape(-1),
        cotangent.alpha.reshape(-1),
    )
    branch = split_alpha_adjoint(pairs.alpha, p.color[order], p.depth[order], water, g)
    # dalpha/dmean2d = -2 b alpha / u (conic delta), nothing where alpha is capped or the pair skipped
    shaped = (pairs.alpha > 0) & ~pairs.capped
    u = torch.where(shaped & (kernel == "beta"), 1 - pairs.r2, torch.ones_like(pairs.r2))
    slope = torch.where(shaped, -2 * p.beta[order] * pairs.alpha / u, torch.zeros_like(u))
    A, B, C = p.conic[order].unbind(-1)
    dalpha = slope[..., None] * torch.stack([A * pairs.dx + B * pairs.dy, B * pairs.dx + C * pairs.dy], -1)
    geo, med, dep = (a[..., None] * dalpha for a in (branch.geo, branch.med, branch.depth))
    w = transmittance(pairs.alpha)[:, :-1] * pairs.alpha
    through_z = (w * g.z_depth[:, None]).sum(0)
    buffers = (
        geo.sum(0),
        med.sum(0),
        geo.abs().sum(0),
        (geo + med).abs().sum(0),
        torch.cat([dep.sum(0), through_z[:, None]], -1),
    )
    n = len(p.depth)
    return SggBuffers(*(b.new_zeros(n, b.shape[1]).index_copy(0, order, b) for b in buffers))


def adjoint(
    p: Primitives2D,
    medium: MediumMaps,
    height: int,
    width: int,
    alpha_min: float,
    kernel: Kernel,
    cotangent: RasterOutput,
    buffers: SggBuffers | None,
) -> tuple[Primitives2D, MediumMaps]:
    """Gradients by autograd, rendering again; adds the closed forms of Alg. 1 to `buffers`."""
    if buffers is not None:
        for buffer, part in zip(buffers, sgg(p, medium, height, width, alpha_min, kernel, cotangent), strict=True):
            buffer += part
    leaves = [t.detach().requires_grad_() for t in (*p, *medium)]
    with torch.enable_grad():
        again = render(Primitives2D(*leaves[:6]), MediumMaps(*leaves[6:]), height, width, alpha_min, kernel)
    grads = torch.autograd.grad(again, leaves, cotangent, materialize_grads=True)
    return Primitives2D(*grads[:6]), MediumMaps(*grads[6:])
