"""Open water is told from far surfaces; depth that spilled over a silhouette into it is taken back."""

import pytest
import torch

from swimm3r.imaging.open_water import sea_share, without_fringe

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


def test_a_wedge_of_water_between_two_silhouettes_is_water_to_its_end(shore):
    """A slope under the upper edge, and a rock at the end of the strip that it leaves: no part is free of both."""
    row, column = torch.meshgrid(torch.arange(H), torch.arange(W), indexing="ij")
    wedge = (row < 12) & (column >= 90) & (column < 140)
    ground = ((row >= 12) & (column < 140)) | (column < 90) | surface()
    rng = torch.Generator().manual_seed(4)
    texture = 0.15 + 0.35 * torch.rand(H // 4, W // 4, 3, generator=rng)
    image = VEIL + 0.004 * torch.randn(H, W, 3, generator=rng)
    image[ground] = texture.repeat_interleave(4, 0).repeat_interleave(4, 1)[ground]
    share = sea_share(image, torch.where(ground, 3.0, 0.0), VEIL)
    assert share[wedge].mean() > 0.8
    assert share[ground].max() == 0
    apart = wedge & (column < 108)
    image[(row < 12) & (column >= 112) & (column < 118)] = torch.tensor([0.3, 0.2, 0.2])  # a pole cuts it off
    assert sea_share(image, torch.where(ground, 3.0, 0.0), VEIL)[apart].mean() < 0.1


def test_without_open_water_nothing_changes(shore):
    everywhere = torch.full((H, W), 2.0)
    assert torch.equal(without_fringe(shore, everywhere, VEIL), everywhere)
    nowhere = torch.zeros(H, W)
    assert torch.equal(without_fringe(shore, nowhere, VEIL), nowhere)


def test_before_the_dark_water_of_a_lamp_a_far_rock_is_no_water(shore):
    rng = torch.Generator().manual_seed(2)
    row, column = torch.meshgrid(torch.arange(H), torch.arange(W), indexing="ij")
    rock = ((row - H // 2) ** 2 + (column - 90) ** 2 < 50**2) & (row < H // 2)
    dark = VEIL * (0.3 + 0.15 * column / W)[..., None]  # to one side, as the lamp stands beside the camera
    image = torch.where(surface()[..., None], shore, shore - VEIL + dark)
    blotches = 0.006 * torch.randn(H // 4, W // 4, 3, generator=rng)
    image = image + rock[..., None] * (0.01 + blotches.repeat_interleave(4, 0).repeat_interleave(4, 1))
    known = torch.where(surface() & (row > H // 2 + 4), 1.0, 0.0)
    water = sea_share(image, known, dark) > 0.5
    assert water[rock].float().mean() < 0.1
    assert water[~surface() & ~rock].float().mean() > 0.9
    as_in_daylight = sea_share(image, known, dark[H // 2, W // 2]) > 0.5
    assert as_in_daylight[rock].float().mean() > 0.2


def test_a_far_rock_that_stands_out_in_one_channel_only_is_no_water(shore):
    rng = torch.Generator().manual_seed(1)
    row, column = torch.meshgrid(torch.arange(H), torch.arange(W), indexing="ij")
    rock = ((row - H // 2) ** 2 + (column - 90) ** 2 < 40**2) & (row < H // 2)
    blotches = (0.04 * torch.randn(H // 4, W // 4, generator=rng)).repeat_interleave(4, 0).repeat_interleave(4, 1)
    image = shore.clone()
    image[..., 2] += torch.where(rock, 0.02 + blotches, 0.0)
    known = torch.where(surface() & (row > H // 2 + 4), 1.0, 0.0)
    water = sea_share(image, known, VEIL) > 0.5
    beyond = ~surface() & ~rock
    assert water[rock].float().mean() < 0.15  # half of it before colors were compared in units of their spread
    assert water[beyond].float().mean() > 0.95
