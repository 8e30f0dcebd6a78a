"""Cameras: intrinsics, distortion and poses of the frames of one clip; pixels <-> rays <-> points.

Axes are OpenCV's (x right, y down, z forward); the center of pixel (column, row) is (column + 0.5, row + 0.5). A
direction is written with z = 1, so a point is z_depth * direction, and ray_depth = z_depth * |direction|. Distortion
follows COLMAP's models, for (x, y) on the plane z = 1, r^2 = x^2 + y^2 and theta = atan r:

    SIMPLE_RADIAL (k1)                 (x, y) (1 + k1 r^2)
    OPENCV (k1, k2, p1, p2)            (x, y) (1 + k1 r^2 + k2 r^4)
                                         + (2 p1 x y + p2 (r^2 + 2 x^2), p1 (r^2 + 2 y^2) + 2 p2 x y)
    OPENCV_FISHEYE (k1, k2, k3, k4)    (x, y) theta / r (1 + k1 theta^2 + k2 theta^4 + k3 theta^6 + k4 theta^8)

One more is of no other program, for images that are bent as none of these lenses bends them (`imaging.rectification`):

    POLYNOMIAL (a20 .. a05, b20 .. b05)  (x + sum a_ij x^i y^j, y + sum b_ij x^i y^j),  2 <= i + j <= 5
"""

import json
import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Literal, Protocol, get_args, runtime_checkable

import numpy as np
import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from swimm3r.io.files.atomic import write_text
from swimm3r.io.files.safe_names import check_names

CameraModel = Literal["PINHOLE", "SIMPLE_RADIAL", "OPENCV", "OPENCV_FISHEYE", "POLYNOMIAL"]
EXPONENTS = tuple((degree - j, j) for degree in range(2, 6) for j in range(degree + 1))
"""i and j of the monomials x^i y^j of POLYNOMIAL, by degree."""
DISTORTION_PARAMETERS: dict[str, tuple[str, ...]] = {
    "PINHOLE": (),
    "SIMPLE_RADIAL": ("k1",),
    "OPENCV": ("k1", "k2", "p1", "p2"),
    "OPENCV_FISHEYE": ("k1", "k2", "k3", "k4"),
    "POLYNOMIAL": tuple(f"{axis}{i}{j}" for axis in "ab" for i, j in EXPONENTS),
}
_ORTHONORMAL = 5e-3  # of R R^T: rotations are printed with as few as three decimals
_FOCAL = (0.01, 1000.0)  # of the long side: fields of view of 178 and 0.06 degrees
_FARTHEST = 1e12  # of a camera or a principal point; its square is a number still
_BEND = 2.5  # how far a lens may move a point a quarter of the short side from the middle, as a ratio of radii
_UNDISTORT_STEPS = 20  # Newton from the distorted point converges to 1e-10 in fewer for any lens COLMAP accepts


