"""Small random scenes, float64, on which fast kernels are compared with slow references."""

import math

import torch
from jaxtyping import Float
from torch import Tensor
from torch.nn.functional import normalize

from swimm3r.cameras import Cameras, image_directions
from swimm3r.raster import MediumMaps, Primitives2D
from swimm3r.splat.primitives.beta import BetaPrimitives


def overlapping(n: int, height: int, width: int, seed: int = 0) -> tuple[Primitives2D, MediumMaps]:
    """`n` overlapping primitives on the image plane, in water that differs from pixel to pixel."""
    rng = torch.Generator().manual_seed(seed)

    def uniform(*shape: int) -> Tensor:
        return torch.rand(*shape, generator=rng, dtype=torch.float64)

    sigma, angle = 2 + 5 * uniform(n, 2), 3.1416 * uniform(n)
    c, s, a, b = angle.cos(), angle.sin(), sigma[:, 0] ** -2, sigma[:, 1] ** -2
    conic = torch.stack([a * c * c + b * s * s, (a - b) * c * s, a * s * s + b * c * c], -1)
    mean = uniform(n, 2) * torch.tensor([width, height])
    opacity, beta, depth = 0.05 + 0.9 * uniform(n), 0.8 + 4 * uniform(n), 0.5 + 5 * uniform(n)
    water = MediumMaps(uniform(3, height, width), 0.6 * uniform(3, height, width), 0.6 * uniform(3, height, width))
    return Primitives2D(mean, conic, uniform(n, 3), opacity, beta, depth), water


def beta_primitives(n: int, c: int = 3, seed: int = 0) -> BetaPrimitives:
    """`n` stored Beta primitives two to five units in front of the origin; `c` is 3, or 4 with time."""
    rng = torch.Generator().manual_seed(seed)

    def normal(*shape: int) -> Tensor:
        return torch.randn(*shape, generator=rng, dtype=torch.float64)

    xyz = normal(n, 3) * torch.tensor([0.8, 0.6, 0.6]) + torch.tensor([0.0, 0.0, 3.5])
    direction = normalize(xyz, dim=-1) + 0.3 * normal(n, 3)
    time = torch.rand(n, c - 3, generator=rng, dtype=torch.float64)
    scale = torch.cat([-1.8 + 0.5 * normal(n, 3), 0.5 + 0.3 * normal(n, c)], -1)
    beta = torch.cat([0.4 * normal(n, 1), -0.5 + 0.8 * normal(n, c)], -1)
    lower = 0.4 * normal(n, (3 + c) * (2 + c) // 2)
    rgb = torch.rand(n, 3, generator=rng, dtype=torch.float64)
    opacity = 1 + normal(n)
    footprint = 0.08 * torch.rand(n, generator=rng, dtype=torch.float64)
    return BetaPrimitives(xyz, torch.cat([direction, time], -1), rgb, opacity, beta, scale, lower, footprint)


def turned_camera(width: int = 80, height: int = 56) -> Cameras:
    """A slightly turned pinhole camera near the origin, its principal point off center."""
    K = torch.tensor([[70.0, 0, 0.46 * width], [0, 66.0, 0.55 * height], [0, 0, 1]], dtype=torch.float64)
    K[:2, :2] *= width / 80
    pose = torch.eye(4, dtype=torch.float64)
    turn = torch.tensor([[0, -0.05, 0.1], [0.05, 0, -0.08], [-0.1, 0.08, 0]], dtype=torch.float64)
    pose[:3, :3] = torch.linalg.matrix_exp(turn)
    pose[:3, 3] = torch.tensor([0.1, -0.05, 0.2])
    return Cameras(K[None], torch.zeros(1, 0, dtype=torch.float64), pose[None], width, height)


PLANE_DEPTH = 4.0  # of the textured plane, along the optical axis


def cameras_before_plane(width: int = 128, height: int = 96) -> Cameras:
    """Five cameras a sixteenth of the plane's depth apart that look at it frontally."""
    poses = torch.eye(4, dtype=torch.float64).repeat(5, 1, 1)
    poses[:, 0, 3] = torch.tensor([-0.5, -0.25, 0.0, 0.25, 0.5])
    poses[:, 1, 3] = torch.tensor([0.0, 0.1, 0.0, -0.1, 0.0])
    K = torch.tensor([[110.0, 0, width / 2], [0, 110.0, height / 2], [0, 0, 1]], dtype=torch.float64).repeat(5, 1, 1)
    return Cameras(K, torch.zeros(5, 0, dtype=torch.float64), poses, width, height)


def image_of_plane(camera: Cameras, seed: int = 3) -> Float[Tensor, "h w 3"]:
    """The plane at PLANE_DEPTH as one camera sees it, its texture a sum of waves down to 6 pixels long."""
    rng = torch.Generator().manual_seed(seed)
    xy = (image_directions(camera) * PLANE_DEPTH)[..., :2] + camera.centers[0, :2]
    value = torch.zeros(xy.shape[:2], dtype=torch.float64)
    for _ in range(60):
        u, angle, phase = torch.rand(3, generator=rng, dtype=torch.float64)
        direction = torch.stack([(math.tau * angle).cos(), (math.tau * angle).sin()])
        value += (math.tau * (xy @ direction / (0.2 + 0.6 * u) + phase)).sin()
    return (0.5 + 0.02 * value).clamp(0, 1).float()[..., None].expand(-1, -1, 3).contiguous()
