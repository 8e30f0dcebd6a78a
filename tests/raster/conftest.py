"""Scenes for the rasterizer's tests."""

from collections.abc import Callable

import pytest
import torch

from swimm3r.raster import MediumMaps, Primitives2D

Scene = tuple[Primitives2D, MediumMaps]


@pytest.fixture
def scene() -> Callable[..., Scene]:
    """Random overlapping primitives in random water, float64: `scene(n, height, width, seed=0)`."""

    def make(n: int, height: int, width: int, seed: int = 0) -> Scene:
        rng = torch.Generator().manual_seed(seed)

        def uniform(*shape: int) -> torch.Tensor:
            return torch.rand(*shape, generator=rng, dtype=torch.float64)

        sigma, angle = 2 + 5 * uniform(n, 2), 3.1416 * uniform(n)
        c, s, a, b = angle.cos(), angle.sin(), sigma[:, 0] ** -2, sigma[:, 1] ** -2
        conic = torch.stack([a * c * c + b * s * s, (a - b) * c * s, a * s * s + b * c * c], -1)
        mean = uniform(n, 2) * torch.tensor([width, height])
        opacity, beta, depth = 0.05 + 0.9 * uniform(n), 0.8 + 4 * uniform(n), 0.5 + 5 * uniform(n)
        water = MediumMaps(uniform(3, height, width), 0.6 * uniform(3, height, width), 0.6 * uniform(3, height, width))
        return Primitives2D(mean, conic, uniform(n, 3), opacity, beta, depth), water

    return make
