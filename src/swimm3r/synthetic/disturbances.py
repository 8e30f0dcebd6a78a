"""Disturbances between a clean image and a camera's: a fish, marine snow, vignetting, exposure, tone mapping, noise."""

import math
from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Bool, Float
from torch import Tensor

from swimm3r.appearance import ORDERS
from swimm3r.cameras import Cameras, ray_depth_from_z
from swimm3r.medium import Medium, add_water, linear_from_srgb, srgb_from_linear
from swimm3r.synthetic.seafloor import Seafloor, height_at

_BODY = (0.19, 0.072, 0.04)  # m, half axes: along, up, across
_TAIL = (0.045, 0.075, 0.008)
_TAIL_AT = -0.205  # m behind the middle
_CROSSING = 1.0  # m swum during the dive
_AHEAD = 2.5  # m before the world's origin: in view from all of the path
_ABOVE = 0.3  # m between the fish's way and the highest ground under it


@dataclass(frozen=True)
class Fish:
    """The fish as one image shows it."""

    cover: Float[Tensor, "h w"]  # share of each pixel it hides
    clear: Float[Tensor, "h w 3"]  # its color without water
    ray_depth: Float[Tensor, "h w"]  # 0 where it is not


@dataclass(frozen=True)
class Swimmer:
    """Position and orientation of the fish."""

    middle: Float[Tensor, "3"]
    axes: Float[Tensor, "3 3"]  # rows: along, up, across

    def seen_from(self, cam2world: Float[Tensor, "4 4"]) -> "Swimmer":
        """The same in a camera's axes."""
        R = cam2world[:3, :3]
        return Swimmer((self.middle - cam2world[:3, 3]) @ R, self.axes @ R)


