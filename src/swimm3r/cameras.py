"""Cameras: intrinsics, distortion and poses of the frames of one clip; pixels <-> rays <-> points.

Axes are OpenCV's (x right, y down, z forward); the centre of pixel (column, row) is (column + 0.5, row + 0.5). A
direction is written with z = 1, so a point is z_depth * direction, and ray_depth = z_depth * |direction|. Distortion
follows COLMAP's models, for (x, y) on the plane z = 1, r^2 = x^2 + y^2 and theta = atan r:

    SIMPLE_RADIAL (k1)                 (x, y) (1 + k1 r^2)
    OPENCV (k1, k2, p1, p2)            (x, y) (1 + k1 r^2 + k2 r^4)
                                         + (2 p1 x y + p2 (r^2 + 2 x^2), p1 (r^2 + 2 y^2) + 2 p2 x y)
    OPENCV_FISHEYE (k1, k2, k3, k4)    (x, y) theta / r (1 + k1 theta^2 + k2 theta^4 + k3 theta^6 + k4 theta^8)
"""

from dataclasses import dataclass, replace
from typing import Literal, get_args

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

CameraModel = Literal["PINHOLE", "SIMPLE_RADIAL", "OPENCV", "OPENCV_FISHEYE"]
DISTORTION_PARAMETERS: dict[str, tuple[str, ...]] = {
    "PINHOLE": (),
    "SIMPLE_RADIAL": ("k1",),
    "OPENCV": ("k1", "k2", "p1", "p2"),
    "OPENCV_FISHEYE": ("k1", "k2", "k3", "k4"),
}
_UNDISTORT_STEPS = 20  # Newton from the distorted point converges to 1e-10 in fewer for any lens COLMAP accepts


@dataclass(frozen=True)
class Cameras:
    """The cameras of c frames that share one image size and one camera model."""

    K: Float[Tensor, "c 3 3"]  # pixels
    distortion: Float[Tensor, "c d"]  # d as the model says
    cam2world: Float[Tensor, "c 4 4"]  # float64
    width: int
    height: int
    model: str = "PINHOLE"  # a CameraModel

    def __post_init__(self) -> None:
        if self.model not in get_args(CameraModel):
            raise ValueError(f"camera model is one of {', '.join(get_args(CameraModel))}, got {self.model}")
        expected = len(DISTORTION_PARAMETERS[self.model])
        if self.distortion.shape[-1] != expected:
            raise ValueError(f"{self.model} has {expected} distortion parameters, got {self.distortion.shape[-1]}")

    def __len__(self) -> int:
        return self.K.shape[0]

    def __getitem__(self, index: int | slice | list[int] | Int[Tensor, " k"]) -> "Cameras":
        """A selection, always with a leading axis."""
        if isinstance(index, int):
            index = [index]
        return replace(self, K=self.K[index], distortion=self.distortion[index], cam2world=self.cam2world[index])

    @property
    def world2cam(self) -> Float[Tensor, "c 4 4"]:
        """Inverse poses."""
        R, t = self.cam2world[:, :3, :3], self.cam2world[:, :3, 3:]
        inverse = torch.eye(4, dtype=self.cam2world.dtype, device=self.cam2world.device).repeat(len(self), 1, 1)
        inverse[:, :3, :3] = R.mT
        inverse[:, :3, 3:] = -R.mT @ t
        return inverse

    @property
    def centres(self) -> Float[Tensor, "c 3"]:
        """Camera centres in the world."""
        return self.cam2world[:, :3, 3]


def distort(
    xy: Float[Tensor, "*points 2"], distortion: Float[Tensor, "*#points d"], model: str
) -> Float[Tensor, "*points 2"]:
    """Where a point (x, y) of the plane z = 1 appears on the distorted plane (equations above)."""
    r2 = (xy * xy).sum(-1, keepdim=True)
    k = distortion.unbind(-1)
    match model:
        case "PINHOLE":
            return xy
        case "SIMPLE_RADIAL":
            return xy * (1 + k[0][..., None] * r2)
        case "OPENCV":
            x, y = xy.unbind(-1)
            k1, k2, p1, p2 = k
            s = r2[..., 0]
            radial = 1 + k1 * s + k2 * s * s
            return torch.stack(
                [
                    x * radial + 2 * p1 * x * y + p2 * (s + 2 * x * x),
                    y * radial + p1 * (s + 2 * y * y) + 2 * p2 * x * y,
                ],
                -1,
            )
        case "OPENCV_FISHEYE":
            r = r2.clamp(min=1e-24).sqrt()
            theta = torch.atan(r)
            t2 = theta * theta
            k1, k2, k3, k4 = (value[..., None] for value in k)
            return xy * theta * (1 + t2 * (k1 + t2 * (k2 + t2 * (k3 + t2 * k4)))) / r
        case _:
            raise ValueError(f"camera model is one of {', '.join(DISTORTION_PARAMETERS)}, got {model}")


