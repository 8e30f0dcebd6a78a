"""SeaSplat's water (Yang et al. 2024): one set of coefficients for a scene, applied to the finished clear image.

    I = clamp(J e^{-a d} + Binf (1 - e^{-b d}), 0, 1),   a, b >= 0

J is the clear composite over black, d the expected z depth, brought to 0..1 by its least and largest value in the
image: a and b have no unit, and mean another coefficient per metre in every image.
"""

from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor, nn
from torch.nn.functional import relu

from swimm3r.raster import RasterOutput

_SEEN = 1e-3  # alpha below which a pixel has no depth
_ATTENUATION = (1.1, 0.95, 0.95)
_VEIL = (0.05, 0.25, 0.8)
_FLAT = 1e-6  # of the largest depth: the least range of depths that is stretched to 0..1


class SceneWater(nn.Module):
    """a, b, and the logits of Binf, which stands for the background before there is water."""

    def __init__(self) -> None:
        super().__init__()
        self.attenuation = nn.Parameter(torch.tensor(_ATTENUATION))
        self.backscatter = nn.Parameter(torch.full((3,), 0.5))
        self.veil = nn.Parameter(torch.tensor(_VEIL).logit())

    @property
    def Binf(self) -> Float[Tensor, "3"]:
        """The color of the open water, 0..1."""
        return torch.sigmoid(self.veil)


def initial_scene_water(rng: torch.Generator) -> SceneWater:
    """Water before the first step; the backscatter is drawn."""
    water = SceneWater()
    with torch.no_grad():
        water.backscatter.uniform_(0, 1, generator=rng)
    return water


@dataclass(frozen=True)
class WaterLayer:
    """The effect of the water on one image."""

    depth: Float[Tensor, "h w"]  # 0..1 over the image; the farthest where nothing is seen
    transmittance: Float[Tensor, "3 h w"]  # e^{-a d}
    backscatter: Float[Tensor, "3 h w"]  # Binf (1 - e^{-b d})


def relative_depth(images: RasterOutput) -> Float[Tensor, "h w"]:
    """Expected z depth, its range in the image stretched to 0..1; 1 where nothing is seen."""
    seen = images.alpha > _SEEN
    z = images.z_depth / torch.where(seen, images.alpha, 1.0)
    if not bool(seen.any()):
        return torch.ones_like(z)
    far = z[seen].max()
    z = torch.where(seen, z, far)
    near = z.min()
    return (z - near) / (far - near).clamp(min=_FLAT * float(far.detach()))


def layer(water: SceneWater, depth: Float[Tensor, "h w"]) -> WaterLayer:
    """The water over an image of relative depth."""
    a, b, Binf = (v[:, None, None] for v in (relu(water.attenuation), relu(water.backscatter), water.Binf))
    return WaterLayer(depth, torch.exp(-a * depth), Binf * (1 - torch.exp(-b * depth)))


def seen_through(clear: Float[Tensor, "3 h w"], over: WaterLayer) -> Float[Tensor, "3 h w"]:
    """I of a clear image."""
    return (clear * over.transmittance + over.backscatter).clamp(0, 1)
