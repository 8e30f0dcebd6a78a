"""Masks follow their images in name and size, and cannot leave nothing."""

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from PIL import Image

from swimm3r.errors import InputError
from swimm3r.prepare import read_frames
from swimm3r.prepare.image_folder import source_digest

USABLE = np.zeros((48, 64), bool)
USABLE[:, 20:] = True


@pytest.fixture
def dive(tmp_path) -> Path:
    """Four images, a.jpg to d.jpg, in images/."""
    (tmp_path / "dive" / "images").mkdir(parents=True)
    for i, name in enumerate("abcd"):
        array = np.random.default_rng(i).integers(0, 255, (48, 64, 3), dtype=np.uint8)
        Image.fromarray(array).save(tmp_path / "dive" / "images" / f"{name}.jpg")
    return tmp_path / "dive"


def write_mask(path, usable=USABLE):
    path.parent.mkdir(parents=True, exist_ok=True)
    Image.fromarray(usable.astype(np.uint8) * 255).save(path)


@pytest.mark.parametrize("name", ["{}.png", "{}.jpg.png", "{}_mask.png"])
@pytest.mark.parametrize("given", [True, False], ids=["given", "beside images"])
def test_masks_are_found_by_each_way_of_naming(dive, tmp_path, name, given):
    folder = tmp_path / "elsewhere" if given else dive / "masks"
    for stem in "abd":
        write_mask(folder / name.format(stem))
    write_mask(folder / "stranger.png")
    frames = read_frames(dive, folder=tmp_path / "prepare", masks=folder if given else None)
    for i, has in enumerate([True, True, False, True]):
        np.testing.assert_array_equal(frames.mask(i), USABLE if has else np.ones_like(USABLE))
    assert frames.warnings == ("Masks: 3 of 4 frames have one; 1 masks match no frame (stranger.png).",)


@pytest.mark.parametrize("suffix", [".png", ".jpg", ".JPG", ".tif", ".bmp", ".webp"])
@pytest.mark.parametrize("layout", ["masks", "images/masks", "masks beside images", "given", "given inside"])
def test_masks_may_have_the_very_names_of_the_images(tmp_path, suffix, layout):
    root = tmp_path / "dive" / "images" if layout in ("images/masks", "masks beside images") else tmp_path / "dive"
    folders = {
        "masks": root / "masks",
        "images/masks": root / "masks",
        "masks beside images": tmp_path / "dive" / "masks",
        "given": tmp_path / "elsewhere",
        "given inside": root / "hand-drawn",
    }
    root.mkdir(parents=True)
    folders[layout].mkdir(parents=True)
    for i in range(4):
        image = np.random.default_rng(i).integers(0, 255, (48, 64, 3), dtype=np.uint8)
        Image.fromarray(image).save(root / f"{i}{suffix}")
        mask = USABLE.astype(np.uint8) * 255
        tight: dict[str, Any]
        tight = {"quality": 100} if suffix in (".jpg", ".JPG") else {"lossless": True} if suffix == ".webp" else {}
        Image.fromarray(mask).save(folders[layout] / f"{i}{suffix}", **tight)
    masks = folders[layout] if layout.startswith("given") else None
    frames = read_frames(tmp_path / "dive", folder=tmp_path / "prepare", masks=masks)
    assert len(frames) == 4
    assert frames.warnings == ()
    for i in range(4):
        np.testing.assert_array_equal(frames.mask(i)[:, 40:], USABLE[:, 40:])
        assert frames.mask(i)[:, :10].float().mean() < 0.5  # JPEG rings
    counts = json.loads((tmp_path / "prepare" / "frames.json").read_text())["masks"]
    assert counts == {"used": 4, "unused": 0}


def test_masks_of_a_video_have_the_names_of_its_frames(tmp_path, write_video):
    images = [np.random.default_rng(i).integers(0, 255, (48, 64, 3), dtype=np.uint8) for i in range(30)]
    write_video(tmp_path / "dive.mp4", images)
    for i in range(4):
        write_mask(tmp_path / "masks" / f"frame_{i:06d}.png")
    frames = read_frames(tmp_path / "dive.mp4", folder=tmp_path / "prepare", masks=tmp_path / "masks")
    assert [frame.mask is not None for frame in frames] == [True] * 4 + [False]
    assert frames.warnings == ("Masks: 4 of 5 frames have one; 0 masks match no frame.",)


def test_masks_that_nobody_asked_for_and_that_match_nothing_are_said(dive, tmp_path):
    write_mask(dive / "masks" / "stranger.png")
    frames = read_frames(dive, folder=tmp_path / "prepare")
    assert frames.warnings == ("Masks: 0 of 4 frames have one; 1 masks match no frame (stranger.png).",)
    assert frames.unused_masks == 1


