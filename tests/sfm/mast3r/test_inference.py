"""The network over a pair graph: the same answers as one pair at a time, with every image encoded once."""

import pytest
import torch

from swimm3r.sfm.mast3r.inference import EncodingCache, PairPrediction, predict_pairs
from swimm3r.sfm.mast3r.network import Encoded, Mast3r

PAIRS = [(0, 1), (0, 2), (1, 2), (1, 3), (2, 3)]


def image(i: int) -> torch.Tensor:
    height, width = (32, 48) if i != 3 else (48, 32)
    return torch.rand(3, height, width, generator=torch.Generator().manual_seed(i)) * 2 - 1


@pytest.fixture
def encodings(small_network: Mast3r, monkeypatch: pytest.MonkeyPatch) -> list[int]:
    """The widths of the images that were encoded."""
    seen = []
    plain = small_network.encode

    def encode(images: torch.Tensor) -> Encoded:
        seen.append(images.shape[3])
        return plain(images)

    monkeypatch.setattr(small_network, "encode", encode)
    return seen


def direct(network: Mast3r, i: int, j: int) -> dict[str, torch.Tensor]:
    a, b = network.encode(image(i)[None]), network.encode(image(j)[None])
    forth, back = network.decode(a, b), network.decode(b, a)
    return {
        "view_ii": network.pointmap(forth[0], 1).points[0],
        "view_ji": network.pointmap(forth[1], 2).points[0],
        "view_jj": network.pointmap(back[0], 1).points[0],
        "view_ij": network.pointmap(back[1], 2).points[0],
    }


def test_pairs_are_what_the_network_says_of_each(small_network: Mast3r):
    found = list(predict_pairs(small_network, image, PAIRS))
    assert [(p.i, p.j) for p in found] == PAIRS
    for p in found:
        for name, points in direct(small_network, p.i, p.j).items():
            view = getattr(p, name)
            torch.testing.assert_close(view.points, points)
            assert view.descriptors.shape == (*points.shape[:2], 6)
            assert (view.confidence >= 1).all()


def test_every_image_is_encoded_once(small_network: Mast3r, encodings: list[int]):
    list(predict_pairs(small_network, image, PAIRS))
    assert sorted(encodings) == [32, 48, 48, 48]


def test_small_cache_costs_encodings_but_changes_nothing(small_network: Mast3r, encodings: list[int]):
    large = list(predict_pairs(small_network, image, PAIRS))
    few = len(encodings)
    small = list(predict_pairs(small_network, image, PAIRS, cache_bytes=1))
    assert len(encodings) - few > few
    for a, b in zip(large, small, strict=True):
        assert a.view_ij.points is not None
        assert b.view_ij.points is not None
        assert torch.equal(a.view_ij.points, b.view_ij.points)


def test_cache_stays_within_its_bound():
    tokens = torch.zeros(1, 6, 64)
    positions = torch.zeros(1, 6, 2, dtype=torch.int64)
    one = tokens.nbytes + positions.nbytes
    made = []

    def encode(i: int) -> Encoded:
        made.append(i)
        return Encoded(tokens, positions, 32, 48)

    cache = EncodingCache(encode, max_bytes=2 * one)
    for i in (0, 1, 0, 2, 0, 1):
        cache[i]
        assert cache.bytes <= 2 * one
    assert made == [0, 1, 2, 1]  # 0 was used last when 2 came


def test_only_the_heads_asked_for_are_run(small_network: Mast3r, monkeypatch: pytest.MonkeyPatch):
    def fail(*args: object) -> None:
        raise AssertionError("not asked for")

    monkeypatch.setattr(small_network, "pointmap", fail)
    (found,) = predict_pairs(small_network, image, [(0, 1)], heads=(False, True))
    assert found.view_ji.points is None
    assert found.view_ji.descriptors is not None


def test_pairs_come_one_at_a_time_and_progress_may_stop_them(small_network: Mast3r):
    calls = []

    def stop(what: str, done: int, total: int) -> None:
        calls.append((what, done, total))
        if done == 2:
            raise KeyboardInterrupt

    found: list[PairPrediction] = []
    with pytest.raises(KeyboardInterrupt):
        found += predict_pairs(small_network, image, PAIRS, progress=stop)
    assert calls == [("two-view network", k, 5) for k in range(3)]
