"""Folders of stills: names, sizes, order, masks, and what cannot be used."""

import os
from typing import Any

import cv2
import numpy as np
import pytest
import tifffile
from PIL import Image

from swimm3r.errors import InputError, UsageError
from swimm3r.io import images
from swimm3r.io.files.atomic import DRAFT
from swimm3r.io.image_header import read_header
from swimm3r.prepare import check_source, load_frames, read_frames
from swimm3r.prepare.image_folder import source_digest


def image(seed=0, height=48, width=64):
    return np.random.default_rng(seed).integers(0, 255, (height, width, 3), dtype=np.uint8)


def write(path, array, **options):
    path.parent.mkdir(parents=True, exist_ok=True)
    Image.fromarray(array).save(path, **options)
    return path


@pytest.fixture
def dive(tmp_path):
    """Twelve numbered images."""
    for i in range(12):
        write(tmp_path / "dive" / f"img{i}.png", image(i))
    return tmp_path / "dive"


@pytest.fixture
def prepared(tmp_path):
    return tmp_path / "run" / "prepare"


def fails(match, source, folder, **changes):
    """The error of an input that cannot be used; it leaves nothing behind."""
    with pytest.raises(InputError, match=match) as caught:
        read_frames(source, folder=folder, **changes)
    assert not folder.parent.exists()
    return caught.value


def test_img2_comes_before_img10(dive, prepared):
    assert read_frames(dive, folder=prepared).names == tuple(f"img{i}.png" for i in range(12))


def test_every_eighth_frame_is_held_back(dive, prepared):
    frames = read_frames(dive, folder=prepared)
    assert frames.test.names == ("img0.png", "img8.png")
    assert len(frames.train) == 10


def test_frames_come_back_from_their_folder(dive, prepared):
    frames = read_frames(dive, folder=prepared)
    assert load_frames(prepared) == frames
    assert frames.ordered
    assert (frames.width, frames.height) == (64, 48)
    np.testing.assert_allclose(frames.image(3) * 255, image(3), atol=1e-3)


def test_images_that_serve_as_they_are_are_links(dive, prepared):
    frames = read_frames(dive, folder=prepared)
    assert all(os.path.samefile(frame.path, dive / frame.name) for frame in frames)


def test_without_links_images_are_copied(dive, prepared, monkeypatch):
    def refuse(*_, **__):
        raise OSError(18, "Invalid cross-device link")

    monkeypatch.setattr(os, "link", refuse)
    frames = read_frames(dive, folder=prepared)
    assert not os.path.samefile(frames.frames[0].path, dive / "img0.png")
    assert frames.frames[0].path.read_bytes() == (dive / "img0.png").read_bytes()


def test_large_images_are_scaled_to_the_long_side(dive, prepared):
    frames = read_frames(dive, folder=prepared, long_side=32)
    assert (frames.width, frames.height) == (32, 24)
    expected = cv2.resize(image(1), (32, 24), interpolation=cv2.INTER_AREA)
    np.testing.assert_allclose(frames.image(1) * 255, expected, atol=1e-3)


def test_sixteen_bits_stay_and_float_tiff_becomes_sixteen(tmp_path, prepared):
    for i in range(3):
        deep = image(i).astype(np.uint16) * 257 + 3
        assert images.read_rgb(write_deep(tmp_path / "dive" / f"{i}.png", deep)).dtype == np.uint16
        tifffile.imwrite(tmp_path / "dive" / f"t{i}.tif", image(i).astype(np.float32) / 255, photometric="rgb")
    frames = read_frames(tmp_path / "dive", folder=prepared)
    for i in range(3):
        np.testing.assert_allclose(frames.image(i) * 65535, image(i).astype(float) * 257 + 3, atol=0.01)
        assert frames.frames[i + 3].path.suffix == ".png"  # what every later reader opens
        np.testing.assert_allclose(frames.image(i + 3), image(i) / 255, atol=1e-5)


def write_deep(path, array):
    path.parent.mkdir(parents=True, exist_ok=True)
    cv2.imwrite(str(path), array[..., ::-1])
    return path


