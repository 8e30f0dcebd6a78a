"""Depth that is filled in where a frame's depth map has gaps."""

import pytest
import torch
from jaxtyping import Bool, Float
from torch import Tensor

from swimm3r.imaging.depth_completion import fill_z_depth, unlike
from swimm3r.scene.reconstruction import DepthMap

GRAY = torch.full((72, 96, 3), 0.5)
NEAR, FAR = 2.0, 4.0
ROCK = torch.zeros(216, 288, dtype=torch.bool)  # a surface at NEAR before one at FAR
ROCK[60:156, 90:186] = True


def filled_around_rock(image: Float[Tensor, "216 288 3"], gap: Bool[Tensor, "216 288"]) -> Float[Tensor, "216 288"]:
    z = torch.where(ROCK, NEAR, FAR)
    return fill_z_depth(image, DepthMap(torch.where(gap, 0.0, z), (~gap).float()), torch.zeros(216, 288))


def gap_at(rows: slice, columns: slice) -> Bool[Tensor, "216 288"]:
    gap = torch.zeros_like(ROCK)
    gap[rows, columns] = True
    return gap


def test_filling_keeps_what_is_known_and_stays_in_its_range():
    z = torch.linspace(1.0, 3.0, 96).expand(72, 96).clone()
    holes = torch.rand(z.shape, generator=torch.Generator().manual_seed(1)) < 0.5
    depth = DepthMap(torch.where(holes, 0.0, z), (~holes).float())
    filled = fill_z_depth(GRAY, depth, torch.zeros(72, 96))
    torch.testing.assert_close(filled[~holes], z[~holes])
    assert ((filled - z).abs() / z)[holes].median() < 0.05


def test_filling_goes_on_as_planes_beyond_the_nearest_and_the_farthest_known():
    inverse = torch.linspace(0.4, 1.0, 72)[:, None].expand(72, 96)
    known = (inverse > 0.5) & (inverse < 0.8)
    depth = DepthMap(torch.where(known, 1 / inverse, 0.0), known.float())
    filled = fill_z_depth(GRAY, depth, torch.zeros(72, 96))
    assert (filled * inverse).log().abs().max() < 0.1  # 0.22 off if depth stayed what it is at the rim


def test_filling_follows_depth_that_other_images_measured():
    z = torch.full((72, 96), 1.0)
    z[:, 48:] = 3.0
    known = torch.zeros(72, 96, dtype=torch.bool)
    known[:, :32] = True
    depth, image = DepthMap(torch.where(known, z, 0.0), known.float()), torch.full((72, 96, 3), 0.5)
    image[:, 48:] = 0.2
    elsewhere = torch.where(torch.rand(72, 96, generator=torch.Generator().manual_seed(1)) < 0.1, z, 0.0)
    alone, told = (fill_z_depth(image, depth, torch.zeros(72, 96), hints) for hints in (None, elsewhere))
    assert torch.equal(told[known], z[known])
    assert (told / z).log().abs()[:, 52:].max() < 0.1
    assert (alone / z).log().abs()[:, 52:].min() > 0.5


@pytest.mark.parametrize("gap", [gap_at(slice(60, 156), slice(186, 191)), gap_at(slice(55, 60), slice(90, 186))])
def test_gaps_beside_a_silhouette_continue_what_lies_behind(gap):
    filled = filled_around_rock(torch.full((216, 288, 3), 0.5), gap)
    assert (filled[gap] / FAR).log().abs().max() < 0.05  # 0.50 where depth changes gradually


def test_gaps_of_the_color_of_what_lies_in_front_are_part_of_it():
    image = torch.where(ROCK[..., None], torch.tensor([0.2, 0.3, 0.2]), torch.tensor([0.55, 0.5, 0.45]))
    gap = gap_at(slice(60, 156), slice(181, 186))
    filled = filled_around_rock(image, gap)
    assert (filled[gap] / NEAR).log().abs().max() < 0.15


@pytest.mark.parametrize(("brightness", "z"), [(0.25, NEAR), (0.75, NEAR), (0.5, FAR)])
def test_gaps_belong_to_the_surface_that_varies_as_far_as_their_colors(brightness: float, z: float):
    """A mottled rock before even ground of the same color on average."""
    draw = torch.Generator().manual_seed(0)
    blotches = torch.rand(54, 72, generator=draw).repeat_interleave(4, 0).repeat_interleave(4, 1)
    image = torch.where(ROCK, 0.2 + 0.6 * blotches, 0.5)[..., None].expand(-1, -1, 3).clone()
    image += 0.01 * torch.randn(image.shape, generator=draw)
    gap = gap_at(slice(60, 156), slice(183, 189))
    image[gap] = brightness
    filled = filled_around_rock(image, gap)
    assert (filled[gap] / z).log().abs().median() < 0.25  # 0.69 on the other one


def test_holes_in_what_lies_in_front_are_part_of_it():
    gap = gap_at(slice(90, 91), slice(180, 182)) | gap_at(slice(63, 65), slice(120, 121))
    filled = filled_around_rock(torch.full((216, 288, 3), 0.5), gap)
    assert (filled[gap] / NEAR).log().abs().max() < 0.1


def test_a_rod_before_mottled_sand_is_another_thing_and_more_sand_is_none():
    draw = torch.Generator().manual_seed(0)
    image = torch.tensor([0.4, 0.5, 0.45]) + 0.05 * torch.randn(120, 160, 3, generator=draw)
    image[:, :80] += 0.1  # lit more brightly: the surroundings decide
    rod = torch.zeros(120, 160, dtype=torch.bool)
    rod[50:60, 30:130] = True
    image[rod] = 0.08
    known = torch.ones(120, 160, dtype=torch.bool)
    known[40:70] = False
    odd = unlike(image, known, ~known)
    assert odd[rod].float().mean() > 0.95
    assert odd[~known & ~rod].float().mean() < 0.03
    assert not odd[known].any()
