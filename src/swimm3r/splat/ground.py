"""The plane that a dive's surface extends over, and windows on it: rectangles that hold every point above and below.

    (u, v) = ((x - origin) . across, (x - origin) . along)

The plane of a survey is the ground, that of a dive along a wall the wall. A window may be open to a side; neighbors
share an edge, which belongs to the one whose lower edge it is, so that windows which cut the plane cut space.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import torch
from jaxtyping import Bool, Float
from torch import Tensor

Pair = tuple[float, float]
Triple = tuple[float, float, float]


@dataclass(frozen=True)
class GroundPlane:
    """Two orthogonal unit directions of greatest extent, and the point that they are measured from."""

    origin: Triple
    across: Triple
    along: Triple

    def coordinates(self, xyz: Float[Tensor, "*n 3"]) -> Float[Tensor, "*n 2"]:
        """(u, v) of points, in their unit; float64."""
        axes = torch.tensor([self.across, self.along], dtype=torch.float64, device=xyz.device)
        return (xyz.double() - torch.tensor(self.origin, dtype=torch.float64, device=xyz.device)) @ axes.mT


@dataclass(frozen=True)
class Window:
    """A rectangle of the plane, in scene units."""

    plane: GroundPlane
    low: Pair = (-math.inf, -math.inf)
    high: Pair = (math.inf, math.inf)

    def holds(self, xyz: Float[Tensor, "*n 3"]) -> Bool[Tensor, "*n"]:
        """Mask of the points over the rectangle, its lower edges included."""
        return self.holds_coordinates(self.plane.coordinates(xyz))

    def holds_coordinates(self, uv: Float[Tensor, "*n 2"]) -> Bool[Tensor, "*n"]:
        """The same of (u, v)."""
        low, high = (torch.tensor(edge, dtype=torch.float64, device=uv.device) for edge in (self.low, self.high))
        return ((uv >= low) & (uv < high)).all(-1)

    def meets(self, other: "Window") -> bool:
        """Return whether the two overlap or touch."""
        return all(low <= high for low, high in zip((*self.low, *other.low), (*other.high, *self.high), strict=True))

    def widened(self, margin: float) -> "Window":
        """The rectangle with a margin on every side."""
        (u0, v0), (u1, v1) = self.low, self.high
        return replace(self, low=(u0 - margin, v0 - margin), high=(u1 + margin, v1 + margin))

    def halves(self, axis: int, at: float) -> "tuple[Window, Window]":
        """The parts before and behind a line across `axis`."""
        high, low = list(self.high), list(self.low)
        high[axis] = low[axis] = at
        return replace(self, high=(high[0], high[1])), replace(self, low=(low[0], low[1]))


def held_by_any(windows: Sequence[Window], xyz: Float[Tensor, "n 3"]) -> Bool[Tensor, " n"]:
    """Mask of the points over one of some windows."""
    held = torch.zeros(len(xyz), dtype=torch.bool, device=xyz.device)
    for window in windows:
        held |= window.holds(xyz)
    return held


def plane_of(xyz: Float[Tensor, "n 3"]) -> GroundPlane:
    """The plane through the points' mean in which they extend most. Its directions' signs are fixed."""
    points = xyz.double()
    origin = points.mean(0)
    _, axes = torch.linalg.eigh((points - origin).mT @ (points - origin))
    across, along = (_signed(axes[:, k]) for k in (2, 1))
    return GroundPlane(_triple(origin), _triple(across), _triple(along))


def _signed(direction: Float[Tensor, "3"]) -> Float[Tensor, "3"]:
    return direction * direction[direction.abs().argmax()].sign()


def _triple(values: Float[Tensor, "3"]) -> Triple:
    x, y, z = values.tolist()
    return x, y, z
