"""Rigs of folders: images of one instant by name, time or order; partners that are missing; parts by instants."""

import logging
import shutil

import pytest
import torch
import yaml
from tests.prepare.test_image_folder import image, write

from swimm3r.errors import InputError, UsageError
from swimm3r.prepare import load_frames, read_frames


@pytest.fixture
def stereo(tmp_path):
    """Ten instants of a left and a right camera."""
    for i in range(10):
        for k, side in enumerate(("left", "right")):
            write(tmp_path / "dive" / side / f"{i:04d}.png", image(2 * i + k))
    return tmp_path / "dive"


@pytest.fixture
def prepared(tmp_path):
    return tmp_path / "run" / "prepare"


def shifted(tmp_path, seconds):
    """Two cameras of 10 images per second whose names are stamps; the second is later."""
    for i in range(10):
        for k, name in enumerate(("cam0", "cam1")):
            stamp = round((1_600_000_000 + 0.1 * i + k * seconds) * 1e6)
            write(tmp_path / "dive" / name / f"{stamp}.png", image(2 * i + k))
    return tmp_path / "dive"


def test_left_and_right_are_a_stereo_pair_and_that_is_said(stereo, prepared, caplog):
    with caplog.at_level(logging.INFO):
        frames = read_frames(stereo, folder=prepared)
    assert frames.rig is not None
    assert frames.rig.names == ("left", "right")
    assert frames.names[:4] == ("left/0000.png", "right/0000.png", "left/0001.png", "right/0001.png")
    assert [frame.instant for frame in frames] == [i // 2 for i in range(20)]
    assert [frame.camera for frame in frames] == ["left", "right"] * 10
    assert "stereo pair" in caplog.text


def test_all_images_of_an_instant_are_for_testing_or_none(stereo, prepared):
    frames = read_frames(stereo, folder=prepared)
    assert {frame.instant for frame in frames.test} == {0, 8}
    assert len(frames.test) == 4


def test_a_rig_comes_back_from_its_folder(stereo, prepared):
    frames = read_frames(stereo, folder=prepared)
    assert load_frames(prepared) == frames


def test_none_takes_the_folders_as_one_camera(stereo, prepared):
    frames = read_frames(stereo, folder=prepared, rig=("none",))
    assert frames.rig is None
    assert all(frame.camera is None for frame in frames)


def test_other_folders_are_a_rig_only_when_named(stereo, prepared):
    (stereo / "left").rename(stereo / "port")
    (stereo / "right").rename(stereo / "starboard")
    assert read_frames(stereo, folder=prepared).rig is None
    shutil.rmtree(prepared)
    frames = read_frames(stereo, folder=prepared, rig=("starboard", "port"))
    assert frames.names[:2] == ("starboard/0000.png", "port/0000.png")


def test_names_of_cameras_may_end_as_a_shell_completes_them_and_lie_right_in_the_input(stereo, prepared):
    frames = read_frames(stereo, folder=prepared, rig=("left/", "right/"))
    assert frames.names[:2] == ("left/0000.png", "right/0000.png")
    with pytest.raises(UsageError, match="dive/left, which is no name of a folder right in"):
        read_frames(stereo.parent, folder=prepared, rig=("dive/left", "dive/right"))


def test_a_third_folder_leaves_the_choice_to_the_user(stereo, prepared):
    write(stereo / "top" / "0000.png", image(99))
    assert read_frames(stereo, folder=prepared).rig is None


def test_a_camera_that_is_not_there_is_named(stereo, prepared):
    with pytest.raises(InputError, match="no camera middle, only left, right"):
        read_frames(stereo, folder=prepared, rig=("left", "middle"))
    with pytest.raises(UsageError, match="left alone"):
        read_frames(stereo, folder=prepared, rig=("left",))


def test_names_may_hold_the_camera(tmp_path, prepared):
    for i in range(6):
        write(tmp_path / "dive" / "left" / f"left_{i:03d}.png", image(i))
        write(tmp_path / "dive" / "right" / f"R-{i:03d}.png", image(50 + i))
    frames = read_frames(tmp_path / "dive", folder=prepared)
    assert len({frame.instant for frame in frames}) == 6


def test_a_few_missing_partners_are_told_and_their_images_used(stereo, prepared):
    (stereo / "right" / "0004.png").unlink()
    frames = read_frames(stereo, folder=prepared)
    assert len(frames) == 19
    assert "1 of 10 instants lack the image of a camera (left/0004.png)" in frames.warnings[0]
    assert [frame.name for frame in frames if frame.instant == 4] == ["left/0004.png"]


@pytest.mark.parametrize("form", ["frame_{:03d}", "{:d}", "{camera}_{:02d}"])
def test_cameras_that_are_called_by_a_number_leave_the_numbers_of_their_images_alone(tmp_path, prepared, form):
    names = {camera: [form.format(i, camera=camera) for i in range(12)] for camera in ("0", "1")}
    for camera, own in names.items():
        for i, name in enumerate(own):
            write(tmp_path / "dive" / camera / f"{name}.png", image(i))
    frames = read_frames(tmp_path / "dive", folder=prepared, rig=("0", "1"))
    together = [(f"0/{a}.png", f"1/{b}.png") for a, b in zip(names["0"], names["1"], strict=True)]
    assert list(zip(frames.names[::2], frames.names[1::2], strict=True)) == together


def test_many_missing_partners_are_refused_with_the_counts(stereo, prepared):
    for i in range(4):
        (stereo / "right" / f"{i:04d}.png").unlink()
    with pytest.raises(InputError, match=r"4 of 10 instants .* 10 images of left, 6 images of right") as caught:
        read_frames(stereo, folder=prepared)
    assert caught.value.exit_code == 3
    assert not prepared.exists()
    assert len(read_frames(stereo, folder=prepared, rig_missing=0.5)) == 16


def test_stamps_in_names_pair_images_within_the_tolerance(tmp_path, prepared):
    frames = read_frames(shifted(tmp_path, 0.004), folder=prepared, rig=("cam0", "cam1"))
    assert len({frame.instant for frame in frames}) == 10
    assert frames.frames[2].time == pytest.approx(0.1)
    assert frames.recorded == "2020-09-13T12:26:40"
    assert frames.timed


def test_cameras_that_are_not_synchronized_are_refused_with_their_difference(tmp_path, prepared):
    source = shifted(tmp_path, 0.04)
    with pytest.raises(InputError, match=r"20 of 20 instants .* 0.04 s apart in the median") as caught:
        read_frames(source, folder=prepared, rig=("cam0", "cam1"))
    assert "--rig-tolerance" in caught.value.hint
    frames = read_frames(source, folder=prepared, rig=("cam0", "cam1"), rig_tolerance=0.05)
    assert len({frame.instant for frame in frames}) == 10


def test_order_pairs_images_of_unlike_names_when_asked(tmp_path, prepared):
    for i in range(6):
        write(tmp_path / "dive" / "left" / f"GOPR{i:04d}.png", image(i))
        write(tmp_path / "dive" / "right" / f"GOPR{i + 700:04d}.png", image(50 + i))
    with pytest.raises(InputError, match="cannot be paired by name: 6 images of left, 6 images of right"):
        read_frames(tmp_path / "dive", folder=prepared)
    frames = read_frames(tmp_path / "dive", folder=prepared, rig_pairs="order")
    assert len({frame.instant for frame in frames}) == 6
    assert frames.names[:2] == ("left/GOPR0000.png", "right/GOPR0700.png")


def test_a_limit_of_frames_keeps_whole_instants(stereo, prepared):
    frames = read_frames(stereo, folder=prepared, max_frames=5)
    assert len(frames) == 10
    assert len({frame.instant for frame in frames}) == 5


def camchain(path, baseline):
    lens = {
        "camera_model": "pinhole",
        "distortion_model": "none",
        "distortion_coeffs": [],
        "intrinsics": [60.0, 60.0, 31.5, 23.5],
        "resolution": [64, 48],
    }
    pose = [[1.0, 0, 0, -baseline], [0, 1.0, 0, 0], [0, 0, 1.0, 0], [0, 0, 0, 1.0]]
    path.write_text(yaml.safe_dump({"cam0": lens, "cam1": {**lens, "T_cn_cnm1": pose}}))
    return path


def test_a_calibration_gives_the_poses_and_the_first_lens(stereo, tmp_path, prepared):
    frames = read_frames(stereo, folder=prepared, rig_calibration=camchain(tmp_path / "chain.yaml", 0.12))
    assert frames.rig is not None
    assert frames.rig.cameras[1].baseline == pytest.approx(0.12)
    assert frames.calibration is not None
    assert frames.calibration.read_text() == "1 OPENCV 64 48 60 60 32 24 0 0 0 0\n"
    assert load_frames(prepared) == frames


def test_a_video_that_shows_two_views_is_a_stereo_pair(write_video, tmp_path, prepared):
    video = write_video(tmp_path / "pair.mp4", [image(i) for i in range(8)])
    whole = read_frames(video, folder=tmp_path / "whole" / "prepare", fps=0)
    frames = read_frames(video, folder=prepared, fps=0, rig=("side-by-side",))
    assert len(frames) == 2 * len(whole)
    assert frames.names[:2] == ("left/frame_000000.png", "right/frame_000000.png")
    assert (frames.width, frames.height) == (whole.width // 2, whole.height)
    both = torch.cat([frames.image(2), frames.image(3)], 1)
    assert torch.equal(both, whole.image(1))


def test_names_of_folders_are_no_views_of_a_video(write_video, tmp_path, prepared):
    with pytest.raises(UsageError, match="names sub-folders"):
        read_frames(write_video(tmp_path / "pair.mp4", [image(0)] * 4), folder=prepared, rig=("left", "right"))
