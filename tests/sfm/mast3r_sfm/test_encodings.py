"""Encodings on disk: made once per image and network, and which frames look alike by them."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch

from swimm3r.errors import WeightsError
from swimm3r.io import images
from swimm3r.scene.frames import Frame, Frames
from swimm3r.sfm.mast3r.network import Mast3r
from swimm3r.sfm.mast3r_sfm.encodings import EncodingStore, fingerprint, frame_similarity
from swimm3r.sfm.mast3r_sfm.network_frames import network_images
from swimm3r.sfm.settings import Mast3rSettings

SETTINGS = Mast3rSettings(size=64)


@pytest.fixture
def frames(tmp_path: Path) -> Frames:
    """Four images, of which the last is a copy of the first."""
    rng = np.random.default_rng(0)
    found = []
    for i in range(4):
        path = tmp_path / f"{i}.png"
        image = rng.random((6, 8, 3)).repeat(8, 0).repeat(8, 1) if i < 3 else images.read_rgb(found[0].path) / 255
        images.write_rgb(path, image.astype(np.float32))
        found.append(Frame(path.name, path, float(i), 1.0, "train"))
    return Frames(tuple(found), 64, 48, True)


@pytest.fixture
def store(small_network: Mast3r, frames: Frames, tmp_path: Path) -> EncodingStore:
    return EncodingStore(small_network, network_images(frames, SETTINGS), tmp_path / "encodings")


def test_an_encoding_comes_back_from_disk_as_it_was_made(store: EncodingStore, monkeypatch: pytest.MonkeyPatch):
    made = store[1]
    with monkeypatch.context() as patch:
        patch.setattr(store.network, "encode", None)
        again = store[1]
    assert torch.equal(again.tokens, made.tokens)
    assert torch.equal(again.positions, made.positions)
    assert (again.height, again.width) == (48, 64)


def test_filling_makes_what_is_missing_and_equal_images_share_a_file(store: EncodingStore):
    calls = []
    store.fill(lambda *call: calls.append(call))
    assert calls[-1] == ("encoding frames", 4, 4)
    assert len(list(store.folder.iterdir())) == 3
    store.fill(lambda *call: calls.append(call))
    assert calls[-1] == ("encoding frames", 0, 0)


def test_another_image_mask_size_or_network_is_another_encoding(
    store: EncodingStore, frames: Frames, small_network: Mast3r, tmp_path: Path
):
    images.write_rgb(tmp_path / "mask.png", np.zeros((48, 64, 3), np.uint8))
    masked = frames.select([0])
    masked = replace(masked, frames=(replace(masked.frames[0], mask=tmp_path / "mask.png"),))
    other = replace(SETTINGS, size=SETTINGS.size + 16)
    keys = {store.key(0), store.key(1)}
    keys.add(EncodingStore(small_network, network_images(masked, SETTINGS), tmp_path).key(0))
    keys.add(EncodingStore(small_network, network_images(frames, other), tmp_path).key(0))
    before = fingerprint(small_network)
    bias = small_network.enc_norm.bias
    bias.data[3] += 1e-3
    try:
        assert fingerprint(small_network) != before
        keys.add(EncodingStore(small_network, network_images(frames, SETTINGS), tmp_path).key(0))
    finally:
        bias.data[3] -= 1e-3
    assert len(keys) == 5


def test_copies_are_most_alike(store: EncodingStore):
    alike = frame_similarity(store)
    torch.testing.assert_close(alike[0, 3], torch.tensor(1.0))
    assert alike[0, 1] < 0.9
    assert alike[0, 2] < 0.9
    torch.testing.assert_close(alike, alike.T)


def test_asmk_without_its_files_says_what_is_missing(
    store: EncodingStore, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
):
    monkeypatch.setenv("SWIMM3R_WEIGHTS_DIR", str(tmp_path))
    monkeypatch.setenv("SWIMM3R_CACHE", str(tmp_path))
    with pytest.raises(WeightsError, match="'mast3r-retrieval' are not on this computer"):
        frame_similarity(store, "asmk")
