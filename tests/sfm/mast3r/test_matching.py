"""Reciprocal matching: the reference's numbers, and what a match must be."""

from dataclasses import replace
from pathlib import Path

import pytest
import torch
from safetensors.torch import load_file

from swimm3r.sfm.mast3r import matching
from swimm3r.sfm.mast3r.matching import DescriptorMap, PixelMatches
from swimm3r.sfm.mast3r.settings import MatchingSettings

ALL = MatchingSettings(border=0)


@pytest.fixture(scope="module")
def vectors(shared: Path) -> dict[str, torch.Tensor]:
    return load_file(shared / "vectors" / "mast3r" / "matching.safetensors")


def view(vectors: dict[str, torch.Tensor], name: str) -> DescriptorMap:
    descriptors = vectors[f"desc{name}"]
    return DescriptorMap(descriptors, vectors.get(f"qonf{name}", torch.ones(descriptors.shape[:2])))


def pixels(index: torch.Tensor, width: int) -> torch.Tensor:
    return torch.stack([index % width, index // width], dim=1)


def noise_view(seed: int, h: int = 24, w: int = 32, d: int = 8) -> DescriptorMap:
    generator = torch.Generator().manual_seed(seed)
    descriptors = torch.nn.functional.normalize(torch.randn(h, w, d, generator=generator), dim=-1)
    return DescriptorMap(descriptors, torch.rand(h, w, generator=generator) + 0.1)


@pytest.mark.shared
@pytest.mark.parametrize("subsample", [8, 4, 2])
def test_walks_from_a_grid_reproduce_the_reference(vectors: dict[str, torch.Tensor], subsample: int):
    found = matching.reciprocal_pairs(view(vectors, "11"), view(vectors, "21"), subsample)
    key = f"fnn.S{subsample}"
    assert torch.equal(found.index1, vectors[f"{key}.idx1"].long())
    assert torch.equal(found.index2, vectors[f"{key}.idx2"].long())
    assert torch.equal(pixels(found.index1, 64), vectors[f"{key}.xy1"])
    assert torch.equal(pixels(found.index2, 64), vectors[f"{key}.xy2"])


@pytest.mark.shared
def test_walks_between_views_of_two_sizes_reproduce_the_reference(vectors: dict[str, torch.Tensor]):
    found = matching.reciprocal_pairs(view(vectors, "11"), view(vectors, "3"), 4)
    for key in ("rect", "kdtree"):
        assert torch.equal(pixels(found.index1, 64), vectors[f"fnn.{key}.xy1"])
        assert torch.equal(pixels(found.index2, 40), vectors[f"fnn.{key}.xy2"])


@pytest.mark.shared
def test_basins_reproduce_the_reference(vectors: dict[str, torch.Tensor]):
    found = matching.reciprocal_pairs(view(vectors, "11"), view(vectors, "21"), 4)
    assert torch.equal(found.basins, vectors["fnn.basin.map"][:-1].long())


@pytest.mark.shared
@pytest.mark.parametrize("tolerance", [1, 3, 5])
def test_seeds_matched_within_a_tolerance_reproduce_the_reference(vectors: dict[str, torch.Tensor], tolerance: int):
    seeds = vectors["fnn.tol.init_y"] * 64 + vectors["fnn.tol.init_x"]
    found = matching.reciprocal_pairs(view(vectors, "11"), view(vectors, "21"), 8, seeds, tolerance)
    assert torch.equal(pixels(found.index1, 64), vectors[f"fnn.tol{tolerance}.xy1"])
    assert torch.equal(pixels(found.index2, 64), vectors[f"fnn.tol{tolerance}.xy2"])


@pytest.mark.shared
@pytest.mark.parametrize("distance", ["dot", "l2"])
def test_nearest_neighbors_reproduce_the_reference(vectors: dict[str, torch.Tensor], distance: str):
    a, b = vectors["desc11"].flatten(0, 1), vectors["desc21"].flatten(0, 1)
    assert torch.equal(matching.nearest(a, b, block=1000), vectors[f"brute.{distance}.nn12"])
    assert torch.equal(matching.nearest(b, a), vectors[f"brute.{distance}.nn21"])


@pytest.mark.shared
def test_merged_pairs_reproduce_the_reference(vectors: dict[str, torch.Tensor]):
    i, j, first = matching.unique_pairs(vectors["merge.in1"].long(), vectors["merge.in2"].long())
    assert torch.equal(first, vectors["merge.index"])
    assert torch.equal(pixels(i, 64), vectors["merge.xy1"])
    assert torch.equal(pixels(j, 64), vectors["merge.xy2"])


@pytest.mark.shared
@pytest.mark.parametrize("subsample", [8, 4])
def test_matches_of_both_passes_reproduce_the_reference(vectors: dict[str, torch.Tensor], subsample: int):
    v11, v21, v12, v22 = (view(vectors, name) for name in ("11", "21", "12", "22"))
    found = matching.match_views(v11, v21, v12, v22, MatchingSettings(subsample, border=0))
    assert torch.equal(found.xy1, vectors[f"sym.S{subsample}.xy1"])
    assert torch.equal(found.xy2, vectors[f"sym.S{subsample}.xy2"])
    torch.testing.assert_close(found.confidence, vectors[f"sym.S{subsample}.conf"], atol=1e-6, rtol=0)


@pytest.mark.shared
@pytest.mark.parametrize("tolerance", [0, 5])
def test_matches_of_one_pass_reproduce_the_reference(vectors: dict[str, torch.Tensor], tolerance: int):
    found = matching.match_pass(view(vectors, "11"), view(vectors, "21"), 8, tolerance)
    key = f"nonsym.tol{tolerance}"
    assert torch.equal(found.xy1, vectors[f"{key}.xy1"])
    assert torch.equal(found.xy2, vectors[f"{key}.xy2"])
    torch.testing.assert_close(found.confidence, vectors[f"{key}.conf"], atol=1e-6, rtol=0)


def test_every_pair_found_is_reciprocal():
    one, two = noise_view(1), noise_view(2)
    found = matching.reciprocal_pairs(one, two, 2)
    similarity = one.descriptors.flatten(0, 1) @ two.descriptors.flatten(0, 1).T
    assert len(found.index1) > 20
    assert torch.equal(similarity[found.index1].argmax(1), found.index2)
    assert torch.equal(similarity[:, found.index2].argmax(0), found.index1)


def test_search_in_blocks_is_the_search():
    queries, candidates = noise_view(1).descriptors.flatten(0, 1), noise_view(2).descriptors.flatten(0, 1)
    assert torch.equal(matching.nearest(queries, candidates, block=37), (queries @ candidates.T).argmax(1))


def test_among_equals_the_first_is_nearest():
    candidates = torch.eye(4).repeat(3, 1)
    for block in (3, 12):
        assert matching.nearest(torch.eye(4), candidates, block).tolist() == [0, 1, 2, 3]


def test_matches_of_swapped_views_are_the_same_pairs():
    views = [noise_view(i) for i in range(4)]
    forth = matching.match_views(views[0], views[1], views[2], views[3], ALL)
    back = matching.match_views(views[3], views[2], views[1], views[0], ALL)
    pairs = {(*a, *b) for a, b in zip(forth.xy1.tolist(), forth.xy2.tolist(), strict=True)}
    assert pairs == {(*a, *b) for a, b in zip(back.xy2.tolist(), back.xy1.tolist(), strict=True)}


def test_masked_pixels_never_match():
    one, two = noise_view(1), noise_view(2)
    mask1 = torch.ones(24, 32, dtype=torch.bool)
    mask1[:, :16] = False
    mask2 = torch.ones(24, 32, dtype=torch.bool)
    mask2[12:] = False
    first, second = replace(one, mask=mask1), replace(two, mask=mask2)
    found = matching.match_views(first, second, first, second, replace(ALL, subsample=2))
    assert len(found.xy1) > 20
    assert (found.xy1[:, 0] >= 16).all()
    assert (found.xy2[:, 1] < 12).all()


def test_masked_search_is_the_search_over_what_is_left():
    one, two = noise_view(1), noise_view(2)
    mask = torch.ones(24, 32, dtype=torch.bool)
    mask[:, 20:] = False
    cut = DescriptorMap(two.descriptors[:, :20].contiguous(), two.confidence[:, :20])
    whole = matching.reciprocal_pairs(one, replace(two, mask=mask), 2)
    part = matching.reciprocal_pairs(one, cut, 2)
    assert torch.equal(whole.index1, part.index1)
    assert torch.equal(pixels(whole.index2, 32), pixels(part.index2, 20))


def test_wholly_masked_view_matches_nothing():
    one, two = noise_view(1), noise_view(2)
    nothing = torch.zeros(24, 32, dtype=torch.bool)
    for views in ((replace(one, mask=nothing), two), (one, replace(two, mask=nothing))):
        found = matching.match_views(*views, *views, ALL)
        assert found.xy1.shape == (0, 2)
        assert found.confidence.shape == (0,)


def test_matches_at_the_border_are_dropped():
    xy1 = torch.tensor([[3, 3], [2, 10], [28, 20], [29, 5], [10, 10]])
    xy2 = torch.tensor([[3, 3], [10, 10], [28, 20], [10, 10], [10, 21]])
    kept = matching.drop_border(PixelMatches(xy1, xy2, torch.arange(5.0)), (24, 32), (24, 32), 3)
    assert kept.confidence.tolist() == [0.0, 2.0]
