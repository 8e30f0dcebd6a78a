"""Colors of Gaussians that change with the camera (3D-UIR, Yuan et al. 2025).

    e_j = MLP(gamma(R_j, t_j)),   f_i = (sin 2^m pi p_i, cos 2^m pi p_i), m = 1..4
    (gamma_i - 1, beta_i) = F_theta(c_i, f_i, e_j),   c_ij = gamma_i c_i(d) + beta_i

with c_i the Gaussian's mean color and c_i(d) that along the ray, per channel. e_j is a function of the pose, so that
cameras that no training image has have colors, too. Positions are brought to -1..1 by the box of the first Gaussians.
The last layer is zero at first: colors begin as they are.
"""

import math

import torch
from jaxtyping import Float
from torch import Tensor, nn

from swimm3r.splat.gaussian_settings import AffineColorSettings
from swimm3r.splat.projection.view_camera import ViewCamera

_POSE = 12  # numbers of a rotation and a position


class AffineColors(nn.Module):
    """The two networks, and the box that positions are brought to."""

    middle: Tensor  # of the box, working units
    extent: Tensor  # longest half side of the box, working units

    def __init__(self, settings: AffineColorSettings) -> None:
        super().__init__()
        self.octaves, self.pose_octaves = settings.octaves, settings.pose_octaves
        hidden, embedding = settings.hidden, settings.embedding
        self.pose = _mlp(_POSE * (1 + 2 * settings.pose_octaves), hidden, embedding)
        self.color = _mlp(3 + 6 * settings.octaves + embedding, hidden, 6)
        self.register_buffer("middle", torch.zeros(3))
        self.register_buffer("extent", torch.ones(()))

    def embedding(self, view: ViewCamera, length: Tensor) -> Float[Tensor, " e"]:
        """e_j of a camera, whose unit is 1 / `length` working units; without gradient to the pose.

        gamma appends to each number sine and cosine of its octaves 2^0 pi..: colors place no camera.
        """
        with torch.no_grad():
            place = (view.center / length - self.middle) / self.extent
            pose = torch.cat([view.R.flatten(), place]).to(self.middle)
            features = torch.cat([pose, fourier(pose, self.pose_octaves, 0)])
        return self.pose(features)

    def affine(
        self, xyz: Float[Tensor, "n 3"], mean: Float[Tensor, "n 3"], view: ViewCamera, length: Tensor
    ) -> tuple[Float[Tensor, "n 3"], Float[Tensor, "n 3"]]:
        """gamma_i and beta_i of Gaussians with mean colors before a camera; positions get no gradient."""
        place = (xyz.detach() / length - self.middle) / self.extent
        f = fourier(place, self.octaves, 1)
        e = self.embedding(view, length).expand(len(xyz), -1)
        gain, offset = self.color(torch.cat([mean, f, e], -1)).split(3, -1)
        return 1 + gain, offset

    def fit_box(self, xyz: Float[Tensor, "n 3"]) -> None:
        """Take the box of some positions, working units."""
        low, high = xyz.amin(0), xyz.amax(0)
        self.middle.copy_((low + high) / 2)
        self.extent.copy_(((high - low) / 2).amax().clamp(min=1e-6))


def fourier(x: Float[Tensor, "*n k"], octaves: int, first: int) -> Float[Tensor, "*n f"]:
    """Sines, then cosines, of 2^m pi x for m from `first` on."""
    frequencies = math.pi * 2.0 ** torch.arange(first, first + octaves, device=x.device, dtype=x.dtype)
    angles = (x[..., None] * frequencies).flatten(-2)
    return torch.cat([angles.sin(), angles.cos()], -1)


def _mlp(inputs: int, hidden: int, outputs: int) -> nn.Sequential:
    return nn.Sequential(
        nn.Linear(inputs, hidden), nn.ReLU(), nn.Linear(hidden, hidden), nn.ReLU(), nn.Linear(hidden, outputs)
    )
