"""Depth that spilled over a silhouette into open water is taken back; surfaces keep theirs."""

import pytest
import torch

from swimm3r.imaging.open_water import without_fringe

H, W, SPILLED = 240, 320, 4
VEIL = torch.tensor([0.1, 0.5, 0.5])


@pytest.fixture(scope="module")
def shore() -> torch.Tensor:
    """Textured ground in the lower half, a rock on it, and open water with pixel noise above."""
    rng = torch.Generator().manual_seed(0)
    image = VEIL + 0.004 * torch.randn(H, W, 3, generator=rng)
    texture = 0.15 + 0.35 * torch.rand(H // 4, W // 4, 3, generator=rng)
    ground = surface()
    image[ground] = texture.repeat_interleave(4, 0).repeat_interleave(4, 1)[ground]
    return image


def surface() -> torch.Tensor:
    row, column = torch.meshgrid(torch.arange(H), torch.arange(W), indexing="ij")
    return (row >= H // 2) | ((row - H // 2) ** 2 + (column - 220) ** 2 < 60**2)


def spilled() -> torch.Tensor:
    """The surface, grown by a few pixels as patches grow it."""
    size = 2 * SPILLED + 1
    return torch.nn.functional.max_pool2d(surface()[None, None].float(), size, 1, SPILLED)[0, 0] > 0


def test_depth_outside_the_silhouette_goes_and_that_of_the_surface_stays(shore):
    z_depth = torch.where(spilled(), 3.0, 0.0)
    kept = without_fringe(shore, z_depth, VEIL) > 0
    outside = spilled() & ~surface()
    assert (kept & outside).sum() < 0.2 * outside.sum()
    assert (kept & surface()).sum() > 0.98 * surface().sum()


def test_depth_that_ends_at_the_silhouette_stays(shore):
    z_depth = torch.where(surface(), 3.0, 0.0)
    kept = without_fringe(shore, z_depth, VEIL)
    assert (kept > 0).sum() > 0.98 * surface().sum()
    assert torch.equal(kept[kept > 0], z_depth[kept > 0])


def test_without_open_water_nothing_changes(shore):
    everywhere = torch.full((H, W), 2.0)
    assert torch.equal(without_fringe(shore, everywhere, VEIL), everywhere)
    nowhere = torch.zeros(H, W)
    assert torch.equal(without_fringe(shore, nowhere, VEIL), nowhere)
