"""Frames of one place are more alike than frames of two places."""

import pytest
import torch
from torch.nn.functional import normalize

from swimm3r.sfm.features import vlad


def _frames_of_places(places: list[int]) -> list[torch.Tensor]:
    generator = torch.Generator().manual_seed(0)
    scene = {place: torch.rand(300, 128, generator=generator) ** 3 for place in sorted(set(places))}
    return [normalize(scene[p] + 0.05 * torch.rand(300, 128, generator=generator), dim=1) for p in places]


def _described(frames: list[torch.Tensor]) -> torch.Tensor:
    return vlad.describe_frames(len(frames), frames.__getitem__, torch.Generator().manual_seed(0))


def test_a_place_seen_again_is_found_among_all_frames() -> None:
    places = [0, 0, 1, 1, 2, 2, 0, 1]
    described = _described(_frames_of_places(places))
    alike = described @ described.mT
    same = torch.tensor(places)[:, None] == torch.tensor(places)
    off = ~torch.eye(8, dtype=torch.bool)
    assert alike[same & off].min() > alike[~same].max()


def test_frames_without_a_feature_are_alike_in_nothing() -> None:
    assert not _described([torch.zeros(0, 128)] * 3).any()


def test_loops_leave_out_neighbors_in_time() -> None:
    described = _described(_frames_of_places([0, 0, 1, 1, 2, 2, 0, 1]))
    pairs = vlad.alike_pairs(described, 1, apart=2)
    assert {(0, 6), (1, 6), (2, 7), (3, 7)} <= set(pairs)
    assert all(j - i > 2 for i, j in pairs)
    assert pairs == sorted(pairs)


def test_a_frame_without_keypoints_resembles_none() -> None:
    frames = [*_frames_of_places([0, 0, 1]), torch.zeros(0, 128)]
    described = _described(frames)
    assert torch.isfinite(described).all()
    assert described[3].abs().max() == 0


def test_pairs_do_not_depend_on_how_many_frames_are_compared_at_a_time(monkeypatch: pytest.MonkeyPatch) -> None:
    described = _described(_frames_of_places([0, 0, 1, 1, 2, 2, 0, 1]))
    at_once = vlad.alike_pairs(described, 2)
    monkeypatch.setattr(vlad, "_ROWS", 3)
    assert vlad.alike_pairs(described, 2) == at_once