def test_alpha_gray_and_turned_images_come_out_plain(tmp_path, prepared):
    exif = Image.Exif()
    exif[274] = 6
    turned = image(0, 64, 48)
    for i in range(2):
        write(tmp_path / "dive" / f"alpha{i}.png", np.dstack([image(i), np.full((48, 64), 5, np.uint8)]))
        write(tmp_path / "dive" / f"gray{i}.png", image(i)[..., 0])
        write(tmp_path / "dive" / f"turned{i}.png", turned, exif=exif)
    frames = read_frames(tmp_path / "dive", folder=prepared)
    assert (frames.width, frames.height) == (64, 48)
    for frame in frames:
        assert read_header(frame.path).plain
    np.testing.assert_allclose(frames.image(0) * 255, image(0), atol=1e-3)
    np.testing.assert_allclose(frames.image(2) * 255, image(0)[..., [0, 0, 0]], atol=1e-3)
    np.testing.assert_allclose(frames.image(4) * 255, np.rot90(turned, -1), atol=1e-3)


def test_equal_names_in_nested_folders_stay_apart(tmp_path, prepared):
    for i, name in enumerate(("a.jpg", "one/a.jpg", "two/a.jpg", "two/deep/a.jpg")):
        write(tmp_path / "dive" / name, image(i))
    frames = read_frames(tmp_path / "dive", folder=prepared)
    assert sorted(frames.names) == ["a.jpg", "one/a.jpg", "two/a.jpg", "two/deep/a.jpg"]
    assert not frames.ordered


def test_names_stay_unique_without_their_suffix(tmp_path, prepared):
    for i, name in enumerate(("a.jpg", "a.png", "A.tif", "a_png.png", "b.tif")):
        write(tmp_path / "dive" / name, image(i))
    frames = read_frames(tmp_path / "dive", folder=prepared)
    stems = {name.rsplit(".", 1)[0].lower() for name in frames.names}
    assert len(stems) == len(frames) == 5
    assert "b.png" in frames.names
    contents = {round(float(frames.image(i).sum()), 1) for i in range(5)}
    assert len(contents) == 5


def test_the_images_folder_is_taken_where_a_dive_has_one(dive, tmp_path, prepared):
    (tmp_path / "set").mkdir()
    dive.rename(tmp_path / "set" / "images")
    write(tmp_path / "set" / "depth_mm" / "img0.png", image(50))
    assert read_frames(tmp_path / "set", folder=prepared).names[0] == "img0.png"
    assert len(load_frames(prepared)) == 12


def test_the_digest_of_a_folder_is_that_of_its_files_without_runs_and_what_systems_leave(dive):
    before = source_digest(dive, dive / "run")
    for path in ("run/prepare/frames.json", "other/prepare/frames.json", "other/log.jsonl", ".DS_Store", "Thumbs.db"):
        (dive / path).parent.mkdir(parents=True, exist_ok=True)
        (dive / path).write_bytes(b"{}")
    assert source_digest(dive, dive / "run") == before
    write(dive / "img0.png", image(77))
    assert source_digest(dive, dive / "run") != before


def test_files_that_are_passed_over_beside_the_images_are_told(dive, prepared):
    for name in ("a.HEIC", "b.heic", "c.jxl", "GX010042.MP4"):
        (dive / name).write_bytes(b"not looked into")
    told = " ".join(read_frames(dive, folder=prepared).warnings)
    assert "3 images of formats that are not read (HEIC, JPEG XL ...) lie beside the images and were left out" in told
    assert "1 videos lie beside the images" in told
    assert "raw" not in told


def test_digits_that_are_no_decimals_are_letters_of_a_name(tmp_path, prepared):
    for i in range(3):
        write(tmp_path / "dive" / f"4\u00b2{i}.png", image(i))
    assert len(read_frames(tmp_path / "dive", folder=prepared)) == 3


def test_run_folders_inside_the_input_are_not_images(dive):
    first = read_frames(dive, folder=dive / "run" / "prepare", long_side=32)
    assert read_frames(dive, folder=dive / "run" / "prepare", long_side=32).names == first.names
    assert read_frames(dive, folder=dive / "another" / "prepare").names == first.names
    assert read_frames(dive, folder=dive / "prepare").names == first.names
    assert read_frames(dive, folder=dive / "prepare").names == first.names


def test_hidden_files_are_not_images(dive, prepared):
    write(dive / "__MACOSX" / "img0.png", image(1))
    (dive / "._img0.png").write_bytes(b"resource fork")
    assert len(read_frames(dive, folder=prepared)) == 12


