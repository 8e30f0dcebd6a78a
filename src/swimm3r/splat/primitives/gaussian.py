"""3D Gaussians with colors in spherical harmonics, the primitives of the peers (Kerbl et al. 2023).

    alpha = min(0.999, o exp(-r2 / 2)),   Sigma = R(q) diag(s^2) R(q)^T,   c = max(0, 1/2 + sum_lm k_lm Y_lm(d))

with d the unit direction camera -> primitive in world axes. Stored values are before activation: opacity = sigmoid,
s = exp, q (wxyz) of any length.
"""

import math
from typing import NamedTuple

import torch
from jaxtyping import Float
from torch import Tensor
from torch.nn.functional import normalize

from swimm3r.geometry import rotation_from_quaternion
from swimm3r.scene.reconstruction import Reconstruction
from swimm3r.splat.gaussian_settings import GaussianInitialSettings
from swimm3r.splat.primitives.spherical_harmonics import Y_00, spherical_harmonics
from swimm3r.splat.primitives.start import starting_points


class GaussianPrimitives(NamedTuple):
    """n Gaussians with h = (degree + 1)^2 harmonics, as trained; float32."""

    xyz: Float[Tensor, "n 3"]  # world
    quaternion: Float[Tensor, "n 4"]
    scale: Float[Tensor, "n 3"]  # logarithms
    opacity: Float[Tensor, " n"]
    color: Float[Tensor, "n 3"]  # k_00
    harmonics: Float[Tensor, "n h 3"]  # the others, by degree: none, 3, 8 or 15
    footprint: Float[Tensor, " n"]  # not trained: finest training pixel there, world units; 0 of maps without filter

    @property
    def dynamic(self) -> bool:
        """Return whether they change with time."""
        return False

    def to(self, device: torch.device) -> "GaussianPrimitives":
        """The same on a device."""
        return GaussianPrimitives(*(values.to(device) for values in self))


def rescaled(p: GaussianPrimitives, factor: float) -> GaussianPrimitives:
    """The same Gaussians after every length was multiplied by `factor`."""
    return p._replace(xyz=p.xyz * factor, scale=p.scale + math.log(factor), footprint=p.footprint * factor)


def harmonics_of_degree(degree: int) -> int:
    """Number of harmonics above the constant one."""
    return (degree + 1) ** 2 - 1


def to_degree(p: GaussianPrimitives, degree: int) -> GaussianPrimitives:
    """The Gaussians with the harmonics up to a degree alone."""
    return p._replace(harmonics=p.harmonics[:, : harmonics_of_degree(degree)])


def shape_factor(p: GaussianPrimitives) -> Float[Tensor, "n 3 3"]:
    """R diag(s): its product with its transpose is the covariance."""
    return rotation_from_quaternion(p.quaternion) * p.scale.exp()[:, None]


def covariance(p: GaussianPrimitives) -> Float[Tensor, "n 3 3"]:
    """Sigma."""
    factor = shape_factor(p)
    return factor @ factor.mT


def colored(
    mean: Float[Tensor, "n 3"], harmonics: Float[Tensor, "n h 3"], rays: Float[Tensor, "n 3"]
) -> Float[Tensor, "n 3"]:
    """Colors along rays of any length, of the mean color and the harmonics from degree 1 on; none is negative."""
    if harmonics.shape[1]:
        Y = spherical_harmonics(normalize(rays, dim=-1))[:, 1 : 1 + harmonics.shape[1]]
        mean = mean + torch.einsum("nh,nhc->nc", Y, harmonics)
    return mean.clamp(min=0)


def mean_color(p: GaussianPrimitives) -> Float[Tensor, "n 3"]:
    """Colors averaged over all directions, before what is negative is cut."""
    return 0.5 + Y_00 * p.color


def seen_color(p: GaussianPrimitives, center: Float[Tensor, "3"]) -> Float[Tensor, "n 3"]:
    """Colors as a camera at `center` sees them."""
    return colored(mean_color(p), p.harmonics, p.xyz - center)


def initial_gaussians(
    rec: Reconstruction, settings: GaussianInitialSettings, rng: torch.Generator
) -> GaussianPrimitives:
    """Gaussians on the cloud that every recipe starts from, round and of one color from all sides.

    Raises InputError for fewer than 4 points.
    """
    start = starting_points(rec, settings)
    n = len(start.xyz)
    return GaussianPrimitives(
        xyz=start.xyz.float(),
        quaternion=torch.randn(n, 4, generator=rng),
        scale=(settings.scale * start.spacing).log().float()[:, None].repeat(1, 3),
        opacity=torch.full((n,), settings.opacity).logit(),
        color=(start.rgb - 0.5) / Y_00,
        harmonics=torch.zeros(n, harmonics_of_degree(settings.harmonics), 3),
        footprint=torch.zeros(n),
    )
