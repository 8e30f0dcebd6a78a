"""Rays of a camera in a housing: from its entrance pupil through air, the port's glass, and into the water.

Camera axes, meters, the pupil at the origin. At a surface with unit normal m that faces the light, a unit direction d
goes on by Snell's law (derivation: docs/derivations/refraction.md):

    d' = r d + (r c - sqrt(1 - r^2 (1 - c^2))) m,    r = n / n',  c = -m . d
"""

import math
from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor
from torch.nn.functional import normalize

from swimm3r.refraction.settings import HousingKind, PortSettings

AIR = 1.0  # refractive index


@dataclass(frozen=True)
class FlatPort:
    """A plane of glass, perpendicular to the optical axis."""

    distance: float  # m, from the pupil to the inner surface
    thickness: float  # m
    glass: float  # refractive index
    water: float


@dataclass(frozen=True)
class DomePort:
    """A part of a sphere of glass, its center on the optical axis."""

    distance: float  # m, from the pupil to the inner surface, along the axis
    thickness: float  # m
    radius: float  # m, of the inner surface
    glass: float  # refractive index
    water: float

    @property
    def center(self) -> float:
        """Place of the sphere's center on the optical axis, meters ahead of the pupil; 0 of a centered dome."""
        return self.distance - self.radius


Port = FlatPort | DomePort


@dataclass(frozen=True)
class WaterRays:
    """Rays where they leave the port."""

    start: Float[Tensor, "*rays 3"]  # m, on the outer surface
    direction: Float[Tensor, "*rays 3"]  # unit; NaN where the light is reflected totally or misses the port

    def at_depth(self, z: Float[Tensor, "*#rays"] | float) -> Float[Tensor, "*rays 3"]:
        """The rays' points at a z, in meters."""
        steps = (z - self.start[..., 2]) / self.direction[..., 2]
        return self.start + steps[..., None] * self.direction


def port_of(housing: HousingKind, settings: PortSettings) -> Port | None:
    """The port of a housing; None without one."""
    distance = settings.distance_of(housing)
    match housing:
        case "none":
            return None
        case "flat":
            return FlatPort(distance, settings.thickness, settings.glass, settings.water)
        case "dome":
            return DomePort(distance, settings.thickness, settings.radius, settings.glass, settings.water)


def refract(
    direction: Float[Tensor, "*rays 3"], normal: Float[Tensor, "*#rays 3"], before: float, after: float
) -> Float[Tensor, "*rays 3"]:
    """Unit directions behind a surface between media of two refractive indices; NaN at total reflection.

    `direction` and `normal` are unit vectors; on which side of the surface the normal stands does not matter.
    """
    ratio = before / after
    cosine = -(normal * direction).sum(-1, keepdim=True)
    facing = torch.where(cosine < 0, -normal, normal)
    cosine = cosine.abs()
    under_root = 1 - ratio**2 * (1 - cosine**2)
    root = torch.where(under_root >= 0, under_root, torch.nan).sqrt()
    return ratio * direction + (ratio * cosine - root) * facing


def through_port(rays: Float[Tensor, "*rays 3"], port: Port) -> WaterRays:
    """Rays of any length that leave the pupil, where they enter the water; the same backward, by reversibility."""
    inside = normalize(rays, dim=-1)
    match port:
        case FlatPort():
            normal = inside.new_tensor([0.0, 0.0, -1.0])
            glass = refract(inside, normal, AIR, port.glass)
            inner = inside * (port.distance / inside[..., 2:])
            outer = inner + glass * (port.thickness / glass[..., 2:])
            return WaterRays(outer, refract(glass, normal, port.glass, port.water))
        case DomePort():
            middle = inside.new_tensor([0.0, 0.0, port.center])
            inner = _on_sphere(torch.zeros_like(inside), inside, middle, port.radius)
            glass = refract(inside, (middle - inner) / port.radius, AIR, port.glass)
            outer = _on_sphere(inner, glass, middle, port.radius + port.thickness)
            normal = (middle - outer) / (port.radius + port.thickness)
            return WaterRays(outer, refract(glass, normal, port.glass, port.water))


def _on_sphere(
    start: Float[Tensor, "*rays 3"], direction: Float[Tensor, "*rays 3"], middle: Float[Tensor, "3"], radius: float
) -> Float[Tensor, "*rays 3"]:
    """The far intersections of rays with a sphere; NaN where they miss it."""
    offset = start - middle
    along = (offset * direction).sum(-1, keepdim=True)
    under_root = along**2 - (offset * offset).sum(-1, keepdim=True) + radius**2
    root = torch.where(under_root >= 0, under_root, torch.nan).sqrt()
    return start + (root - along) * direction


def magnification(port: Port) -> float:
    """Focal length in water by that in air, near the optical axis: the water's index behind a flat port.

    The paraxial ray of slope 1 at the pupil, height y and angle a, with the surfaces' powers P = (n' - n) / R:
    n' a' = n a - y P.
    """
    inner, outer = (0.0, 0.0) if isinstance(port, FlatPort) else (port.radius, port.radius + port.thickness)
    powers = [
        -(after - before) / radius if radius else 0.0
        for before, after, radius in ((AIR, port.glass, inner), (port.glass, port.water, outer))
    ]
    in_glass = (AIR - port.distance * powers[0]) / port.glass
    height = port.distance + port.thickness * in_glass
    in_water = (port.glass * in_glass - height * powers[1]) / port.water
    return 1 / in_water if in_water > 0 else math.inf
