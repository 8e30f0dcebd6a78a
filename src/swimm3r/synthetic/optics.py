"""The lens of a synthetic dive, in air or behind a port, the exact ray of every pixel, and a shutter that rolls.

A ray is the line (x0, y0, 0) + z (x, y, 1) in camera axes, so that its parameter is the z depth. Behind a port the
camera is the central one of `swimm3r.refraction.central`: the rays do not meet in it, and their z depth counts from it.
"""

from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Float
from scipy.spatial.transform import Rotation
from torch import Tensor

from swimm3r.cameras import Cameras, directions, pixel_grid, resized
from swimm3r.errors import UsageError
from swimm3r.refraction.central import CameraInWater, camera_in_water
from swimm3r.refraction.ports import port_of, through_port
from swimm3r.synthetic.settings import DiveSettings


@dataclass(frozen=True)
class PixelRays:
    """Rays of the pixels of an image, float64, camera axes, meters."""

    start: Float[Tensor, "h w 2"]  # x and y at z = 0; all 0 of a central camera
    direction: Float[Tensor, "h w 3"]  # with z = 1
    wet: Float[Tensor, "h w"]  # z from which on the ray is in water

    def water_path(self, z_depth: Float[Tensor, "h w"]) -> Float[Tensor, "h w"]:
        """Meters of water before surfaces at a z depth; 0 where that is 0."""
        length = (z_depth - self.wet) * torch.linalg.vector_norm(self.direction, dim=-1)
        return torch.where(z_depth > 0, length, 0.0).float()


def lens_of(settings: DiveSettings) -> Cameras:
    """The lens in air, its principal point in the middle: a pinhole, or an equidistant fisheye (r = f theta)."""
    width, height = settings.width, settings.height
    half = np.radians(settings.fov) / 2
    fisheye = settings.fisheye
    focal = np.hypot(width, height) / 2 / half if fisheye else width / 2 / np.tan(half)
    tall = focal * settings.squeeze
    K = torch.tensor([[[focal, 0, width / 2], [0, tall, height / 2], [0, 0, 1]]], dtype=torch.float64)
    distortion = torch.zeros(1, 4 if fisheye else 0, dtype=torch.float64)
    model = "OPENCV_FISHEYE" if fisheye else "PINHOLE"
    return Cameras(K, distortion, torch.eye(4, dtype=torch.float64)[None], width, height, model)


def behind_port(settings: DiveSettings) -> CameraInWater | None:
    """The lens behind the dive's port; None without one. Raises UsageError where rays miss the port."""
    port = port_of(settings.housing, settings.port)
    if port is None:
        return None
    lens = lens_of(settings)
    corners = torch.tensor([[0.0, 0], [lens.width, 0], [0, lens.height], [lens.width, lens.height]]).double()
    if not bool(through_port(directions(lens, corners[None])[0], port).direction.isfinite().all()):
        raise UsageError(
            "rays of the lens miss the port",
            cause="the dome is small or far ahead of the lens, or the field of view is wide",
            hint="a larger port.radius, a smaller port.distance, or a smaller fov",
        )
    return camera_in_water(lens, port, settings.port.range)


def rays_of(lens: Cameras, housed: CameraInWater | None, factor: int = 1) -> PixelRays:
    """The rays of an image of `factor` times the lens's pixels along each side."""
    air = housed.lens if housed else lens
    air = resized(air, factor * lens.width, factor * lens.height)
    grid = pixel_grid(air.height, air.width).double().reshape(1, -1, 2)
    inside = directions(air, grid).reshape(air.height, air.width, 3)
    if housed is None:
        zero = torch.zeros(inside.shape[:2], dtype=torch.float64)
        return PixelRays(torch.stack([zero, zero], -1), inside, zero)
    seen = through_port(inside, housed.port)
    direction = seen.direction / seen.direction[..., 2:]
    return PixelRays(seen.at_depth(housed.center)[..., :2], direction, seen.start[..., 2] - housed.center)


def rolled(rays: PixelRays, motion: Float[np.ndarray, "6"]) -> PixelRays:
    """The rays of an image whose rows are exposed one after another, in the axes of the camera at half time.

    `motion` is that of the camera between the exposures of the first and the last row, even over that time: a rotation
    vector and a translation (meters) in its axes at half time.
    """
    rows = len(rays.direction)
    share = (np.arange(rows) + 0.5) / rows - 0.5
    R = torch.from_numpy(Rotation.from_rotvec(share[:, None] * motion[:3]).as_matrix())
    t = torch.from_numpy(share[:, None] * motion[3:])
    start = torch.cat([rays.start, torch.zeros_like(rays.start[..., :1])], -1)
    direction = torch.einsum("hij,hwj->hwi", R, rays.direction)
    start = torch.einsum("hij,hwj->hwi", R, start) + t[:, None]
    wet = start[..., 2] + rays.wet * direction[..., 2]
    unit = direction / direction[..., 2:]
    return PixelRays((start - start[..., 2:] * unit)[..., :2], unit, wet)
