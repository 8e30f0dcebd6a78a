"""Losses of medium-aware training: the student's features against the teacher's, and the water against images.

    L_geom = sum_k lambda_k |F_k - F~_k|^2       k: encoder, decoder, descriptors            (Eq. 1)
    L_for  = 1/N sum_n |I->_n - I_n|_1           I-> = add_water(J)                          (Eq. 5)
    L_inv  = 1/N sum_n |J<-_n - J_n|_1           J<- = remove_water(I), not clamped          (Eq. 6)
    L_sat  = 1/N sum_n |[J<- - 1]+|^2 + |[-J<-]+|^2 + 0.5 |Binf - Q_0.05(I)|^2               (Eq. 7)
    L_SfM  = L_geom + L_for + L_inv + L_sat                                                  (Eq. 8)

and where the augmentation drew the water, of weight 0 unless asked for, because the paper has no such term:

    L_wat  = 1/N sum_n |T_D,n - T~_D,n|_1 + |B_n - B~_n|_1                    T~_D, B~: of the water that was drawn

Norms go over the three channels, N counts a frame's valid pixels. Every loss returns one number per frame or pair, so
that a batch may be cut into parts, or spread over processes, without changing the mean.

Q_0.05 is a pixel's color, and dim pixels are near or black: in haze it lies below Binf, so the anchor biases Binf
downwards by construction. `benchmarks/veil_anchor.py` says by how much.
"""

from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from swimm3r.medium import Medium, add_water, backscatter, remove_water, transmittances
from swimm3r.sfm.mast3r.network import Encoded, Mast3r
from swimm3r.sfm.mast3r.settings import ObjectiveSettings


@dataclass(frozen=True)
class PairFeatures:
    """Features of a batch of pairs at the levels where the student follows the teacher."""

    encoder: tuple[Float[Tensor, "b n c"], ...]  # normalized encoder output, one entry per view
    decoder: tuple[Float[Tensor, "b n d"], ...]  # one entry per view and level
    descriptors: tuple[Float[Tensor, "b h w k"], ...]  # unit vectors, one entry per view


@dataclass(frozen=True)
class LossTerms:
    """Every term before its weight, one number per pair; `total` weighs and adds them."""

    encoder: Float[Tensor, " b"]
    decoder: Float[Tensor, " b"]
    descriptors: Float[Tensor, " b"]
    forward: Float[Tensor, " b"]
    inverse: Float[Tensor, " b"]
    overshoot: Float[Tensor, " b"]  # first part of L_sat
    anchor: Float[Tensor, " b"]  # second part, without its 0.5
    known_water: Float[Tensor, " b"]  # 0 where no water was drawn
    clean: Float[Tensor, " b"]  # L_geom of the student on the clear images

    def total(self, s: ObjectiveSettings) -> Float[Tensor, " b"]:
        """L_SfM of each pair."""
        geometry = s.encoder * self.encoder + s.decoder * self.decoder + s.descriptors * self.descriptors
        saturation = self.overshoot + s.anchor * self.anchor
        physics = s.forward * self.forward + s.inverse * self.inverse + s.saturation * saturation
        return geometry + physics + s.known_water * self.known_water + s.clean * self.clean


@dataclass(frozen=True)
class PhysicsTerms:
    """The four terms that compare the water with a frame's images, one number per frame."""

    forward: Float[Tensor, " b"]
    inverse: Float[Tensor, " b"]
    overshoot: Float[Tensor, " b"]
    anchor: Float[Tensor, " b"]


def features(network: Mast3r, view1: Encoded, view2: Encoded, settings: ObjectiveSettings) -> PairFeatures:
    """The levels the objective asks for, of pairs in one direction; levels of weight 0 are not computed."""
    if not settings.decoder and not settings.descriptors:
        return PairFeatures((view1.tokens, view2.tokens), (), ())
    views = network.decode(view1, view2)
    levels = slice(-1, None) if settings.decoder_levels == "last" else slice(1, None)
    descriptors: tuple[Tensor, ...] = ()
    if settings.descriptors:
        descriptors = tuple(network.descriptors(v, which).descriptors for which, v in enumerate(views, start=1))
    decoder = tuple(t for v in views for t in v.tokens[levels]) if settings.decoder else ()
    return PairFeatures((view1.tokens, view2.tokens), decoder, descriptors)


def squared_distance(
    teacher: tuple[Float[Tensor, " b *_"], ...], student: tuple[Float[Tensor, " b *_"], ...], reduction: str
) -> Float[Tensor, " b"]:
    """|F - F~|^2 of one level, averaged over its views and blocks; nothing flows back into the teacher."""
    if not student:
        raise ValueError("there is no feature of this level to compare")
    parts = []
    for F, F_student in zip(teacher, student, strict=True):
        square = (F.detach().float() - F_student.float()).square()
        if reduction == "mean":
            parts.append(square.flatten(1).mean(1))
        elif reduction == "token":
            parts.append(square.sum(-1).flatten(1).mean(1))
        elif reduction == "sum":
            parts.append(square.flatten(1).sum(1))
        else:
            raise ValueError(f"a squared norm is reduced by mean, token or sum, got {reduction}")
    return torch.stack(parts).mean(0)