def test_the_cameras_clock_orders_and_times_images(tmp_path, prepared):
    for name, clock, fraction in (("a", "12:00:05", "50"), ("b", "12:00:01", "125"), ("c", "12:00:01", "250")):
        exif = Image.Exif()
        exif.get_ifd(0x8769).update({36867: f"2024:05:01 {clock}", 37521: fraction})
        write(tmp_path / "dive" / f"{name}.jpg", image(ord(name)), exif=exif)
    frames = read_frames(tmp_path / "dive", folder=prepared)
    assert frames.names == ("b.jpg", "c.jpg", "a.jpg")
    np.testing.assert_allclose([frame.time for frame in frames], [0, 0.125, 4.375])
    assert frames.ordered
    assert any("clock" in warning for warning in frames.warnings)
    assert frames.recorded == load_frames(prepared).recorded == "2024-05-01T12:00:01.125000"
    assert frames.timed


def test_without_a_clock_on_every_image_time_is_the_index(dive, prepared):
    exif = Image.Exif()
    exif.get_ifd(0x8769)[36867] = "2024:05:01 12:00:00"
    (dive / "img5.png").unlink()
    write(dive / "img5.jpg", image(5), exif=exif)
    frames = read_frames(dive, folder=prepared)
    assert [frame.time for frame in frames] == list(range(12))
    assert frames.recorded == "2024-05-01T12:00:00"
    assert not frames.timed
    assert not load_frames(prepared).timed


def test_without_any_clock_no_date_is_made_up(dive, prepared):
    assert read_frames(dive, folder=prepared).recorded is None


def test_sharper_images_score_higher(tmp_path, prepared):
    sharp = cv2.resize(image(0), (640, 480), interpolation=cv2.INTER_CUBIC)
    for i, sigma in enumerate((0.01, 2, 4)):
        write(tmp_path / "dive" / f"{i}.png", cv2.GaussianBlur(sharp, (0, 0), sigma))
    first, second, third = (frame.sharpness for frame in read_frames(tmp_path / "dive", folder=prepared))
    assert first > second > third > 0


def test_a_limit_spreads_over_the_whole_dive(dive, prepared):
    frames = read_frames(dive, folder=prepared, max_frames=4)
    assert frames.names == ("img0.png", "img4.png", "img7.png", "img11.png")
    assert {path.name for path in prepared.iterdir()} == {*frames.names, "frames.json"}


def test_one_broken_image_among_good_ones_is_left_out_and_named(dive, prepared):
    (dive / "img3.png").write_bytes((dive / "img3.png").read_bytes()[:2000])
    (dive / "img4.png").write_bytes(b"")
    frames = read_frames(dive, folder=prepared)
    assert len(frames) == 10
    (warning,) = frames.warnings
    assert "2 of 12" in warning
    assert "img3.png" in warning
    assert "img4.png" in warning


def test_black_images_are_left_out_and_counted(dive, prepared):
    write(dive / "img3.png", np.zeros((48, 64, 3), np.uint8))
    frames = read_frames(dive, folder=prepared)
    assert "img3.png" not in frames.names
    assert "1 images show nothing" in frames.warnings[0]
    assert frames.test.names == ("img0.png", "img9.png")  # counted over the frames that are kept


def test_all_black_images_are_refused(tmp_path, prepared):
    for i in range(6):
        write(tmp_path / "dive" / f"{i}.png", np.full((48, 64, 3), 2, np.uint8))
    assert "6 images show nothing" in fails("0 usable frames", tmp_path / "dive", prepared).cause


def test_too_few_images_are_refused(tmp_path, prepared):
    write(tmp_path / "dive" / "a.png", image())
    fails("1 usable frame,", tmp_path / "dive", prepared)


def test_an_empty_folder_is_refused(tmp_path, prepared):
    (tmp_path / "dive").mkdir()
    fails("it is empty", tmp_path / "dive", prepared)


def test_a_folder_of_other_things_says_what_is_there(tmp_path, prepared):
    (tmp_path / "dive").mkdir()
    for i in range(3):
        (tmp_path / "dive" / f"{i}.heic").write_bytes(b"none that is read")
    fails(r"only 3 \.heic", tmp_path / "dive", prepared)


def test_no_such_file_is_refused(tmp_path, prepared):
    fails("there is no", tmp_path / "dive.mp4", prepared)
    with pytest.raises(InputError):
        check_source(tmp_path / "dive.mp4")


def test_a_single_image_is_refused(tmp_path, prepared):
    fails("single image", write(tmp_path / "a.jpg", image()), prepared)


