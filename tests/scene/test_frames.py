"""Frames load from disk one at a time, and only so many stay in memory."""

from dataclasses import replace

import numpy as np
import pytest
import torch

from swimm3r.errors import InputError
from swimm3r.io import images
from swimm3r.io.files.cache import ArrayCache
from swimm3r.scene import frames as frames_module
from swimm3r.scene.frames import Frame, Frames


@pytest.fixture
def dive(tmp_path):
    """Thirty images of 48 KB each."""
    listed = []
    for i in range(30):
        path = tmp_path / f"{i}.png"
        images.write_rgb(path, np.full((100, 160, 3), i, np.uint8))
        listed.append(Frame(path.name, path, i / 5, 1.0, "test" if i % 8 == 0 else "train"))
    return Frames(tuple(listed), 160, 100, ordered=True)


def test_train_and_test_part_the_frames(dive):
    assert len(dive.train) + len(dive.test) == len(dive)
    assert not set(dive.train.names) & set(dive.test.names)
    assert dive.test.names == ("0.png", "8.png", "16.png", "24.png")


def test_images_are_floats_from_nought_to_one_whatever_their_depth(dive, tmp_path):
    torch.testing.assert_close(dive.image(20), torch.full((100, 160, 3), 20 / 255))
    images.write_rgb(tmp_path / "20.png", np.full((100, 160, 3), 30000, np.uint16))
    torch.testing.assert_close(dive.image(20), torch.full((100, 160, 3), 30000 / 65535))


def test_colors_of_some_pixels_are_those_of_the_image(dive):
    pixels = torch.tensor([0, 5, dive.width + 3, dive.width * dive.height - 1])
    assert torch.equal(dive.colors(1, pixels), dive.image(1).reshape(-1, 3)[pixels])


def test_the_cache_keeps_a_few_images_however_large_they_are(dive, monkeypatch):
    cache = ArrayCache(max_bytes=1, least_entries=2)
    monkeypatch.setattr(frames_module, "_CACHE", cache)
    for i in range(len(dive)):
        dive.image(i)
    assert cache.nbytes == 2 * dive.width * dive.height * 3


def test_a_frame_without_a_mask_may_be_used_everywhere(dive):
    assert dive.mask(3).shape == (100, 160)
    assert dive.mask(3).all()


def test_the_cache_never_holds_more_than_it_may(dive, monkeypatch):
    cache = ArrayCache(max_bytes=200_000)  # four images
    monkeypatch.setattr(frames_module, "_CACHE", cache)
    held = []
    for i in (*range(30), *range(30)):
        assert dive.image(i)[0, 0, 0] == pytest.approx(i / 255)
        held.append(cache.nbytes)
    assert max(held) == 4 * 48_000


def test_what_is_in_use_is_not_read_again(dive, monkeypatch):
    reads = []
    read = images.read_rgb
    monkeypatch.setattr(images, "read_rgb", lambda path: reads.append(path) or read(path))
    monkeypatch.setattr(frames_module, "_CACHE", ArrayCache(max_bytes=200_000))
    for i in (0, 1, 2, 0, 1, 2, 0):
        dive.image(i)
    assert len(reads) == 3


def test_changing_a_loaded_image_does_not_change_the_next_load(dive):
    dive.image(5).zero_()
    assert dive.image(5).min() == pytest.approx(5 / 255)


@pytest.mark.parametrize("what", ["image", "mask"])
def test_a_file_of_another_size_than_the_frames_is_named(what: str, dive, tmp_path):
    small = tmp_path / "small.png"
    images.write_rgb(small, np.full((50, 80, 3), 255, np.uint8))
    frame = replace(dive.frames[3], path=small) if what == "image" else replace(dive.frames[3], mask=small)
    damaged = replace(dive, frames=(frame,))
    with pytest.raises(InputError, match=r"small\.png is 80 x 50, the frames are 160 x 100"):
        damaged.image(0) if what == "image" else damaged.mask(0)