@dataclass(frozen=True)
class Cameras:
    """The cameras of c frames that share one image size and one camera model.

    Building one is free, as inner loops do it all the time; numbers from outside go through `check_cameras`.
    """

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

    def __repr__(self) -> str:
        size = f"{self.width}x{self.height}"
        if not len(self):
            return f"Cameras(none, {size}, {self.model})"
        fx, fy = self.K[:, [0, 1], [0, 1]].double().mean(0).tolist()
        across, down = (math.degrees(2 * math.atan2(n, 2 * f)) for n, f in ((self.width, fx), (self.height, fy)))
        # of a fisheye lens the angle would be another
        view = "" if self.model == "OPENCV_FISHEYE" else f", {across:.0f}x{down:.0f} degrees"
        return f"Cameras({len(self)} of {size}, {self.model}, focal length {fx:.1f} px{view})"

    @property
    def world2cam(self) -> Float[Tensor, "c 4 4"]:
        """Inverse poses."""
        R, t = self.cam2world[:, :3, :3], self.cam2world[:, :3, 3:]
        inverse = torch.eye(4, dtype=self.cam2world.dtype, device=self.cam2world.device).repeat(len(self), 1, 1)
        inverse[:, :3, :3] = R.mT
        inverse[:, :3, 3:] = -R.mT @ t
        return inverse

    @property
    def centers(self) -> Float[Tensor, "c 3"]:
        """Camera centers in the world."""
        return self.cam2world[:, :3, 3]

    def pinhole(self, long_side: int = 0) -> "Cameras":
        """The same cameras without lens distortion, on images of at most `long_side` pixels; 0 keeps their size."""
        scale = min(1.0, long_side / max(self.width, self.height)) if long_side else 1.0
        small = resized(self, max(2, round(self.width * scale)), max(2, round(self.height * scale)))
        return replace(small, distortion=small.distortion[:, :0], model="PINHOLE")

    def drawn(self, long_side: int = 0) -> "Cameras":
        """The cameras that maps draw, images of at most `long_side` pixels: pinholes, and fisheyes as they are.

        A pinhole image of what a fisheye shows would leave out its border, or be of many times the pixels.
        """
        pinholes = self.pinhole(long_side)
        if self.model != "OPENCV_FISHEYE":
            return pinholes
        return replace(pinholes, distortion=self.distortion, model=self.model)

    def save(
        self,
        path: str | Path,
        names: Sequence[str] | None = None,
        times: Sequence[float] | None = None,
        units: str = "scene units",
    ) -> None:
        """Write a cameras.json (layout: `io.cameras_json`), whole or not at all; `swimm3r.load_cameras` reads it.

        Without `names` the cameras are numbered; `times` are seconds since the start of the clip. Raises ValueError
        where the cameras are none (`check_cameras`), or not as many as the names.
        """
        names = [f"{i:06d}" for i in range(len(self))] if names is None else names
        check_names(names)
        check_cameras(self)
        lenses = [_intrinsics(self, i) for i in range(len(self))]
        shared = lenses[0] if lenses and all(lens == lenses[0] for lens in lenses) else None
        document = {
            "width": self.width,
            "height": self.height,
            "model": self.model,
            **(shared or {}),
            "units": units,
            "convention": "OpenCV camera axes, camera-to-world; center of the first pixel at (0.5, 0.5)",
            "frames": [
                {
                    "name": name,
                    **({} if times is None else {"time": times[i]}),
                    "c2w": pose,
                    **({} if shared else lenses[i]),
                }
                for i, (name, pose) in enumerate(zip(names, self.cam2world.tolist(), strict=True))
            ],
        }
        write_text(Path(path), json.dumps(document, indent=1) + "\n")


def _intrinsics(cameras: Cameras, i: int) -> dict[str, float | list[float]]:
    """The entries of one camera's lens in a cameras.json."""
    (fx, _, cx), (_, fy, cy), _ = cameras.K[i].tolist()
    return {"fx": fx, "fy": fy, "cx": cx, "cy": cy, "distortion": cameras.distortion[i].tolist()}


@runtime_checkable  # so that the suite can check calls against it
class CameraArrays(Protocol):
    """Cameras as files hold them."""

    @property
    def K(self) -> np.ndarray: ...
    @property
    def distortion(self) -> np.ndarray: ...
    @property
    def cam2world(self) -> np.ndarray: ...
    @property
    def width(self) -> int: ...
    @property
    def height(self) -> int: ...
    @property
    def model(self) -> str: ...


def cameras_of(table: CameraArrays) -> Cameras:
    """The cameras of a table read from disk."""
    K, distortion, cam2world = (torch.from_numpy(a) for a in (table.K, table.distortion, table.cam2world))
    return Cameras(K, distortion, cam2world, table.width, table.height, table.model)


def check_cameras(cameras: Cameras) -> None:
    """Raise ValueError unless sizes and focal lengths are positive, poses rigid, and all numbers finite.

    Whatever comes from a file passes here once: the tables of `io` call it when they are made.
    """
    width, height, K = cameras.width, cameras.height, cameras.K
    if width < 1 or height < 1:
        raise ValueError(f"images have a size in whole pixels, got {width}x{height}")
    _require(torch.isfinite(K).all((1, 2)), "intrinsics are finite numbers")
    low, high = (bound * max(width, height) for bound in _FOCAL)
    focal, center = K[:, [0, 1], [0, 1]], K[:, :2, 2]
    _require(((focal > low) & (focal < high)).all(1), f"focal lengths are between {low:g} and {high:g} px")
    _require((center.abs() < _FARTHEST).all(1), "the principal point is near the image")
    skewed = K - torch.diag_embed(torch.cat([focal, torch.ones_like(focal[:, :1])], 1))
    skewed[:, :2, 2] = 0
    _require((skewed == 0).all(2).all(1), "intrinsics have the form [[fx, 0, cx], [0, fy, cy], [0, 0, 1]]")
    _require(torch.isfinite(cameras.distortion).all(1), "distortion parameters are finite numbers")
    check_poses(cameras.cam2world)


