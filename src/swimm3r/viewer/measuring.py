"""Lengths and areas on the surface that the map shows, between points that the user clicks.

A clicked point lies at the map's depth along its ray. The same point seen from the nearest frames has other depths by a
little; their spread is the standard deviation that a length carries. It says how well the map's views agree, not how
well the scale of a metric run is known.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from swimm3r.cameras import Cameras, inside_image, project, unproject
from swimm3r.rounding import rounded
from swimm3r.viewer.layers import LayerChoice, Painter, ViewCamera

_VIEWS = 4  # nearest frames that a point is looked at from
_WINDOW = 5  # pixels of the views for one point
_SIDE = 640  # pixels of the view that the window is cut from
_OCCLUDED = 0.1  # of the distance: a depth that differs by more is of another surface


@dataclass(frozen=True)
class SurfacePoint:
    """A clicked point, scene units, and how far it moves along its ray between views of the map."""

    xyz: Float[np.ndarray, "3"]
    ray: Float[np.ndarray, "3"]  # of unit length, from the camera to the point
    std: float | None  # along the ray; None where fewer than two frames see the point


@dataclass(frozen=True)
class Measured:
    """A number with its standard deviation where that is known, scene units."""

    value: float
    std: float | None


def surface_point(
    painter: Painter, view: ViewCamera, at: tuple[float, float], choice: LayerChoice
) -> SurfacePoint | None:
    """The surface under a point of the picture (0..1 from the left and from the top); None where nothing is there."""
    camera = view.at(_SIDE)
    pixel = torch.tensor([at[0] * camera.width, at[1] * camera.height], dtype=torch.float64)
    z_depth = _depth_at(painter, camera, pixel, choice)
    if z_depth is None:
        return None
    xyz = unproject(camera, pixel[None, None], torch.tensor([[z_depth]], dtype=torch.float64))[0, 0]
    away = xyz - camera.cam2world[0, :3, 3]
    return SurfacePoint(xyz.numpy(), (away / away.norm()).numpy(), _spread(painter, xyz, choice))


def cloud_point(
    xyz: Float[np.ndarray, "n 3"], origin: Float[np.ndarray, "3"], ray: Float[np.ndarray, "3"], reach: float = 0.02
) -> SurfacePoint | None:
    """The nearest point of a cloud within `reach` (a tangent) of a ray, for runs without a map."""
    away = xyz - origin
    along = away @ ray
    beside = np.linalg.norm(away - along[:, None] * ray, axis=1)
    near = (along > 0) & (beside < reach * along)
    if not near.any():
        return None
    first = np.flatnonzero(near)[along[near].argmin()]
    return SurfacePoint(xyz[first], ray, None)


def length(points: Sequence[SurfacePoint]) -> Measured:
    """The length of the line through points, one after another."""
    total, variance, known = 0.0, 0.0, True
    for a, b in pairwise(points):
        between = b.xyz - a.xyz
        distance = float(np.linalg.norm(between))
        total += distance
        if a.std is None or b.std is None:
            known = False
        elif distance > 0:
            towards = between / distance
            variance += (float(a.ray @ towards) * a.std) ** 2 + (float(b.ray @ towards) * b.std) ** 2
    return Measured(total, variance**0.5 if known else None)


def area(points: Sequence[SurfacePoint]) -> Measured:
    """The area of the polygon through three or more points, by its vector area; its own plane is the one that fits."""
    xyz = np.stack([point.xyz for point in points])
    value = float(np.linalg.norm(_vector_area(xyz)))
    if any(point.std is None for point in points):
        return Measured(value, None)
    variance = 0.0
    for i, point in enumerate(points):
        moved = xyz.copy()
        assert point.std is not None
        moved[i] += point.ray * point.std
        variance += (float(np.linalg.norm(_vector_area(moved))) - value) ** 2
    return Measured(value, variance**0.5)


def told(measured: Measured, unit: str) -> str:
    """A number as people write it, with the digits that its spread leaves: 1.243 ± 0.018 m."""
    if not measured.std:
        return f"{rounded(measured.value, 3)} {unit}"
    digits = max(0, 1 - math.floor(math.log10(measured.std)))
    return f"{measured.value:.{digits}f} ± {measured.std:.{digits}f} {unit}"


def _vector_area(xyz: Float[np.ndarray, "n 3"]) -> Float[np.ndarray, "3"]:
    relative = xyz - xyz[0]
    return np.cross(relative[1:-1], relative[2:]).sum(0) / 2


def _depth_at(painter: Painter, camera: Cameras, pixel: Float[Tensor, "2"], choice: LayerChoice) -> float | None:
    """Median z depth of the map in a small window around a pixel, of which no more than that is drawn."""
    K = camera.K.clone()
    K[0, :2, 2] += _WINDOW / 2 - pixel
    window = Cameras(K, camera.distortion, camera.cam2world, _WINDOW, _WINDOW)
    z_depth = painter.z_depth(window, choice)
    known = z_depth[z_depth > 0]
    return float(known.median()) if len(known) else None


def _spread(painter: Painter, xyz: Float[Tensor, "3"], choice: LayerChoice) -> float | None:
    """Standard deviation of a point's distance as the nearest frames that see it have it."""
    cameras = painter.run.cameras.pinhole(_SIDE)
    pixels, z = project(cameras, xyz.expand(len(cameras), 1, 3))
    away = torch.linalg.vector_norm(cameras.centers - xyz, dim=-1)
    visible = (z[:, 0] > 0) & inside_image(pixels[:, 0], cameras.width, cameras.height)
    off = []
    for i in away.argsort().tolist():
        if not visible[i] or len(off) == _VIEWS:
            continue
        found = _depth_at(painter, cameras[i], pixels[i, 0], choice)
        if found is not None and abs(found / float(z[i, 0]) - 1) < _OCCLUDED:
            off.append((found / float(z[i, 0]) - 1) * float(away[i]))
    return float(np.std(off, ddof=1)) if len(off) > 1 else None
