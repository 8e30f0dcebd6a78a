"""Scenes for the rasterizer's tests."""

from collections.abc import Callable

import pytest

from swimm3r.raster import MediumMaps, Primitives2D
from swimm3r.selftest.scenes import overlapping


@pytest.fixture
def scene() -> Callable[..., tuple[Primitives2D, MediumMaps]]:
    """Random overlapping primitives in random water, float64: `scene(n, height, width, seed=0)`."""
    return overlapping