def test_mixed_sizes_are_refused_by_name_or_left_out(dive, prepared):
    write(dive / "img2.png", image(2, 60, 60))
    error = fails(r"img2\.png \(60x60\)", dive, prepared)
    assert "skip" in error.hint
    frames = read_frames(dive, folder=prepared, odd_sizes="skip")
    assert len(frames) == 11
    assert "img2.png (60x60)" in frames.warnings[0]


def test_a_folder_in_use_is_not_touched(dive, tmp_path):
    (tmp_path / "letters").mkdir()
    (tmp_path / "letters" / "dear.txt").write_text("diver")
    with pytest.raises(InputError, match="not empty"):
        read_frames(dive, folder=tmp_path / "letters")
    assert [path.name for path in (tmp_path / "letters").iterdir()] == ["dear.txt"]


def test_what_progress_raises_stops_the_work_and_leaves_nothing(dive, prepared):
    def impatient(what, done, total, /):
        if done == 5:
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        read_frames(dive, folder=prepared, progress=impatient)
    assert not prepared.parent.exists()


def test_the_remains_of_a_killed_run_do_not_matter(dive, prepared):
    write(prepared.parent / f"{DRAFT}prepare" / "img99.png", image(99))
    assert len(read_frames(dive, folder=prepared)) == 12
    assert [path.name for path in prepared.parent.iterdir()] == ["prepare"]


def test_other_settings_replace_what_was_prepared(dive, prepared):
    stale = read_frames(dive, folder=prepared)
    assert stale.image(0).shape == (48, 64, 3)
    fresh = read_frames(dive, folder=prepared, long_side=32, max_frames=3)
    assert fresh.image(0).shape == (24, 32, 3)
    assert len(list(prepared.glob("*.png"))) == 3


def test_without_a_folder_the_cache_is_used_and_found_again(dive, tmp_path, monkeypatch):
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))
    frames = read_frames(str(dive), long_side=32)
    assert frames.frames[0].path.is_relative_to(tmp_path / "cache" / "swimm3r")
    written = frames.frames[0].path.stat().st_mtime_ns
    assert read_frames(dive, long_side=32).frames[0].path.stat().st_mtime_ns == written
    assert read_frames(dive, long_side=40).width == 40
    write(dive / "img0.png", image(77))
    assert read_frames(dive, long_side=32).frames[0].path != frames.frames[0].path


def test_frames_of_a_relative_folder_are_found_from_another_one(dive, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    frames = (read_frames(dive, folder="prepare"), load_frames("prepare"))
    monkeypatch.chdir(dive)
    assert all(each.image(0).shape == each.image(11).shape for each in frames)


def test_settings_that_make_no_sense_are_refused(dive, prepared):
    cases: list[dict[str, Any]]
    cases = [{"fps": -1.0}, {"fps": float("nan")}, {"start": 5.0, "end": 5.0}, {"long_side": -1}]
    for changes in cases:
        with pytest.raises(UsageError):
            read_frames(dive, folder=prepared, **changes)


def test_frames_json_cannot_lead_out_of_its_folder(dive, prepared):
    read_frames(dive, folder=prepared)
    text = (prepared / "frames.json").read_text()
    for evil in ("../../dive/img0.png", str(dive / "img0.png")):
        (prepared / "frames.json").write_text(text.replace('"img0.png"', f'"{evil}"'))
        with pytest.raises(InputError, match="outside its folder"):
            load_frames(prepared)


def test_a_damaged_preparation_says_so(dive, prepared):
    frames = read_frames(dive, folder=prepared)
    frames.frames[2].path.unlink()
    with pytest.raises(InputError, match=r"img2\.png is missing"):
        load_frames(prepared)
    (prepared / "frames.json").write_text("{")
    with pytest.raises(InputError, match="is damaged"):
        load_frames(prepared)


@pytest.mark.shared
def test_real_folders_read_whole(shared, tmp_path):
    frames = read_frames(shared / "data" / "rov_vent_a", folder=tmp_path / "prepare")
    assert (len(frames), len(frames.train), frames.width, frames.height) == (20, 17, 960, 640)
    with pytest.raises(InputError, match="not of one size"):
        read_frames(shared / "data" / "uieb_pairs", folder=tmp_path / "other")


def test_a_full_disk_leaves_nothing_and_keeps_its_own_error(dive, prepared, monkeypatch):
    def full(*_):
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(images, "write_rgb", full)
    with pytest.raises(OSError, match="No space left"):
        read_frames(dive, folder=prepared, long_side=32)
    assert not prepared.parent.exists()
