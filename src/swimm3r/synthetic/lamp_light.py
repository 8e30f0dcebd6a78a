"""Truth of a dive lit by a lamp on the camera: light on the scene, and the light that the water scatters back.

    raw = J L exp(-beta_D (|X - p| + z)) + B,    B = Binf G(d, z) / G(axis, infinity)

with L, p and G, the light scattered once, of `swimm3r.lamp`, on values as stored as in all of the dive. Binf is the
open water's color on the optical axis.
"""

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor
from torch.nn.functional import normalize

from swimm3r.lamp import STORED, Lamp, lamp_distance, log_light, scattered
from swimm3r.medium import Medium
from swimm3r.synthetic.settings import LampSettings

_FAR = 60.0  # m, in the place of infinity


def lamp_of(settings: LampSettings) -> Lamp:
    """The lamp of a dive, its axis parallel to the camera's; without its own pattern of backscatter."""
    sharpness = np.log(2) / (1 - np.cos(np.radians(settings.beam) / 2)) / STORED
    beam = torch.zeros(6)
    beam[2] = -sharpness
    return Lamp(
        torch.tensor(settings.position), settings.reference, settings.fall_off, settings.strength, beam, torch.zeros(6)
    )


def light_on(
    rays: Float[Tensor, "h w 3"], ray_depth: Float[Tensor, "h w"], lamp: Lamp, medium: Medium
) -> Float[Tensor, "h w 3"]:
    """Light of the lamp on the surfaces of an image, through the water before them; `rays` have z = 1."""
    points = normalize(rays, dim=-1) * ray_depth[..., None]
    way = lamp_distance(points, lamp)[..., None]
    return (log_light(points, lamp)[..., None] - medium.beta_D.to(way) * way).exp()


def lamp_backscatter(
    rays: Float[Tensor, "h w 3"], ray_depth: Float[Tensor, "h w"], lamp: Lamp, medium: Medium
) -> Float[Tensor, "h w 3"]:
    """Backscatter of the lamp before surfaces at a ray depth; open water where that is 0."""
    far = torch.where(ray_depth > 0, ray_depth, _FAR)
    axis = torch.tensor([[[0.0, 0.0, 1.0]]]).to(rays)
    whole = scattered(axis, torch.full((1, 1), _FAR).to(rays), lamp, medium.beta_D)
    return medium.Binf * scattered(normalize(rays, dim=-1), far, lamp, medium.beta_D) / whole
