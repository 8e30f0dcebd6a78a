"""One pinhole camera that primitives are projected into, and their record on its image plane."""

from dataclasses import dataclass, replace

import torch
from jaxtyping import Float
from torch import Tensor

from swimm3r.cameras import Cameras
from swimm3r.raster import Kernel, Primitives2D

BLUR = 0.3
"""px^2, added to every covariance on the image plane."""
_MARGIN = 0.3  # field tangents beyond the image at which J is held


@dataclass(frozen=True)
class Pinhole:
    """One undistorted camera, world to camera; its pose may carry a gradient."""

    R: Float[Tensor, "3 3"]
    t: Float[Tensor, "3"]
    center: Float[Tensor, "3"]  # in the world
    fx: float
    fy: float
    cx: float
    cy: float
    width: int
    height: int

    def to(self, device: torch.device) -> "Pinhole":
        """The same camera for primitives on a device."""
        return replace(self, R=self.R.to(device), t=self.t.to(device), center=self.center.to(device))

    def widened(self, share: float) -> "Pinhole":
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


def pinhole(camera: Cameras, dtype: torch.dtype = torch.float32) -> Pinhole:
    """The one camera of a `Cameras`. Raises ValueError for several, or for one with distortion."""
    if len(camera) != 1:
        raise ValueError(f"a map is rendered for one camera at a time, got {len(camera)}")
    if camera.distortion.numel() and bool(camera.distortion.any()):
        raise ValueError(
            f"a map is rendered for pinhole cameras, got {camera.model} with distortion; camera.pinhole() leaves it out"
        )
    R = camera.cam2world[0, :3, :3].mT
    center = camera.cam2world[0, :3, 3]
    K = camera.K[0].tolist()
    return Pinhole(
        R.to(dtype),
        -(R @ center).to(dtype),
        center.to(dtype),
        K[0][0],
        K[1][1],
        K[0][2],
        K[1][2],
        camera.width,
        camera.height,
    )


def ray_limits(view: Pinhole) -> tuple[float, float, float, float]:
    """Lowest and highest x / z, then y / z, at which J is taken."""
    x, y = _MARGIN * 0.5 * view.width / view.fx, _MARGIN * 0.5 * view.height / view.fy
    return (
        -view.cx / view.fx - x,
        (view.width - view.cx) / view.fx + x,
        -view.cy / view.fy - y,
        (view.height - view.cy) / view.fy + y,
    )