def test_a_folder_of_masks_that_is_not_there_is_noticed_first(dive, tmp_path):
    with pytest.raises(InputError, match="no folder of masks"):
        read_frames(
            dive, folder=tmp_path / "prepare", masks=tmp_path / "nowhere", progress=lambda *_: pytest.fail("prepared")
        )


def test_masks_are_found_when_the_images_folder_itself_is_given(dive, tmp_path):
    write_mask(dive / "masks" / "a.png")
    frames = read_frames(dive / "images", folder=tmp_path / "prepare")
    np.testing.assert_array_equal(frames.mask(0), USABLE)


def test_masks_between_the_images_are_masks_and_not_frames(dive, tmp_path):
    write_mask(dive / "images" / "a_mask.png")
    write_mask(dive / "images" / "b.jpg.png")
    for masks in (None, dive / "images"):
        frames = read_frames(dive, folder=tmp_path / "prepare", masks=masks)
        assert frames.names == ("a.jpg", "b.jpg", "c.jpg", "d.jpg")
        assert [frame.mask is not None for frame in frames] == [True, True, False, False]


def test_masks_of_nested_images_lie_in_nested_folders(dive, tmp_path):
    (dive / "images" / "sub").mkdir()
    (dive / "images" / "a.jpg").rename(dive / "images" / "sub" / "b.jpg")
    write_mask(dive / "masks" / "sub" / "b.png")
    frames = read_frames(dive, folder=tmp_path / "prepare")
    assert [frame.name for frame in frames if frame.mask] == ["sub/b.jpg"]


def test_masks_shrink_with_their_frames(dive, tmp_path):
    write_mask(dive / "masks" / "a.png")
    frames = read_frames(dive, folder=tmp_path / "prepare", long_side=32)
    np.testing.assert_array_equal(frames.mask(0), USABLE[::2, ::2])


def test_a_mask_of_another_size_is_refused_by_name(dive, tmp_path):
    write_mask(dive / "masks" / "a.png", USABLE[:40])
    with pytest.raises(InputError, match=r"a\.png is 64x40"):
        read_frames(dive, folder=tmp_path / "run" / "prepare")
    assert not (tmp_path / "run").exists()


def test_masks_that_cover_everything_are_refused(dive, tmp_path):
    for name in "abcd":
        write_mask(dive / "masks" / f"{name}.png", np.zeros_like(USABLE))
    with pytest.raises(InputError, match="leave nothing") as caught:
        read_frames(dive, folder=tmp_path / "run" / "prepare")
    assert "invert" in caught.value.hint
    assert not (tmp_path / "run").exists()


def test_a_frame_that_its_mask_covers_wholly_is_left_out(dive, tmp_path):
    write_mask(dive / "masks" / "b.png", np.zeros_like(USABLE))
    frames = read_frames(dive, folder=tmp_path / "prepare")
    assert frames.names == ("a.jpg", "c.jpg", "d.jpg")
    assert "1 frames were left out because their masks" in frames.warnings[-1]
    assert not (tmp_path / "prepare" / "b.jpg").exists()


def test_masks_that_match_nothing_are_refused_where_they_were_asked_for(dive, tmp_path):
    write_mask(tmp_path / "elsewhere" / "x.png")
    with pytest.raises(InputError, match="no mask in"):
        read_frames(dive, folder=tmp_path / "prepare", masks=tmp_path / "elsewhere")
    with pytest.raises(InputError, match="no folder of masks"):
        read_frames(dive, folder=tmp_path / "prepare", masks=tmp_path / "nowhere")


@pytest.mark.parametrize("place", ["elsewhere", "dive/masks"])
def test_frames_are_prepared_anew_where_masks_have_changed(dive, tmp_path, monkeypatch, place):
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))
    given = tmp_path / "elsewhere" if place == "elsewhere" else None
    for usable in (USABLE, ~USABLE):
        for stem in "abcd":
            write_mask(tmp_path / place / f"{stem}.png", usable)
        frames = read_frames(dive / "images", masks=given)
        assert np.array_equal(frames.mask(0).numpy(), usable)


def test_masks_beside_the_folder_of_images_count_in_the_digest_of_the_source(dive, monkeypatch):
    before = source_digest(dive / "images")
    write_mask(dive / "masks" / "a.png")
    masked = source_digest(dive / "images")
    write_mask(dive / "masks" / "a.png", ~USABLE)
    assert len({before, masked, source_digest(dive / "images")}) == 3
    monkeypatch.chdir(dive / "images")
    assert read_frames(".", folder=dive.parent / "prepare").frames[0].mask is not None
