"""Frames of one place are more alike than frames of two places."""

import torch
from torch.nn.functional import normalize

from swimm3r.sfm.features import vlad


def _frames_of_places(places: list[int]) -> list[torch.Tensor]:
    generator = torch.Generator().manual_seed(0)
    scene = {place: torch.rand(300, 128, generator=generator) ** 3 for place in sorted(set(places))}
    return [normalize(scene[p] + 0.05 * torch.rand(300, 128, generator=generator), dim=1) for p in places]


def test_a_place_seen_again_is_found_among_all_frames() -> None:
    places = [0, 0, 1, 1, 2, 2, 0, 1]
    alike = vlad.similarity(_frames_of_places(places), torch.Generator().manual_seed(0))
    same = torch.tensor(places)[:, None] == torch.tensor(places)
    off = ~torch.eye(8, dtype=torch.bool)
    assert alike[same & off].min() > alike[~same].max()


def test_loops_leave_out_neighbors_in_time() -> None:
    alike = vlad.similarity(_frames_of_places([0, 0, 1, 1, 2, 2, 0, 1]), torch.Generator().manual_seed(0))
    pairs = vlad.alike_pairs(alike, 1, apart=2)
    assert {(0, 6), (1, 6), (2, 7), (3, 7)} <= set(pairs)
    assert all(j - i > 2 for i, j in pairs)
    assert pairs == sorted(pairs)


def test_a_frame_without_keypoints_resembles_none() -> None:
    frames = [*_frames_of_places([0, 0, 1]), torch.zeros(0, 128)]
    alike = vlad.similarity(frames, torch.Generator().manual_seed(0))
    assert torch.isfinite(alike).all()
    assert alike[3].abs().max() == 0
