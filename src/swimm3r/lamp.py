"""Light of a lamp that the camera carries, in the camera's axes.

    L(X) = k S(d) (|X0 - p| / |X - p|)^q,    S(d) = exp(g . phi(d)),    phi = (dx, dy, 1 - dz, dx^2, dx dy, dy^2)

X is a point of the scene, p the lamp, d the unit direction from the lamp to X, and X0 the point on the optical axis at
the reference distance. In water the light is attenuated on its way, too: a surface shows J L exp(-beta_D (|X - p| + z))
at the ray depth z. Surfaces are taken to scatter alike to all sides, as nothing tells their slope, and to lie in no
shadow. The light that the water scatters back has a pattern over the image of its own, V(d) = exp(v . phi(d)), d being
the direction of the pixel. Light scattered once, at each point of a pixel's ray into the camera, is

    G(d, z) = integral over s = 0..z of L(s d) exp(-beta_D (|s d - p| + s)) ds

S holds exactly for beams of von Mises and Fisher's form, exp(kappa (d . a - 1)), whatever their axis a. J and k are
known only as a product: an image does not tell a bright lamp from bright ground.
"""

from dataclasses import dataclass, replace
from functools import lru_cache
from typing import Literal

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

Light = Literal["sun", "lamp"]
TERMS = 6
"""Number of terms of a pattern."""
INVERSE_SQUARE = 2.0
"""q in linear light."""
STORED = 2.2
"""Exponent between linear light and values as stored: there q is 2 / 2.2."""
NODES, FEW_NODES = 48, 16
"""Nodes of the integral along a ray: within 3e-4 of its limit, and within 0.01."""
FAR = 20.0
"""Reference distances in the place of infinity."""


@dataclass(frozen=True)
class Lamp:
    """A lamp in a camera's axes; lengths are in the scene's unit."""

    position: Float[Tensor, "3"]  # p, seen from the camera's center
    reference: float  # distance of X0
    fall_off: float  # q, on the values that the light acts on
    strength: float  # k
    beam: Float[Tensor, "6"]  # g
    veil: Float[Tensor, "6"]  # v


@dataclass(frozen=True)
class LightEvidence:
    """The decision between sun and lamp, with its figures."""

    light: Light
    explained: float  # share of the variance of points' light that places in the image explain beyond distance
    change: float  # standard deviation of its logarithm over the images
    points: int
    fall_off: float | None = None  # power of the distance that the light falls with, of the median channel
    fall_off_std: float | None = None  # its standard error; None in runs before 30 November 2026


def pattern(direction: Float[Tensor, "*points 3"], coefficients: Float[Tensor, "6"]) -> Float[Tensor, "*points"]:
    """Logarithm of a smooth gain over unit directions; 0 on the optical axis."""
    return pattern_terms(direction) @ coefficients.to(direction)


def pattern_terms(direction: Float[Tensor, "*points 3"]) -> Float[Tensor, "*points 6"]:
    """phi over unit directions."""
    x, y, z = direction.unbind(-1)
    return torch.stack([x, y, 1 - z, x * x, x * y, y * y], -1)


def log_light(points: Float[Tensor, "*points 3"], lamp: Lamp) -> Float[Tensor, "*points"]:
    """ln L of points in the camera's axes, without the water's share."""
    away = points - lamp.position.to(points)
    distance = away.norm(dim=-1).clamp(min=1e-6 * lamp.reference)
    origin = torch.tensor([0.0, 0.0, lamp.reference]).to(points) - lamp.position.to(points)
    beam = pattern(away / distance[..., None], lamp.beam)
    return beam + lamp.fall_off * (origin.norm() / distance).log() + torch.tensor(lamp.strength).log().to(points)


def lamp_distance(points: Float[Tensor, "*points 3"], lamp: Lamp) -> Float[Tensor, "*points"]:
    """Length of the way from the lamp to points in the camera's axes."""
    return (points - lamp.position.to(points)).norm(dim=-1)


def veil_pattern(direction: Float[Tensor, "*points 3"], lamp: Lamp) -> Float[Tensor, "*points"]:
    """V of the pixels' unit directions: their share of the backscatter on the optical axis."""
    return pattern(direction, lamp.veil).exp()


def scattered(
    direction: Float[Tensor, "*pixels 3"],
    ray_depth: Float[Tensor, "*pixels"],
    lamp: Lamp,
    beta_D: Float[Tensor, " c"],
    nodes: int = NODES,
) -> Float[Tensor, "*pixels c"]:
    """G along unit directions, by Gauss and Legendre's rule on s = z t^3, whose nodes are dense near the camera."""
    beta = beta_D.to(direction)
    total = torch.zeros(*ray_depth.shape, len(beta_D)).to(direction)
    for share, step in zip(*nodes_along(nodes), strict=True):
        s = ray_depth * share
        points = s[..., None] * direction
        path = (lamp_distance(points, lamp) + s)[..., None]
        total += (log_light(points, lamp)[..., None] - beta * path).exp() * (step * ray_depth)[..., None]
    return total


@lru_cache
def nodes_along(nodes: int) -> tuple[Float[np.ndarray, " nodes"], Float[np.ndarray, " nodes"]]:
    """s / z and ds / z at the nodes of the rule along a ray."""
    at, weights = np.polynomial.legendre.leggauss(nodes)
    t = (at + 1) / 2
    return t**3, 3 * weights / 2 * t**2


def share_scattered(
    direction: Float[Tensor, "*pixels 3"], ray_depth: Float[Tensor, "*pixels"], lamp: Lamp, beta_D: Float[Tensor, " c"]
) -> Float[Tensor, "*pixels c"]:
    """G(d, z) / G(axis, infinity): the share of the open water's light that the water before a surface sends."""
    far = FAR * lamp.reference
    ahead = torch.tensor([0.0, 0.0, 1.0]).to(direction)
    whole = scattered(ahead, torch.tensor(far).to(direction), lamp, beta_D)
    return scattered(direction, ray_depth.clamp(max=far), lamp, beta_D, FEW_NODES) / whole


def rescaled_lamp(lamp: Lamp, scale: float) -> Lamp:
    """The same lamp after every length was multiplied by `scale`."""
    return replace(lamp, position=lamp.position * scale, reference=lamp.reference * scale)


def lamp_document(lamp: Lamp) -> dict[str, float | list[float]]:
    """Plain numbers of a lamp, for files."""
    return {name: value.tolist() if isinstance(value, Tensor) else value for name, value in vars(lamp).items()}
