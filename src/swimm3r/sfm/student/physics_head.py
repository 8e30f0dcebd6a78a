"""The water read from what the student's encoder makes of one raw frame.

    beta_D(z) = a e^{bz} + c e^{dz}      per pixel, a, c > 0 and b, d < 0 (Sea-Thru), evaluated at ray depth
    beta_B, Binf                         per frame, beta_B > 0, 0 < Binf < 1

A pooling that learns where to look sums the frame up and gives its six numbers. Every token gives the twelve of its
patch's curve, interpolated between patches, and knows that sum: one patch alone cannot tell a pale floor in dense water
from a dark one in thin water. Coefficients are 1/m, because the network's points are metres: z is |point|, and whoever
scales a scene scales the water with it (`WaterMaps.rescaled`).
"""

from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor, nn
from torch.nn import functional as F

from swimm3r.medium import AttenuationCurve, Medium
from swimm3r.sfm.mast3r.network import Encoded

# where training starts, in 1/m: clear coastal water, hardly changing with depth
_CURVE_START = (0.3, 0.05, 0.05, 0.5)  # a, -b, c, -d
_BETA_B_START = 0.2
_BINF_START = 0.35
_LOOKS = 4  # poolings of the tokens, each with weights of its own


@dataclass(frozen=True)
class WaterMaps:
    """The water of a batch of frames as the head reads it."""

    Binf: Float[Tensor, "b 3"]  # veiling light, (0, 1)
    beta_B: Float[Tensor, "b 3"]  # build-up of backscatter, 1/m
    curve: AttenuationCurve  # per pixel: fields of shape [b, h, w, 3]

    def at(self, ray_depth: Float[Tensor, "b h w"]) -> Medium:
        """The medium of every pixel at its ray depth, m: what `add_water` and `remove_water` take."""
        beta_D = self.curve.at(ray_depth)
        return Medium(self.Binf[:, None, None].expand_as(beta_D), beta_D, self.beta_B[:, None, None].expand_as(beta_D))

    def rescaled(self, scale: float) -> "WaterMaps":
        """The same water after every length of the scene was multiplied by `scale`."""
        if scale <= 0:
            raise ValueError(f"a scale is positive, got {scale}")
        c = self.curve
        curve = AttenuationCurve(c.a / scale, c.b / scale, c.c / scale, c.d / scale)
        return WaterMaps(self.Binf, self.beta_B / scale, curve)


@dataclass(frozen=True)
class HeadFacts:
    """Settings for the water of a trained head, stored beside its weights."""

    min_transmittance: float  # eps_inv of Eq. 4, as in its training
    error: Medium | None = None  # one relative standard error per coefficient and channel, [3]; None: never measured


class PhysicsHead(nn.Module):
    """Encoder tokens -> water; 193,366 parameters for tokens of 1024 channels."""

    def __init__(self, token_dim: int, patch: int = 16, hidden: int = 128) -> None:
        super().__init__()
        self.patch = patch
        self.norm = nn.LayerNorm(token_dim)
        self.shared = nn.Linear(token_dim, hidden)
        self.mixed = nn.Linear(hidden, hidden)
        self.attention = nn.Linear(hidden, _LOOKS)
        self.pooled = nn.Linear(_LOOKS * hidden, hidden // 2)
        self.context = nn.Linear(hidden // 2, hidden)
        self.curve = nn.Linear(hidden, 12)
        self.frame = nn.Linear(hidden // 2, 6)
        with torch.no_grad():
            for layer in (self.curve, self.frame):
                layer.weight.mul_(0.1)  # the start is the same water for every frame, nearly
            self.curve.bias.copy_(_inverse_softplus(torch.tensor(_CURVE_START)).repeat_interleave(3))
            self.frame.bias[:3] = torch.logit(torch.tensor(_BINF_START))
            self.frame.bias[3:] = _inverse_softplus(torch.tensor(_BETA_B_START))

    def forward(self, encoded: Encoded) -> WaterMaps:
        """The water of frames that were passed upright, in float32."""
        if encoded.portrait is not None:
            raise ValueError("the physics head reads upright frames; pass portrait ones as a batch of their own")
        height, width = encoded.height, encoded.width
        with torch.autocast(encoded.tokens.device.type, enabled=False):
            tokens = F.gelu(self.mixed(F.gelu(self.shared(self.norm(encoded.tokens.float())))))
            # the veil shows best where the scene is far, attenuation where it is near: every look learns whom to trust
            looks = self.attention(tokens).softmax(dim=1).mT @ tokens
            pooled = F.gelu(self.pooled(looks.flatten(1)))
            frame = self.frame(pooled)
            curves = self.curve(F.gelu(tokens + self.context(pooled)[:, None]))
            grid = curves.mT.unflatten(2, (height // self.patch, width // self.patch))
            maps = F.softplus(F.interpolate(grid, (height, width), mode="bilinear"))
            a, b, c, d = maps.permute(0, 2, 3, 1).split(3, dim=-1)
            return WaterMaps(
                Binf=torch.sigmoid(frame[:, :3]),
                beta_B=F.softplus(frame[:, 3:]),
                curve=AttenuationCurve(a, -b, c, -d),
            )


def ray_depth_of(points: Float[Tensor, "*pixels 3"]) -> Float[Tensor, "*pixels"]:
    """Ray depth, m, of points in the frame of their own camera: view 1's pointmap."""
    return torch.linalg.vector_norm(points, dim=-1)


def _inverse_softplus(y: Tensor) -> Tensor:
    return torch.log(torch.expm1(y))
