"""Kinds of files in the place of a source or of its images, and their names."""

import json
import os
import socket
import struct
import zlib

import numpy as np
import pytest
from PIL import Image

from swimm3r.cli.main import main
from swimm3r.errors import InputError
from swimm3r.prepare import check_source, read_frames
from swimm3r.prepare.candidates import is_gray

NOBODY = 65534


def image(seed, height=48, width=64):
    return np.random.default_rng(seed).integers(0, 255, (height, width, 3), dtype=np.uint8)


@pytest.fixture
def dive(tmp_path):
    """Six images, 0.png to 5.png."""
    (tmp_path / "dive").mkdir()
    for i in range(6):
        Image.fromarray(image(i)).save(tmp_path / "dive" / f"{i}.png")
    return tmp_path / "dive"


@pytest.fixture
def unprivileged(tmp_path):
    """Nobody may look into tmp_path/closed."""
    (tmp_path / "closed" / "dive").mkdir(parents=True)
    (tmp_path / "closed" / "dive.mp4").write_bytes(b"a video")
    (tmp_path / "closed").chmod(0)
    before = os.geteuid()
    if before == 0:
        os.seteuid(NOBODY)
    yield tmp_path / "closed"
    os.seteuid(before)
    (tmp_path / "closed").chmod(0o700)


def test_a_pipe_a_device_and_a_socket_are_no_videos(tmp_path):
    os.mkfifo(tmp_path / "pipe.mp4")
    (tmp_path / "device.mp4").symlink_to("/dev/zero")
    with socket.socket(socket.AF_UNIX) as server:
        server.bind(str(tmp_path / "socket.mp4"))
        for name in ("pipe.mp4", "device.mp4", "socket.mp4"):
            with pytest.raises(InputError, match="a pipe, a device or a socket"):
                check_source(tmp_path / name)


def test_a_pipe_among_the_images_is_left_out_and_named(dive, tmp_path):
    os.mkfifo(dive / "pipe.png")
    (dive / "device.png").symlink_to("/dev/zero")
    frames = read_frames(dive, folder=tmp_path / "prepare")
    assert len(frames) == 6
    (warning,) = frames.warnings
    assert "2 of 8 files cannot be read" in warning
    assert "pipe.png" in warning


def test_a_pipe_among_the_masks_is_refused(dive, tmp_path):
    (dive / "masks").mkdir()
    os.mkfifo(dive / "masks" / "0.png")
    with pytest.raises(InputError, match="a pipe"):
        read_frames(dive, folder=tmp_path / "prepare")


def test_what_may_not_be_read_is_an_input_error(unprivileged):
    for source in (unprivileged, unprivileged / "dive", unprivileged / "dive.mp4"):
        with pytest.raises(InputError, match="Permission denied"):
            check_source(source)


def test_a_subfolder_that_may_not_be_searched_is_left_out_and_named(dive, tmp_path, monkeypatch):
    (dive / "lost+found").mkdir()
    scandir = os.scandir

    def guarded(path="."):
        if str(path).endswith("lost+found"):
            raise PermissionError(13, "Permission denied", str(path))
        return scandir(path)

    monkeypatch.setattr(os, "scandir", guarded)
    frames = read_frames(dive, folder=tmp_path / "prepare")
    assert len(frames) == 6
    assert frames.warnings == ("1 folders may not be searched and were left out (lost+found).",)


def test_a_name_that_is_too_long_is_an_input_error(tmp_path):
    with pytest.raises(InputError, match="too long"):
        check_source(tmp_path / ("a" * 300 + ".mp4"))


def test_names_that_are_not_utf_8_become_names_that_are(dive, tmp_path):
    for i, name in enumerate((b"caf\xe9.png", b"caf\xe8.png", b"caf\n.png")):
        Image.fromarray(image(i)).save(tmp_path / "p.png")
        os.rename(tmp_path / "p.png", os.fsencode(dive) + b"/" + name)
    frames = read_frames(dive, folder=tmp_path / "prepare")
    assert len(set(frames.names)) == 9
    for i, frame in enumerate(frames):
        frame.name.encode()
        assert frame.name.isprintable()
        assert frames.image(i).shape == (48, 64, 3)


