"""The one camera that primitives are projected into, a pinhole or a fisheye, and their record on its image plane."""

from dataclasses import dataclass, replace
from functools import lru_cache

import torch
from jaxtyping import Float
from torch import Tensor

from swimm3r.cameras import Cameras, distort, undistort
from swimm3r.raster import Kernel, Primitives2D

_MARGIN = 0.3  # field tangents beyond the image at which J is held


@dataclass(frozen=True)
class ViewCamera:
    """One camera, world to camera; its pose may carry a gradient."""

    R: Float[Tensor, "3 3"]
    t: Float[Tensor, "3"]
    center: Float[Tensor, "3"]  # in the world
    fx: float
    fy: float
    cx: float
    cy: float
    width: int
    height: int
    fisheye: tuple[float, float, float, float] | None = None  # k1 to k4 of an OPENCV_FISHEYE lens; None of a pinhole

    def rays(self, x: Float[Tensor, " w"], y: Float[Tensor, " h"]) -> Float[Tensor, "h w 3"]:
        """Rays with z = 1 of a grid of pixels, by its columns and rows, in camera axes."""
        at = (x - self.cx) / self.fx, (y - self.cy) / self.fy
        if self.fisheye is None:
            plane = torch.stack(torch.meshgrid(*at, indexing="xy"), -1)
        else:
            plane = _fisheye_plane(self.fisheye, *(tuple(values.tolist()) for values in at), x.dtype).to(x.device)
        return torch.cat([plane, torch.ones_like(plane[..., :1])], -1)

    def pixels(self, points: Float[Tensor, "*n 3"]) -> Float[Tensor, "*n 2"]:
        """Pixels of points in camera axes with z > 0: the inverse of `rays` up to their distance."""
        plane = points[..., :2] / points[..., 2:]
        if self.fisheye is not None:
            plane = distort(plane, plane.new_tensor(self.fisheye), "OPENCV_FISHEYE")
        x, y = plane.unbind(-1)
        return torch.stack([self.fx * x + self.cx, self.fy * y + self.cy], -1)

    def shifted(self, shift: Float[Tensor, "3"]) -> "ViewCamera":
        """The camera in whose axes every point is farther by `shift`; it looks the same way."""
        return replace(self, t=self.t + shift, center=self.center - self.R.mT @ shift)

    def to(self, device: torch.device) -> "ViewCamera":
        """The same camera for primitives on a device."""
        return replace(self, R=self.R.to(device), t=self.t.to(device), center=self.center.to(device))

    def widened(self, share: float) -> "ViewCamera":
        """The same camera with this share of the image more on every side."""
        right, down = round(share * self.width), round(share * self.height)
        width, height = self.width + 2 * right, self.height + 2 * down
        return replace(self, cx=self.cx + right, cy=self.cy + down, width=width, height=height)


@dataclass(frozen=True)
class Projection:
    """Primitives for the rasterizer, and the radius of each, px, without gradient."""

    primitives: Primitives2D
    radius: Float[Tensor, " n"]
    kernel: Kernel = "beta"


def view_camera(camera: Cameras, dtype: torch.dtype = torch.float32) -> ViewCamera:
    """The one camera of a `Cameras`. Raises ValueError for several, or for one with distortion that is no fisheye."""
    if len(camera) != 1:
        raise ValueError(f"a map is rendered for one camera at a time, got {len(camera)}")
    fisheye = None
    if camera.model == "OPENCV_FISHEYE":
        k1, k2, k3, k4 = camera.distortion[0].tolist()
        fisheye = (k1, k2, k3, k4)
    elif camera.distortion.numel() and bool(camera.distortion.any()):
        raise ValueError(
            f"maps are drawn for pinholes and fisheyes, got {camera.model} with distortion; use camera.drawn()"
        )
    R = camera.cam2world[0, :3, :3].mT
    center = camera.cam2world[0, :3, 3]
    K = camera.K[0].tolist()
    return ViewCamera(
        R.to(dtype),
        -(R @ center).to(dtype),
        center.to(dtype),
        K[0][0],
        K[1][1],
        K[0][2],
        K[1][2],
        camera.width,
        camera.height,
        fisheye,
    )


@lru_cache(
    maxsize=8
)  # one lens as a rule, its pixels and the grid of its water at two sizes: Newton's method takes long
def _fisheye_plane(
    k: tuple[float, float, float, float], x: tuple[float, ...], y: tuple[float, ...], dtype: torch.dtype
) -> Float[Tensor, "h w 2"]:
    """Points of the plane z = 1 that a lens images at columns x and rows y, in units of its focal lengths."""
    grid = torch.meshgrid(*(torch.tensor(values, dtype=torch.float64) for values in (x, y)), indexing="xy")
    plane = undistort(torch.stack(grid, -1), torch.tensor(k, dtype=torch.float64), "OPENCV_FISHEYE").to(dtype)
    return torch.nan_to_num(plane, nan=0.0)  # no ray of the lens: such a pixel is masked


def ray_limits(view: ViewCamera) -> tuple[float, float, float, float]:
    """Lowest and highest x / z, then y / z, at which J is taken."""
    x, y = _MARGIN * 0.5 * view.width / view.fx, _MARGIN * 0.5 * view.height / view.fy
    return (
        -view.cx / view.fx - x,
        (view.width - view.cx) / view.fx + x,
        -view.cy / view.fy - y,
        (view.height - view.cy) / view.fy + y,
    )