def swimming(floor: Seafloor, share: float, seed: int) -> Swimmer:
    """The fish in the world when `share` of the dive has passed: it swims across, once, in a gentle curve."""
    rng = np.random.default_rng([seed, 3])
    side, sway, bob = rng.choice([-1.0, 1.0]), rng.uniform(0, 2 * np.pi), rng.uniform(0, 2 * np.pi)

    def way(at: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        return side * _CROSSING * (at - 0.5), _AHEAD + 0.15 * np.sin(2 * np.pi * at + sway)

    x, y = way(np.linspace(0, 1, 64))
    ground = max(height_at(floor, x, y + aside).max() for aside in (-0.1, 0.0, 0.1))
    x, y = way(np.array([share - 1e-3, share, share + 1e-3]))
    height = ground + _ABOVE + 0.06 * np.sin(2 * np.pi * share + bob)
    along = np.array([x[2] - x[0], y[2] - y[0], 0.0])
    along /= np.linalg.norm(along)
    up = np.array([0.0, 0.0, 1.0])
    axes = np.stack([along, up, np.cross(along, up)])
    return Swimmer(torch.tensor([x[1], y[1], height]), torch.from_numpy(axes))


def fish(sample_rays: Float[Tensor, "h2 w2 3"], floor_z_depth: Float[Tensor, "h w"], there: Swimmer) -> Fish:
    """The fish in an image, hidden by what is nearer; `there` is in the camera's axes.

    `sample_rays` are the rays (z = 1) of twice the image's resolution; `floor_z_depth` is 0 in open water.
    """
    middle, axes = there.middle.float(), there.axes.float()
    z = torch.full(sample_rays.shape[:2], torch.inf)
    color = torch.zeros(*sample_rays.shape[:2], 3)
    for half_axes, offset in ((_BODY, 0.0), (_TAIL, _TAIL_AT)):
        size = torch.tensor(half_axes)
        start = -(axes @ middle) - torch.tensor([offset, 0.0, 0.0])
        o, d = start / size, (sample_rays.float() @ axes.mT) / size
        a, b, c = (d * d).sum(-1), (d * o).sum(-1), (o * o).sum(-1) - 1
        root = b * b - a * c
        t = torch.where(root > 0, (-b - root.clamp(min=0).sqrt()) / a, torch.inf)
        nearer = (t > 0.1) & (t < z)
        at = o + torch.where(nearer, t, 0.0)[..., None] * d  # on the unit sphere
        normal = torch.nn.functional.normalize(at / size, dim=-1)
        light = 0.62 + 0.38 * normal[..., 1]
        along = at[..., 0] * half_axes[0] + offset
        stripe = torch.sigmoid(12 * torch.sin(along * 95 + 8 * at[..., 1] * half_axes[1]))
        paint = stripe[..., None] * torch.tensor([0.92, 0.78, 0.18]) + (1 - stripe[..., None]) * torch.tensor(
            [0.10, 0.12, 0.22]
        )
        z = torch.where(nearer, t, z)
        color = torch.where(nearer[..., None], paint * light[..., None], color)
    floor = floor_z_depth.repeat_interleave(2, 0).repeat_interleave(2, 1)
    seen = torch.isfinite(z) & ((floor == 0) | (z < floor))

    def per_pixel(values: Tensor) -> Tensor:
        h, w = floor_z_depth.shape
        return values.reshape(h, 2, w, 2, -1).sum((1, 3))

    count = per_pixel(seen.float())
    share = count.clamp(min=1)
    ray_depth = ray_depth_from_z(torch.where(seen, z, 0.0), sample_rays.float())
    return Fish(
        cover=count[..., 0] / 4,
        clear=per_pixel(torch.where(seen[..., None], color, 0.0)) / share,
        ray_depth=(per_pixel(ray_depth) / share)[..., 0],
    )


def with_fish(raw: Float[Tensor, "h w 3"], seen: Fish, medium: Medium) -> Float[Tensor, "h w 3"]:
    """The image with the fish, through as much water as is before it."""
    cover = seen.cover[..., None]
    return raw * (1 - cover) + add_water(seen.clear, seen.ray_depth, medium) * cover


def untouched(seen: Fish) -> Bool[Tensor, "h w"]:
    """True where the image shows nothing of the fish."""
    return seen.cover == 0


def marine_snow(
    raw: Float[Tensor, "h w 3"], camera: Cameras, particles: int, medium: Medium, rng: np.random.Generator
) -> Float[Tensor, "h w 3"]:
    """The image with bright specks between 0.12 and 2 m, blurred the more the nearer they are."""
    out = raw.numpy().copy()
    height, width = out.shape[:2]
    focal = float(camera.K[0, 0, 0])
    for _ in range(particles):
        z = float(np.exp(rng.uniform(np.log(0.12), np.log(2.0))))
        x, y = rng.uniform(0, width), rng.uniform(0, height)
        sharp = rng.uniform(0.0004, 0.0014) * focal / z  # radius, pixels
        blur = 0.0012 * focal / z  # focused far away
        sigma = np.hypot(max(sharp, 0.35), blur)
        alpha = min(0.85, rng.uniform(0.5, 1.0) * (max(sharp, 0.35) / sigma) ** 2)
        tone = torch.full((3,), rng.uniform(0.7, 0.95))
        color = add_water(tone, torch.tensor(z), medium).numpy()
        reach = int(3 * sigma) + 1
        rows = np.arange(max(int(y) - reach, 0), min(int(y) + reach + 1, height))
        columns = np.arange(max(int(x) - reach, 0), min(int(x) + reach + 1, width))
        spot = np.exp(
            -((rows[:, None] + 0.5 - y) ** 2 + (columns[None] + 0.5 - x) ** 2) / (2 * sigma**2), dtype=np.float64
        )
        cover = (alpha * spot)[..., None].astype(np.float32)
        patch = np.ix_(rows, columns)
        out[patch] = out[patch] * (1 - cover) + color * cover
    return torch.from_numpy(out)


def vignette(raw: Float[Tensor, "h w 3"], strength: float) -> Float[Tensor, "h w 3"]:
    """The image darkened toward the corners, by `strength` in the very corner."""
    h, w = raw.shape[:2]
    y = (torch.arange(h) + 0.5 - h / 2)[:, None]
    x = (torch.arange(w) + 0.5 - w / 2)[None]
    return raw * (1 - strength * (x * x + y * y) / (h * h / 4 + w * w / 4))[..., None]


def camera_gains(exposure: float, white_balance: float, rng: np.random.Generator) -> Float[Tensor, "3"]:
    """One frame's factors on linear light: up to `exposure` stops up or down, red and blue by `white_balance` more."""
    stops = rng.uniform(-exposure, exposure)
    red, blue = 1 + rng.uniform(-white_balance, white_balance, 2)
    return torch.tensor([red, 1.0, blue], dtype=torch.float32) * 2.0**stops


def local_tones(stops: float, rng: np.random.Generator) -> Float[Tensor, "k 3"]:
    """One frame's shading of linear light (`swimm3r.appearance`), `stops` over the image, alike in all channels."""
    shape = (len(ORDERS), 3)
    drawn = rng.standard_normal((shape[0], 1)) + 0.3 * rng.standard_normal(shape)
    each = stops * math.log(2) / math.sqrt(sum(0.5 ** ((i > 0) + (j > 0)) for i, j in ORDERS))
    return torch.from_numpy(each * drawn / math.sqrt(1 + 0.3**2)).float()


def exposed(raw: Float[Tensor, "h w 3"], gains: Float[Tensor, "*over 3"]) -> Float[Tensor, "h w 3"]:
    """The image as a camera with other gains stores it, the same everywhere or by pixel; clipped where it is full."""
    return srgb_from_linear(linear_from_srgb(raw) * gains).clamp(0, 1)


def sensor_noise(raw: Float[Tensor, "h w 3"], sigma: float, rng: np.random.Generator) -> Float[Tensor, "h w 3"]:
    """The image with Gaussian noise of standard deviation `sigma`; values may leave 0..1."""
    return raw + sigma * torch.from_numpy(rng.standard_normal(tuple(raw.shape), dtype=np.float32))
