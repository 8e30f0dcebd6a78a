"""Retrieval: whitening whitens, ASMK is its formula, and files carry nothing but numbers."""

import argparse
import os
import pickle
from pathlib import Path

import numpy as np
import pytest
import torch

from swimm3r.errors import WeightsError
from swimm3r.sfm.features import asmk
from swimm3r.sfm.features.asmk import AsmkSettings, Whitening


def rng(seed: int = 0) -> torch.Generator:
    return torch.Generator().manual_seed(seed)


def places(n: int = 6, features: int = 40, channels: int = 48) -> list[torch.Tensor]:
    """Frames along a path: neighbors share half of their features, noisily."""
    world = torch.randn(features * (n + 1) // 2, channels, generator=rng(1))
    step = features // 2
    return [
        world[i * step : i * step + features] + 0.1 * torch.randn(features, channels, generator=rng(10 + i))
        for i in range(n)
    ]


def slow_asmk(features: list[torch.Tensor], codebook: torch.Tensor, settings: AsmkSettings) -> torch.Tensor:
    """The formula, one pair of words at a time."""

    def signatures(x: torch.Tensor, count: int) -> dict[int, torch.Tensor]:
        sums: dict[int, torch.Tensor] = {}
        for row in x:
            for word in torch.cdist(row[None], codebook)[0].argsort()[:count].tolist():
                sums[word] = sums.get(word, torch.zeros_like(row)) + row - codebook[word]
        return {word: total > 0 for word, total in sums.items()}

    bits = 32 * ((codebook.shape[1] + 31) // 32)
    kept = [f[f.norm(dim=1).argsort(descending=True)[: settings.features]] for f in features]
    out = torch.zeros(len(features), len(features), dtype=torch.float64)
    for q, asking in enumerate(signatures(f, settings.words_when_asking) for f in kept):
        for b, found in enumerate(signatures(f, settings.words_when_found) for f in kept):
            total = 0.0
            for word in asking.keys() & found.keys():
                s = 1 - 2 * int((asking[word] ^ found[word]).sum()) / bits
                total += s**settings.power if s >= 0 else 0.0
            out[q, b] = total / (len(asking) * len(found)) ** 0.5
    return out


def test_whitened_features_have_mean_zero_and_covariance_one():
    mixing = torch.randn(12, 12, generator=rng(2), dtype=torch.float64)
    x = torch.randn(500, 12, generator=rng(), dtype=torch.float64) @ mixing + 5
    white = asmk.whiten(x, asmk.learn_whitening(x))
    torch.testing.assert_close(white.mean(0), torch.zeros(12, dtype=torch.float64), atol=1e-9, rtol=0)
    torch.testing.assert_close(white.T @ white / 500, torch.eye(12, dtype=torch.float64), atol=1e-9, rtol=0)


def test_whitening_needs_more_features_than_channels():
    with pytest.raises(ValueError, match="needs more than 12 features, got 12"):
        asmk.learn_whitening(torch.randn(12, 12))


def test_channel_without_spread_stays_finite():
    x = torch.randn(50, 4, generator=rng())
    x[:, 2] = 1.0
    assert asmk.whiten(x, asmk.learn_whitening(x)).isfinite().all()


def test_strongest_features_come_longest_first():
    x = torch.diag(torch.tensor([2.0, 5.0, 1.0, 4.0]))
    assert asmk.strongest(x, 2).norm(dim=1).tolist() == [5.0, 4.0]
    assert len(asmk.strongest(x, 99)) == 4


def test_global_descriptor_is_a_unit_vector_whatever_the_order():
    x = torch.randn(30, 8, generator=rng())
    g = asmk.global_descriptor(x)
    torch.testing.assert_close(g.norm(), torch.tensor(1.0))
    torch.testing.assert_close(asmk.global_descriptor(x.flip(0)), g)
    assert torch.equal(asmk.global_descriptor(torch.zeros(3, 8)), torch.zeros(8))


def test_cosine_finds_the_neighbors_along_a_path():
    features = places()
    similarity = asmk.cosine_similarity(torch.stack([asmk.global_descriptor(f) for f in features]))
    torch.testing.assert_close(similarity.diagonal(), torch.ones(6))
    best = similarity.topk(2, dim=1).indices
    assert best[:, 0].tolist() == list(range(6))
    assert all(abs(int(b) - i) == 1 for i, b in enumerate(best[:, 1]))


@pytest.mark.parametrize("channels", [48, 32])
def test_asmk_is_its_formula(channels: int):
    features = places(channels=channels)
    codebook = torch.randn(16, channels, generator=rng(3))
    settings = AsmkSettings(features=25)
    fast = asmk.asmk_similarity(features, codebook, settings)
    torch.testing.assert_close(fast, slow_asmk(features, codebook, settings), atol=1e-12, rtol=0)


def test_asmk_finds_the_neighbors_along_a_path():
    features = places()
    similarity = asmk.asmk_similarity(features, torch.randn(64, 48, generator=rng(3)))
    best = similarity.topk(2, dim=1).indices
    assert best[:, 0].tolist() == list(range(6))
    assert all(abs(int(b) - i) == 1 for i, b in enumerate(best[:, 1]))


def test_order_of_frames_and_features_does_not_matter_to_asmk():
    features, codebook = places(), torch.randn(16, 48, generator=rng(3))
    scores = asmk.asmk_similarity(features, codebook)
    again = asmk.asmk_similarity([f.flip(0) for f in features[::-1]], codebook)
    torch.testing.assert_close(again.flip(0, 1), scores)


def test_frame_without_features_is_like_nothing():
    features = [*places(3), torch.zeros(0, 48)]
    scores = asmk.asmk_similarity(features, torch.randn(16, 48, generator=rng(3)))
    assert not scores[3].any()
    assert not scores[:, 3].any()


def test_progress_may_stop_the_search():
    def stop(what: str, done: int, total: int) -> None:
        assert (what, total) == ("retrieval", 6)
        if done == 2:
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        asmk.asmk_similarity(places(), torch.randn(16, 48, generator=rng(3)), progress=stop)


def test_published_whitening_is_read(tmp_path: Path):
    model = {"prewhiten.m": torch.randn(1, 8, dtype=torch.float64), "prewhiten.p": torch.eye(8, dtype=torch.float64)}
    torch.save({"args": argparse.Namespace(nfeat=300), "model": model}, tmp_path / "r.pth")
    loaded = asmk.load_whitening(tmp_path / "r.pth")
    assert isinstance(loaded, Whitening)
    assert torch.equal(loaded.mean, model["prewhiten.m"][0])
    x = torch.randn(5, 8, generator=rng())
    torch.testing.assert_close(asmk.whiten(x, loaded), (x - loaded.mean).float(), atol=1e-6, rtol=0)


@pytest.mark.parametrize("protocol", [2, 4, 5])
def test_published_codebook_is_read(tmp_path: Path, protocol: int):
    centroids = np.random.default_rng(0).normal(size=(5, 8)).astype(np.float32)
    content = {"type": "Codebook", "params": {"size": 5}, "state": {"centroids": centroids}}
    (tmp_path / "c.pkl").write_bytes(pickle.dumps(content, protocol=protocol))
    assert np.array_equal(asmk.load_codebook(tmp_path / "c.pkl").numpy(), centroids)


class _Code:
    def __reduce__(self):
        return os.mkdir, ("pwned",)


@pytest.mark.parametrize(
    ("content", "message"),
    [
        (pickle.dumps({"state": {"centroids": _Code()}}), r"asks for \w+\.mkdir, which is no array"),
        (pickle.dumps({"state": {"centroids": [1, 2]}}), "no table of centroids"),
        (pickle.dumps([1]), "no table of centroids"),
        (pickle.dumps({"state": {"centroids": np.zeros((2, 2))}})[:-20], "cannot be used"),
        (b"<html>", "cannot be used"),
        (b"", "cannot be used"),
    ],
)
def test_codebook_with_anything_but_arrays_is_refused(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, content: bytes, message: str
):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "c.pkl").write_bytes(content)
    with pytest.raises(WeightsError, match=message) as caught:
        asmk.load_codebook(tmp_path / "c.pkl")
    assert caught.value.exit_code == 4
    assert not (tmp_path / "pwned").exists()


@pytest.mark.parametrize(
    ("model", "message"),
    [
        ({"fc": torch.zeros(1)}, "holds no whitening"),
        (
            {"prewhiten.m": torch.zeros(1, 2), "prewhiten.p": torch.eye(2), "projector.0.weight": torch.eye(2)},
            "training-free variant",
        ),
        ({"prewhiten.m": torch.zeros(1, 3), "prewhiten.p": torch.eye(2)}, "mean has 3 channels"),
    ],
)
def test_other_retrieval_checkpoint_is_refused(tmp_path: Path, model: dict, message: str):
    torch.save({"model": model}, tmp_path / "r.pth")
    with pytest.raises(WeightsError, match=message):
        asmk.load_whitening(tmp_path / "r.pth")


def test_damaged_or_missing_retrieval_files_are_refused(tmp_path: Path):
    (tmp_path / "r.pth").write_bytes(b"not a checkpoint")
    with pytest.raises(WeightsError, match="not a complete torch archive"):
        asmk.load_whitening(tmp_path / "r.pth")
    for load in (asmk.load_whitening, asmk.load_codebook):
        with pytest.raises(WeightsError, match="there is no file"):
            load(tmp_path / "missing")
