"""The central camera that comes closest to a camera in a housing, and the exact rays it stands for.

Behind a flat port, or a dome that is not centered, the rays in water meet no common point: each crosses the optical
axis at a place of its own. The central camera stands at the point of the axis that they pass closest to,

    c = argmin sum_u |distance of c to the ray of pixel u|^2,

and its distortion sends each pixel to where the pixel's ray meets one distance, at which it is exact. Elsewhere a pixel
u that shows a point at depth z from c stands off by `CameraInWater.shift(u, z)`, close to linear in 1 / z.
"""

from dataclasses import dataclass, replace

import torch
from jaxtyping import Float
from torch import Tensor

from swimm3r.cameras import DISTORTION_PARAMETERS, Cameras, directions, distort
from swimm3r.refraction.ports import Port, magnification, through_port

_GRID = 41  # rays along a side of the image that the central camera is made from


@dataclass(frozen=True)
class CentralError:
    """Distance in the image between exact and central projection of points at one distance, over the image."""

    distance: float  # m, along the optical axis from the port
    rms: float  # pixels
    largest: float  # pixels


@dataclass(frozen=True)
class CameraInWater:
    """A lens behind a port and the central camera for it."""

    lens: Cameras  # one, as calibrated in air; its pose is unused
    port: Port
    center: float  # m on the optical axis ahead of the lens's pupil, as a rule negative: the central camera's place
    central: Cameras  # one, at the origin

    @property
    def outside(self) -> float:
        """Depth of the port's outer surface from the central camera, on the axis, meters."""
        return self.port.distance + self.port.thickness - self.center

    def points(self, pixels: Float[Tensor, "n 2"], z: Float[Tensor, "#n"] | float) -> Float[Tensor, "n 3"]:
        """The points that pixels show exactly, at a depth z; meters, axes of the central camera."""
        seen = through_port(directions(self.lens, pixels.double()[None])[0], self.port)
        away = torch.tensor([0.0, 0.0, self.center], dtype=torch.float64)
        return seen.at_depth(torch.as_tensor(z, dtype=torch.float64) + self.center) - away

    def shift(self, pixels: Float[Tensor, "n 2"], z: Float[Tensor, "#n"] | float) -> Float[Tensor, "n 2"]:
        """The way from pixels to where the central camera has the points that they show at a depth z (meters)."""
        return _project(self.central, self.points(pixels, z)) - pixels.double()

    def errors(self, distances: Float[Tensor, " k"]) -> list[CentralError]:
        """The central camera's error at distances from the port."""
        pixels, found = _grid(self.lens), []
        for distance in distances.tolist():
            off = torch.linalg.vector_norm(self.shift(pixels, distance + self.outside), dim=-1)
            off = off[off.isfinite()]
            found.append(CentralError(distance, float(off.square().mean().sqrt()), float(off.max())))
        return found


def camera_in_water(lens: Cameras, port: Port, distance: float) -> CameraInWater:
    """The central camera for a lens (one, calibrated in air) behind a port, exact at a distance from the port (m).

    A lens without distortion becomes OPENCV; the principal point stays, as the port is taken to stand square to the
    axis. Raises ValueError where hardly a ray gets through the port.
    """
    pixels = _grid(lens)
    seen = through_port(directions(lens, pixels[None])[0], port)
    passes = seen.direction.isfinite().all(-1) & (seen.direction[:, 2] > 1e-3)
    if int(passes.sum()) < len(pixels) // 2:
        raise ValueError("most of the lens's rays do not get through the port")
    center = _closest_to(seen.start[passes], seen.direction[passes])
    blank = CameraInWater(lens, port, center, _start(lens, port))
    points = blank.points(pixels[passes], distance + blank.outside)
    return replace(blank, central=_fitted(blank.central, pixels[passes], points[:, :2] / points[:, 2:]))


def _grid(lens: Cameras) -> Float[Tensor, "n 2"]:
    """Pixels spread evenly over the image, its borders included."""
    x = torch.linspace(0, lens.width, _GRID, dtype=torch.float64)
    y = torch.linspace(0, lens.height, _GRID, dtype=torch.float64)
    return torch.stack(torch.meshgrid(x, y, indexing="xy"), -1).reshape(-1, 2)


def _closest_to(start: Float[Tensor, "n 3"], direction: Float[Tensor, "n 3"]) -> float:
    """The z of the point on the axis whose squared distances to rays have the least sum; that of a pupil at 0."""
    lateral = torch.linalg.vector_norm(direction[:, :2], dim=-1)
    oblique = lateral > 1e-6
    start, direction, lateral = start[oblique], direction[oblique], lateral[oblique]
    # rays of a lens and port with one axis stay in a plane with it, and meet it
    crossing = start[:, 2] - (start[:, :2] * direction[:, :2]).sum(-1) / lateral**2 * direction[:, 2]
    weight = lateral**2
    return float((weight * crossing).sum() / weight.sum())


def _start(lens: Cameras, port: Port) -> Cameras:
    """The lens in the model of the central camera, its focal lengths those of the paraxial rays in water."""
    model = "OPENCV_FISHEYE" if lens.model == "OPENCV_FISHEYE" else "OPENCV"
    given = dict(zip(DISTORTION_PARAMETERS[lens.model], lens.distortion[0].tolist(), strict=True))
    distortion = [given.get(name, 0.0) for name in DISTORTION_PARAMETERS[model]]
    K = lens.K.double().clone()
    K[:, [0, 1], [0, 1]] *= magnification(port)
    pose = torch.eye(4, dtype=torch.float64)[None]
    return Cameras(K, torch.tensor([distortion], dtype=torch.float64), pose, lens.width, lens.height, model)


def _fitted(start: Cameras, pixels: Float[Tensor, "n 2"], xy: Float[Tensor, "n 2"]) -> Cameras:
    """Focal lengths and distortion under which points (x, y) of the plane z = 1 stand nearest to their pixels."""
    from scipy.optimize import least_squares

    focal, middle = start.K[0, [0, 1], [0, 1]], start.K[0, :2, 2]

    def residuals(numbers: "object") -> "object":
        scale, distortion = torch.as_tensor(numbers, dtype=torch.float64).split([2, start.distortion.shape[1]])
        return ((distort(xy, distortion, start.model) * scale * focal + middle - pixels).flatten()).numpy()

    first = torch.cat([torch.ones(2, dtype=torch.float64), start.distortion[0]]).numpy()
    best = torch.from_numpy(least_squares(residuals, first, x_scale="jac", xtol=1e-14, ftol=1e-14).x)
    K = start.K.clone()
    K[0, [0, 1], [0, 1]] = best[:2] * focal
    return replace(start, K=K, distortion=best[None, 2:])


def _project(camera: Cameras, points: Float[Tensor, "n 3"]) -> Float[Tensor, "n 2"]:
    xy = distort(points[:, :2] / points[:, 2:], camera.distortion[0], camera.model)
    return xy @ camera.K[0, :2, :2].mT + camera.K[0, :2, 2]