def test_masks_follow_names_of_any_bytes_and_length(dive, tmp_path):
    (dive / "masks").mkdir()
    for name in (b"caf\xe9", b"a" * 251, "\N{GREEK SMALL LETTER ALPHA}".encode() * 125):
        Image.fromarray(image(7)).save(tmp_path / "p.png")
        os.rename(tmp_path / "p.png", os.fsencode(dive) + b"/" + name + b".png")
        Image.fromarray(np.full((48, 64), 255, np.uint8)).save(tmp_path / "m.png")
        os.rename(tmp_path / "m.png", os.fsencode(dive / "masks") + b"/" + name + b".png")
    frames = read_frames(dive, folder=tmp_path / "prepare")
    assert len(frames) == 9
    assert sum(frame.mask is not None for frame in frames) == 3
    for frame in frames:
        assert len(os.fsencode(frame.name)) < 220  # room for NAME_z_depth.png and its draft
    long = [frame.name for frame in frames if frame.name.startswith("aaa")]
    assert len(long) == 1


def test_two_long_names_with_one_beginning_stay_apart(dive, tmp_path):
    for end in "bc":
        Image.fromarray(image(ord(end))).save(dive / f"{'a' * 240}{end}.png")
    assert len(set(read_frames(dive, folder=tmp_path / "prepare").names)) == 8


def test_the_command_takes_a_source_of_any_name(dive, tmp_path):
    named = os.fsdecode(os.fsencode(tmp_path) + b"/div\xe9")
    os.rename(dive, named)
    main(["prepare", named, "--out", str(tmp_path / "run")])
    about = json.loads((tmp_path / "run" / "summary.json").read_text())["input"]
    assert about["frames"] == 6
    assert (about["gray"], about["masks"]) == (False, {"used": 0, "unused": 0})


def test_a_bomb_is_left_out_and_named_and_the_rest_goes_on(dive, tmp_path):
    data = (dive / "0.png").read_bytes()
    header = b"IHDR" + struct.pack(">II", 60000, 60000) + data[24:29]
    (dive / "bomb.png").write_bytes(data[:12] + header + struct.pack(">I", zlib.crc32(header)) + data[33:])
    frames = read_frames(dive, folder=tmp_path / "prepare")
    assert len(frames) == 6
    (warning,) = frames.warnings
    assert "1 of 7 files were left out" in warning
    assert "bomb.png has 60000x60000 pixels" in warning


def test_a_folder_with_one_video_stands_for_it(tmp_path, write_video):
    (tmp_path / "dcim" / "100GOPRO").mkdir(parents=True)
    write_video(tmp_path / "dcim" / "100GOPRO" / "GX01.MP4", [image(i) for i in range(30)])
    (tmp_path / "dcim" / "notes.txt").write_text("visibility 5 m")
    assert check_source(tmp_path / "dcim") == tmp_path / "dcim" / "100GOPRO" / "GX01.MP4"
    assert len(read_frames(tmp_path / "dcim", folder=tmp_path / "prepare")) == 5


def test_of_several_videos_none_is_chosen(tmp_path):
    for name in ("a.mp4", "b.mov"):
        (tmp_path / name).write_bytes(b"a video")
    with pytest.raises(InputError, match=r"no images and 2 videos: a\.mp4, b\.mov"):
        check_source(tmp_path)


def test_images_come_before_a_video_beside_them(dive):
    (dive / "a.mp4").write_bytes(b"a video")
    assert check_source(dive) == dive


def test_a_time_stamp_in_color_leaves_an_image_gray_and_a_tint_does_not():
    gray = np.repeat(image(0)[..., :1], 3, 2)
    stamped = gray.copy()
    stamped[0, : gray.shape[0] * gray.shape[1] // 1100, 0] ^= 64
    assert is_gray(gray)
    assert is_gray(stamped)
    assert not is_gray(np.clip(gray * np.array([1.0, 0.9, 1.0]) + 4, 0, 255).astype(np.uint8))
    assert not is_gray(image(0))


def test_equal_channels_are_said_to_be_gray(dive, tmp_path, write_video):
    assert not read_frames(dive, folder=tmp_path / "colored").gray
    for path in dive.iterdir():
        Image.open(path).convert("L").convert("RGB").save(path.with_suffix(".jpg"))
        path.unlink()
    gray = [np.repeat(image(i)[..., :1], 3, 2) for i in range(30)]
    video = write_video(tmp_path / "gray.mp4", gray)
    for source in (dive, video):
        assert read_frames(source, folder=tmp_path / "prepare" / source.name).gray