def forward_loss(
    I: Float[Tensor, "b h w 3"],
    J: Float[Tensor, "b h w 3"],
    ray_depth: Float[Tensor, "b h w"],
    valid: Bool[Tensor, "b h w"],
    medium: Medium,
) -> Float[Tensor, " b"]:
    """L_for: the clear image through the water against the raw one."""
    return _mean_over((add_water(J, ray_depth, medium) - I).abs().sum(-1), valid)


def inverse_loss(
    restored: Float[Tensor, "b h w 3"], J: Float[Tensor, "b h w 3"], valid: Bool[Tensor, "b h w"]
) -> Float[Tensor, " b"]:
    """L_inv: the restored image, not clamped, against the clear one."""
    return _mean_over((restored - J).abs().sum(-1), valid)


def overshoot_loss(restored: Float[Tensor, "b h w 3"], valid: Bool[Tensor, "b h w"]) -> Float[Tensor, " b"]:
    """First part of L_sat: how far restored values leave 0..1, squared."""
    above, below = (restored - 1).clamp(min=0), (-restored).clamp(min=0)
    return _mean_over((above.square() + below.square()).sum(-1), valid)


def dim_color(
    I: Float[Tensor, "b h w 3"], valid: Bool[Tensor, "b h w"], quantile: float = 0.05
) -> Float[Tensor, "b 3"]:
    """Q_0.05: per channel the value below which that share of a frame's valid pixels lies; 0 for a frame of none."""
    found = [
        torch.quantile(frame[usable].float(), quantile, dim=0) if bool(usable.any()) else frame.new_zeros(3)
        for frame, usable in zip(I, valid, strict=True)
    ]
    return torch.stack(found)


def anchor_loss(Binf: Float[Tensor, "b 3"], dim: Float[Tensor, "b 3"]) -> Float[Tensor, " b"]:
    """Second part of L_sat without its 0.5: the veiling light's distance to the dim pixels' color, squared."""
    return (Binf - dim).square().sum(-1)


def physics_terms(
    I: Float[Tensor, "b h w 3"],
    J: Float[Tensor, "b h w 3"],
    ray_depth: Float[Tensor, "b h w"],
    valid: Bool[Tensor, "b h w"],
    medium: Medium,
    settings: ObjectiveSettings,
) -> PhysicsTerms:
    """L_for, L_inv and the parts of L_sat of frames; ray depth and coefficients in one unit, pixel values as stored.

    Where `valid` is False nothing is read: depth and colors may be anything there, NaN included. A frame without any
    valid pixel contributes 0.
    """
    z = torch.where(valid, ray_depth, 0.0)
    I, J = (torch.where(valid[..., None], image, 0.0) for image in (I, J))
    restored = remove_water(I, z, medium, settings.min_transmittance)
    dim = dim_color(I, valid, settings.anchor_quantile)
    anchor = anchor_loss(medium.Binf[:, 0, 0], dim)
    return PhysicsTerms(
        forward=forward_loss(I, J, z, valid, medium),
        inverse=inverse_loss(restored, J, valid),
        overshoot=overshoot_loss(restored, valid),
        anchor=torch.where(valid.flatten(1).any(1), anchor, 0.0),
    )


def known_water_loss(
    ray_depth: Float[Tensor, "b h w"],
    valid: Bool[Tensor, "b h w"],
    medium: Medium,
    sampled_medium: Float[Tensor, "b 3 3"],
) -> Float[Tensor, " b"]:
    """L_wat: T_D and B against those of the water that was drawn (its Binf, beta_D, beta_B); 0 where that is NaN."""
    z = torch.where(valid, ray_depth, 0.0)
    known = sampled_medium.isfinite().flatten(1).all(1)
    true = Medium(*torch.where(known[:, None, None], sampled_medium, 0.0)[:, None, None].unbind(3))
    of_scene = transmittances(z, medium)[0] - transmittances(z, true)[0]
    of_water = backscatter(z, medium) - backscatter(z, true)
    return torch.where(known, _mean_over((of_scene.abs() + of_water.abs()).sum(-1), valid), 0.0)


def _mean_over(values: Float[Tensor, "b h w"], valid: Bool[Tensor, "b h w"]) -> Float[Tensor, " b"]:
    """1/N sum over the valid pixels of each frame; 0 where there are none."""
    count = valid.flatten(1).sum(1)
    return torch.where(valid, values, 0.0).flatten(1).sum(1) / count.clamp(min=1)