def check_poses(cam2world: Float[Tensor, "c 4 4"]) -> None:
    """Raise ValueError unless poses are finite, rigid and not mirrored."""
    _require(torch.isfinite(cam2world).all((1, 2)), "poses are finite numbers")
    _require((cam2world[:, :3, 3].abs() < _FARTHEST).all(1), f"camera centers are within {_FARTHEST:g}")
    R, eye = cam2world[:, :3, :3], torch.eye(4, dtype=cam2world.dtype)
    off = (R @ R.mT - eye[:3, :3]).abs().amax((1, 2))
    rigid = (off < _ORTHONORMAL) & (torch.linalg.det(R) > 0) & (cam2world[:, 3] == eye[3]).all(1)
    _require(rigid, "poses are a rotation and a translation")


def check_lens(cameras: Cameras) -> None:
    """Raise ValueError where distortion folds or crumples the very middle of the image, as no lens does."""
    if cameras.model == "PINHOLE":
        return
    angle = torch.arange(8) * (torch.pi / 4)
    ring = torch.stack([angle.cos(), angle.sin()], -1).double() * (min(cameras.width, cameras.height) / 4)
    K = cameras.K.double()
    pixels = K[:, None, :2, 2] + ring
    straight = directions(cameras, pixels)[..., :2]
    ratio = torch.linalg.vector_norm(straight * K[:, None, [0, 1], [0, 1]], dim=-1) / ring[0].norm()
    _require(((ratio > 1 / _BEND) & (ratio < _BEND)).all(1), "the distortion is that of a lens in this image")


def _require(holds: Bool[Tensor, " c"], what: str) -> None:
    if not bool(holds.all()):
        first = int((~holds).nonzero()[0, 0])
        raise ValueError(f"{what}; not so of {int((~holds).sum())} of {len(holds)} cameras, the first number {first}")


def distort(
    xy: Float[Tensor, "*points 2"], distortion: Float[Tensor, "*#points d"], model: str
) -> Float[Tensor, "*points 2"]:
    """Position on the distorted plane of a point (x, y) of the plane z = 1 (equations above)."""
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
        case "POLYNOMIAL":
            x, y = (axis[..., None] for axis in xy.unbind(-1))
            terms = torch.cat([x**i * y**j for i, j in EXPONENTS], -1)
            a, b = distortion[..., : len(EXPONENTS)], distortion[..., len(EXPONENTS) :]
            return xy + torch.stack([(a * terms).sum(-1), (b * terms).sum(-1)], -1)
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
    """The centers of all pixels, (x, y)."""
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


def inside_image(pixels: Float[Tensor, "*points 2"], width: int, height: int) -> Bool[Tensor, "*points"]:
    """Mask of the pixels inside an image of this size: rounded down they are a column and a row of it."""
    return ((pixels >= 0) & (pixels < torch.tensor([width, height]).to(pixels))).all(-1)


def project_visible(
    cameras: Cameras, points: Float[Tensor, "c p 3"]
) -> tuple[Float[Tensor, "c p 2"], Float[Tensor, "c p"], Bool[Tensor, "c p"]]:
    """`project`, and which points lie before the camera and inside its image."""
    pixels, z = project(cameras, points)
    return pixels, z, (z > 0) & inside_image(pixels, cameras.width, cameras.height)


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


def ray_depth_from_z(z_depth: Float[Tensor, "*pixels"], rays: Float[Tensor, "*pixels 3"]) -> Float[Tensor, "*pixels"]:
    """Distance along the ray of points at a z depth; `rays` have z = 1."""
    return z_depth * torch.linalg.vector_norm(rays, dim=-1)


def z_depth_from_ray(ray_depth: Float[Tensor, "*pixels"], rays: Float[Tensor, "*pixels 3"]) -> Float[Tensor, "*pixels"]:
    """The inverse of `ray_depth_from_z`."""
    return ray_depth / torch.linalg.vector_norm(rays, dim=-1)


def rows_of_frames(frame: Int[Tensor, " n"], count: int) -> tuple[Int[Tensor, " _"], ...]:
    """The rows that belong to each of `count` frames, given the frame of every row: one sort for all of them."""
    return frame.argsort(stable=True).split(torch.bincount(frame, minlength=count).tolist())


def resized(cameras: Cameras, width: int, height: int) -> Cameras:
    """The same cameras on images of another size; K scales per axis because pixel centers sit at +0.5."""
    scale = torch.diag(torch.tensor([width / cameras.width, height / cameras.height, 1.0])).to(cameras.K)
    return replace(cameras, K=scale @ cameras.K, width=width, height=height)