def undistort(
    distorted: Float[Tensor, "*points 2"], distortion: Float[Tensor, "*#points d"], model: str
) -> Float[Tensor, "*points 2"]:
    """The inverse of `distort` by Newton's method in float64; NaN where the lens model has no such ray."""
    if model == "PINHOLE":
        return distorted
    target, parameters = distorted.double(), distortion.double()
    xy, step = target, 1e-6
    determinant = torch.ones_like(target[..., 0])
    for _ in range(_UNDISTORT_STEPS):
        residual = distort(xy, parameters, model) - target
        columns = [  # the Jacobian by central differences: exact to 1e-10, and no second formula per model
            (distort(xy + offset, parameters, model) - distort(xy - offset, parameters, model)) / (2 * step)
            for offset in (torch.tensor([step, 0.0]).to(xy), torch.tensor([0.0, step]).to(xy))
        ]
        (a, c), (b, d) = columns[0].unbind(-1), columns[1].unbind(-1)
        u, v = residual.unbind(-1)
        determinant = a * d - b * c
        xy = xy - torch.stack([d * u - b * v, a * v - c * u], -1) / determinant[..., None]
        if (residual.abs() < 1e-12).all():
            break
    missed = (distort(xy, parameters, model) - target).abs().amax(-1) > 1e-6
    folded = (determinant <= 0) | ((xy * target).sum(-1) < 0)  # a root beyond the radius where the model turns back
    return torch.where((missed | folded)[..., None], torch.nan, xy).to(distorted.dtype)


def pixel_grid(height: int, width: int) -> Float[Tensor, "h w 2"]:
    """The centres of all pixels, (x, y)."""
    y, x = torch.meshgrid(torch.arange(height) + 0.5, torch.arange(width) + 0.5, indexing="ij")
    return torch.stack([x, y], -1)


def project(cameras: Cameras, points: Float[Tensor, "c p 3"]) -> tuple[Float[Tensor, "c p 2"], Float[Tensor, "c p"]]:
    """Pixels and z depths of world points in each camera; points behind a camera have z <= 0 and meaningless pixels."""
    world2cam = cameras.world2cam.to(points)
    seen = points @ world2cam[:, :3, :3].mT + world2cam[:, None, :3, 3]
    z = seen[..., 2]
    xy = seen[..., :2] / torch.where(z.abs() < 1e-12, 1e-12, z)[..., None]
    xy = distort(xy, cameras.distortion[:, None].to(points), cameras.model)
    K = cameras.K.to(points)
    return xy @ K[:, :2, :2].mT + K[:, None, :2, 2], z


def directions(cameras: Cameras, pixels: Float[Tensor, "c p 2"]) -> Float[Tensor, "c p 3"]:
    """The rays of pixels in camera axes, scaled to z = 1."""
    K = cameras.K.to(pixels)
    xy = torch.linalg.solve(K[:, :2, :2], (pixels - K[:, None, :2, 2]).mT).mT
    xy = undistort(xy, cameras.distortion[:, None].to(pixels), cameras.model)
    return torch.cat([xy, torch.ones_like(xy[..., :1])], -1)


def unproject(
    cameras: Cameras, pixels: Float[Tensor, "c p 2"], z_depth: Float[Tensor, "c p"]
) -> Float[Tensor, "c p 3"]:
    """World points at given z depths."""
    cam2world = cameras.cam2world.to(pixels)
    seen = directions(cameras, pixels) * z_depth[..., None]
    return seen @ cam2world[:, :3, :3].mT + cam2world[:, None, :3, 3]


def image_directions(camera: Cameras) -> Float[Tensor, "h w 3"]:
    """`directions` of every pixel of one camera."""
    if len(camera) != 1:
        raise ValueError(f"image_directions takes one camera, got {len(camera)}")
    grid = pixel_grid(camera.height, camera.width).reshape(1, -1, 2)
    return directions(camera, grid).reshape(camera.height, camera.width, 3)


def distorted_grid(lens: Cameras, canvas: Cameras) -> tuple[Float[Tensor, "h w 2"], Bool[Tensor, "h w"]]:
    """Where every pixel of a pinhole canvas lies in a lens's picture, to undistort it, and whether it shows there."""
    rays = image_directions(canvas).double()[..., :2]
    pixels = distort(rays, lens.distortion[:, None], lens.model) @ lens.K[0, :2, :2].mT + lens.K[0, :2, 2]
    x, y = torch.linspace(0, lens.width, 65).double(), torch.linspace(0, lens.height, 65).double()
    outline = torch.cat([torch.stack([x, torch.full_like(x, v)], -1) for v in (0, lens.height)])
    outline = torch.cat([outline, *(torch.stack([torch.full_like(y, u), y], -1) for u in (0, lens.width))])
    edge = directions(lens, outline[None])[0, :, :2]
    reach = torch.linalg.vector_norm(edge[edge.isfinite().all(-1)], dim=-1).max()
    shown = ((pixels > 0) & (pixels < torch.tensor([lens.width, lens.height]))).all(-1)
    # beyond the farthest ray of the outline the lens model may fold back into the picture
    return pixels, shown & (torch.linalg.vector_norm(rays, dim=-1) <= reach * 1.001)


def ray_depth_from_z(z_depth: Float[Tensor, "*pixels"], rays: Float[Tensor, "*pixels 3"]) -> Float[Tensor, "*pixels"]:
    """Distance along the ray of points at a z depth; `rays` have z = 1."""
    return z_depth * torch.linalg.vector_norm(rays, dim=-1)


def z_depth_from_ray(ray_depth: Float[Tensor, "*pixels"], rays: Float[Tensor, "*pixels 3"]) -> Float[Tensor, "*pixels"]:
    """The inverse of `ray_depth_from_z`."""
    return ray_depth / torch.linalg.vector_norm(rays, dim=-1)


def resized(cameras: Cameras, width: int, height: int) -> Cameras:
    """The same cameras on pictures of another size; K scales per axis because pixel centres sit at +0.5."""
    scale = torch.diag(torch.tensor([width / cameras.width, height / cameras.height, 1.0])).to(cameras.K)
    return replace(cameras, K=scale @ cameras.K, width=width, height=height)
