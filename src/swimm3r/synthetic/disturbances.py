"""What comes between a clean picture and a camera's: a fish, marine snow, vignetting, sensor noise."""

from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Bool, Float
from torch import Tensor

from swimm3r.cameras import Cameras, ray_depth_from_z
from swimm3r.medium import Medium, add_water

_BODY = (0.19, 0.072, 0.04)  # m, half axes: along, up, across
_TAIL = (0.045, 0.075, 0.008)
_TAIL_AT = -0.205  # m behind the middle
_PERIOD = 9.0  # frames to cross the view and come back


@dataclass(frozen=True)
class Fish:
    """The fish as one picture shows it."""

    cover: Float[Tensor, "h w"]  # share of each pixel it hides
    clear: Float[Tensor, "h w 3"]  # its colour without water
    ray_depth: Float[Tensor, "h w"]  # 0 where it is not


def fish(
    sample_rays: Float[Tensor, "h2 w2 3"], floor_z_depth: Float[Tensor, "h w"], number: float, phase: float
) -> Fish:
    """The fish in frame `number`: it swims to and fro before the camera and is hidden by what is nearer.

    `sample_rays` are the rays (z = 1) of twice the picture's resolution; `floor_z_depth` is 0 in open water.
    """
    turn = 2 * np.pi * (number / _PERIOD + phase)
    middle = torch.tensor(
        [0.85 * np.sin(turn), -0.02 + 0.12 * np.sin(0.7 * turn), 1.25 + 0.15 * np.cos(0.6 * turn)], dtype=torch.float32
    )
    heading = 1.0 if np.cos(turn) >= 0 else -1.0
    lean = 0.35 * np.sin(0.9 * turn)
    # rows: along, up, across
    axes = torch.tensor(
        [[heading * np.cos(lean), 0.0, np.sin(lean)], [0.0, -1.0, 0.0], [-np.sin(lean), 0.0, heading * np.cos(lean)]],
        dtype=torch.float32,
    )
    z = torch.full(sample_rays.shape[:2], torch.inf)
    colour = torch.zeros(*sample_rays.shape[:2], 3)
    for half_axes, offset in ((_BODY, 0.0), (_TAIL, _TAIL_AT)):
        size = torch.tensor(half_axes)
        start = -(axes @ middle) - torch.tensor([offset, 0.0, 0.0])
        o, d = start / size, (sample_rays.float() @ axes.mT.float()) / size
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
        colour = torch.where(nearer[..., None], paint * light[..., None], colour)
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
        clear=per_pixel(torch.where(seen[..., None], colour, 0.0)) / share,
        ray_depth=(per_pixel(ray_depth) / share)[..., 0],
    )


def with_fish(raw: Float[Tensor, "h w 3"], seen: Fish, medium: Medium) -> Float[Tensor, "h w 3"]:
    """The picture with the fish, through as much water as is before it."""
    cover = seen.cover[..., None]
    return raw * (1 - cover) + add_water(seen.clear, seen.ray_depth, medium) * cover


def untouched(seen: Fish) -> Bool[Tensor, "h w"]:
    """True where the picture shows nothing of the fish."""
    return seen.cover == 0


def marine_snow(
    raw: Float[Tensor, "h w 3"], camera: Cameras, particles: int, medium: Medium, rng: np.random.Generator
) -> Float[Tensor, "h w 3"]:
    """The picture with bright specks between 0.12 and 2 m, blurred the more the nearer they are."""
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
        colour = add_water(tone, torch.tensor(z), medium).numpy()
        reach = int(3 * sigma) + 1
        rows = np.arange(max(int(y) - reach, 0), min(int(y) + reach + 1, height))
        columns = np.arange(max(int(x) - reach, 0), min(int(x) + reach + 1, width))
        spot = np.exp(
            -((rows[:, None] + 0.5 - y) ** 2 + (columns[None] + 0.5 - x) ** 2) / (2 * sigma**2), dtype=np.float64
        )
        cover = (alpha * spot)[..., None].astype(np.float32)
        patch = np.ix_(rows, columns)
        out[patch] = out[patch] * (1 - cover) + colour * cover
    return torch.from_numpy(out)


def vignette(raw: Float[Tensor, "h w 3"], strength: float) -> Float[Tensor, "h w 3"]:
    """The picture darkened towards the corners, by `strength` in the very corner."""
    h, w = raw.shape[:2]
    y = (torch.arange(h) + 0.5 - h / 2)[:, None]
    x = (torch.arange(w) + 0.5 - w / 2)[None]
    return raw * (1 - strength * (x * x + y * y) / (h * h / 4 + w * w / 4))[..., None]


def sensor_noise(raw: Float[Tensor, "h w 3"], sigma: float, rng: np.random.Generator) -> Float[Tensor, "h w 3"]:
    """The picture with Gaussian noise of standard deviation `sigma`; values may leave 0..1."""
    return raw + sigma * torch.from_numpy(rng.standard_normal(tuple(raw.shape), dtype=np.float32))
