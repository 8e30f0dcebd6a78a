"""Chunks of a long clip: every frame is in one, neighbors overlap, and unordered folders get an order from matches."""

import itertools

import numpy as np
import pytest

from swimm3r.sfm.colmap.chunks.plan import order_by_matches, plan_chunks


@pytest.mark.parametrize(
    ("frames", "size", "overlap"), [(97, 48, 8), (100, 48, 8), (875, 48, 8), (17, 8, 2), (20, 8, 6)]
)
def test_windows_cover_all_frames_and_share_the_overlap(frames: int, size: int, overlap: int) -> None:
    chunks = plan_chunks(range(frames), size, overlap)
    assert sorted(set(itertools.chain(*chunks))) == list(range(frames))
    assert {len(chunk) for chunk in chunks} == {size}
    for first, second in itertools.pairwise(chunks):
        assert len(set(first) & set(second)) >= overlap


def test_a_short_clip_is_one_chunk() -> None:
    assert plan_chunks(range(5), 8, 2) == [(0, 1, 2, 3, 4)]


def test_the_number_of_chunks_grows_with_the_frames() -> None:
    assert len(plan_chunks(range(3000), 48, 8)) == pytest.approx(10 * len(plan_chunks(range(300), 48, 8)), rel=0.1)


def test_frames_that_match_come_to_stand_near_each_other() -> None:
    shuffled = np.random.default_rng(0).permutation(60)
    pairs = [(int(shuffled[i]), int(shuffled[j])) for i in range(60) for j in range(i + 1, min(60, i + 4))]
    order = order_by_matches(60, [(min(p), max(p)) for p in pairs])
    place = np.argsort(order)
    assert sorted(order) == list(range(60))
    assert max(abs(place[i] - place[j]) for i, j in pairs) <= 6
