"""One image of the seafloor through clear water: exact depth along every pixel's ray, averaged radiance."""

from typing import no_type_check

import numba
import numpy as np

from swimm3r.synthetic.appearance import radiance
from swimm3r.synthetic.optics import PixelRays
from swimm3r.synthetic.raycast import cast
from swimm3r.synthetic.seafloor import Seafloor

SAMPLES = 2  # per pixel and axis


def render(
    floor: Seafloor, pose: np.ndarray, centers: PixelRays, samples: PixelRays, time: float, caustics: float
) -> tuple[np.ndarray, np.ndarray]:
    """Linear radiance [h, w, 3] and z depth [h, w] (metres, 0 where the ray meets nothing) from a camera.

    Depth is that of the rays of pixel centers, [h, w]; colors are means over those of the samples, [2h, 2w].
    """
    s = floor.surface
    corner = np.array([s.x0, s.y0, 0.0])
    return _render(
        s.height, s.pyramid, s.cell, corner, floor.shade, floor.animals, floor.owner, pose, centers.start.numpy(),
        centers.direction.numpy(), samples.start.numpy(), samples.direction.numpy(), time, caustics,
        floor.seed * 1000 + 17,
    )  # fmt: skip


@numba.njit(cache=True)
@no_type_check
def _into_world(R, place, start, ray, origin, direction):
    """Fill in a ray of the camera's axes as the world has it, from its place at z = 0."""
    for axis in range(3):
        origin[axis] = place[axis] + R[axis, 0] * start[0] + R[axis, 1] * start[1]
        direction[axis] = R[axis, 0] * ray[0] + R[axis, 1] * ray[1] + R[axis, 2] * ray[2]


@numba.njit(cache=True)
@no_type_check
def _render(
    height, pyramid, cell, corner, shade, animals, owner, pose, center_starts, center_rays, sample_starts, sample_rays,
    time, caustics, seed,
):  # fmt: skip
    rows, columns = center_rays.shape[:2]
    R = np.ascontiguousarray(pose[:3, :3])
    place = pose[:3, 3] - corner
    z_depth = np.zeros((rows, columns))
    color = np.zeros((rows, columns, 3))
    origin, direction = np.empty(3), np.empty(3)
    p = np.empty(3)
    pixel = np.hypot(
        center_rays[rows // 2, columns // 2, 0] - center_rays[rows // 2, columns // 2 - 1, 0],
        center_rays[rows // 2, columns // 2, 1] - center_rays[rows // 2, columns // 2 - 1, 1],
    )
    for row in range(rows):
        for column in range(columns):
            _into_world(R, place, center_starts[row, column], center_rays[row, column], origin, direction)
            z_depth[row, column] = max(cast(height, pyramid, cell, origin, direction, 0.0), 0.0)
    for row in range(rows):
        for column in range(columns):
            if z_depth[row, column] == 0:
                continue
            # what a sample can see lies hardly before all that is seen around it: a good place to start
            start = z_depth[row, column]
            for j in range(max(row - 1, 0), min(row + 2, rows)):
                for i in range(max(column - 1, 0), min(column + 2, columns)):
                    if z_depth[j, i] > 0:
                        start = min(start, z_depth[j, i])
            start *= 0.95
            hits = 0
            for sample in range(SAMPLES * SAMPLES):
                at = SAMPLES * row + sample // SAMPLES, SAMPLES * column + sample % SAMPLES
                _into_world(R, place, sample_starts[at], sample_rays[at], origin, direction)
                t = cast(height, pyramid, cell, origin, direction, start)
                if t < 0:
                    continue
                hits += 1
                length = np.sqrt(direction[0] ** 2 + direction[1] ** 2 + direction[2] ** 2)
                for axis in range(3):
                    p[axis] = corner[axis] + origin[axis] + t * direction[axis]
                i = min(max(int((p[0] - corner[0]) / cell), 0), shade.shape[1] - 1)
                j = min(max(int((p[1] - corner[1]) / cell), 0), shade.shape[0] - 1)
                sx, sy = shade[j, i, 0], shade[j, i, 1]
                facing = (sx * direction[0] + sy * direction[1] - direction[2]) / (
                    length * np.sqrt(1 + sx * sx + sy * sy)
                )
                footprint = pixel * t / np.sqrt(max(facing, 0.12))
                radiance(shade, animals, owner, corner, cell, p, footprint, time, caustics, seed, color[row, column])
            if hits == 0:  # only the center of a sliver was met: the surface right there
                _into_world(R, place, center_starts[row, column], center_rays[row, column], origin, direction)
                for axis in range(3):
                    p[axis] = corner[axis] + origin[axis] + z_depth[row, column] * direction[axis]
                radiance(
                    shade, animals, owner, corner, cell, p, pixel * z_depth[row, column], time, caustics, seed,
                    color[row, column],
                )  # fmt: skip
                hits = 1
            for channel in range(3):
                color[row, column, channel] /= hits
    return color, z_depth
