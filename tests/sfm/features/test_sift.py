"""Keypoints obey masks and haze; matching is mutual and unambiguous."""

import numpy as np
import torch
from torch.nn.functional import normalize

from swimm3r.imaging.gray import LUMA
from swimm3r.sfm.features import sift
from swimm3r.sfm.features.settings import FeatureSettings
from swimm3r.sfm.features.sift import extract_features, match_descriptors, unit_descriptors


def _texture(height: int = 200, width: int = 260, seed: int = 0) -> torch.Tensor:
    generator = torch.Generator().manual_seed(seed)
    total = torch.zeros(height, width)
    for cells in (8, 16, 32, 64):
        noise = torch.rand(1, 1, cells, cells, generator=generator)
        octave = torch.nn.functional.interpolate(noise, (height, width), mode="bicubic", align_corners=False)
        total += octave[0, 0] / cells**0.5
    total = (total - total.min()) / (total.max() - total.min())
    return total[..., None].expand(height, width, 3).contiguous()


def test_no_keypoint_lies_under_the_mask() -> None:
    usable = torch.ones(200, 260, dtype=torch.bool)
    usable[:, 100:] = False
    found = extract_features(_texture(), usable, FeatureSettings())
    assert len(found.keypoints) > 50
    assert found.keypoints[:, 0].max() < 100
    assert len(found.descriptors) == len(found.keypoints)


def test_keypoints_of_a_reduced_image_are_in_pixels_of_the_full_one() -> None:
    image, usable = _texture(400, 600), torch.ones(400, 600, dtype=torch.bool)
    found = extract_features(image, usable, FeatureSettings(long_side=300))
    assert found.keypoints[:, 0].max() > 500
    assert found.keypoints[:, 1].max() > 330


def test_a_black_image_has_no_keypoints() -> None:
    found = extract_features(torch.zeros(100, 120, 3), torch.ones(100, 120, dtype=torch.bool), FeatureSettings())
    assert found.keypoints.shape == (0, 4)
    assert found.descriptors.shape == (0, 128)


def test_haze_costs_few_keypoints_where_faint_ones_count() -> None:
    usable = torch.ones(200, 260, dtype=torch.bool)
    clear, hazy = _texture(), 0.45 + 0.1 * _texture()
    faint = extract_features(hazy, usable, FeatureSettings())
    strict = extract_features(hazy, usable, FeatureSettings(faint_threshold=0.003))
    assert len(faint.keypoints) > 5 * len(strict.keypoints)
    assert len(faint.keypoints) > 0.4 * len(extract_features(clear, usable, FeatureSettings()).keypoints)


def test_features_of_a_scene_in_blue_are_found_in_blue(monkeypatch) -> None:
    usable, rng = torch.ones(200, 260, dtype=torch.bool), torch.Generator().manual_seed(1)
    filmed = torch.tensor([0.02, 0.1, 0.3]) + torch.tensor([0.0, 0.0, 0.1]) * _texture()
    images = [filmed + torch.randn(filmed.shape, generator=rng) / 255 for _ in range(2)]

    def matched() -> int:
        a, b = (extract_features(image, usable, FeatureSettings()) for image in images)
        return len(match_descriptors(unit_descriptors(a.descriptors), unit_descriptors(b.descriptors), 0.8))

    in_blue = matched()
    monkeypatch.setattr(sift, "weights_for_features", lambda *_: LUMA)
    assert in_blue > 2 * matched()


def test_each_descriptor_finds_itself_after_a_shuffle() -> None:
    generator = torch.Generator().manual_seed(0)
    a = normalize(torch.rand(40, 128, generator=generator), dim=1)
    order = torch.randperm(40, generator=generator)
    b = normalize(a[order] + 0.01 * torch.rand(40, 128, generator=generator), dim=1)
    matches = match_descriptors(a, b, 0.8)
    assert len(matches) == 40
    torch.testing.assert_close(order[matches[:, 1]], matches[:, 0])


def test_what_occurs_twice_is_matched_with_neither() -> None:
    generator = torch.Generator().manual_seed(0)
    a = normalize(torch.rand(20, 128, generator=generator), dim=1)
    b = torch.cat([a, normalize(a[:5] + 0.002 * torch.rand(5, 128, generator=generator), dim=1)])
    matched = match_descriptors(normalize(a + 0.01, dim=1), b, 0.8)[:, 0].tolist()
    assert matched == list(range(5, 20))


def test_matching_is_the_same_from_both_sides() -> None:
    generator = torch.Generator().manual_seed(1)
    a = normalize(torch.rand(60, 128, generator=generator) ** 4, dim=1)
    b = normalize(a[torch.randperm(60, generator=generator)] + 0.1 * torch.rand(60, 128, generator=generator), dim=1)
    forward = {tuple(pair) for pair in match_descriptors(a, b, 0.9).tolist()}
    backward = {(i, j) for j, i in match_descriptors(b, a, 0.9).tolist()}
    assert forward == backward
    assert forward


def test_stored_descriptors_become_unit_vectors() -> None:
    stored = np.random.default_rng(0).integers(0, 255, (5, 128), dtype=np.uint8)
    torch.testing.assert_close(unit_descriptors(stored).norm(dim=1), torch.ones(5))


def test_matches_do_not_depend_on_the_blocks_they_are_looked_for_in() -> None:
    generator = torch.Generator().manual_seed(2)
    a = normalize(torch.rand(300, 128, generator=generator) ** 4, dim=1)
    b = normalize(a[torch.randperm(300, generator=generator)] + 0.1 * torch.rand(300, 128, generator=generator), dim=1)
    order = torch.randperm(300, generator=generator)  # rows of one block in another
    expected = {tuple(pair) for pair in match_descriptors(a, b, 0.9).tolist()}
    shuffled = {(int(order[i]), j) for i, j in match_descriptors(a[order], b, 0.9).tolist()}
    assert shuffled == expected
    assert len(expected) > 200
