"""Two topics of a bag as a stereo pair: instants by the headers, poses as the bag states them, and what is no pair."""

import shutil
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation
from tests.bag_files import SECOND, START, VERSIONS, Sent, camera_info, image, transforms, write_bag

from swimm3r.cli.main import main
from swimm3r.errors import InputError, UsageError
from swimm3r.geometry import align_similarity
from swimm3r.io.calibration.colmap_text import read as read_calibration
from swimm3r.io.images import read_rgb
from swimm3r.prepare import load_frames, read_frames
from swimm3r.prepare.bag_rig import camera_names
from swimm3r.scale.rig import rig_estimates
from swimm3r.scale.settings import ScaleSettings
from swimm3r.scene.frames import Frames
from swimm3r.scene.ground_truth import read_ground_truth
from swimm3r.sfm.colmap.poses import reconstruct
from swimm3r.sfm.colmap.rig.adjustment import as_rig
from swimm3r.sfm.features.settings import FeatureSettings
from swimm3r.sfm.settings import ColmapSettings
from swimm3r.synthetic import DiveSettings, write_dive

TOPICS = ("/stereo/left/image_raw", "/stereo/right/image_raw")
SIZE = (64, 48)
K = (60.0, 0, 31.5, 0, 60, 23.5, 0, 0, 1)
TEXTURE = np.random.default_rng(0).integers(0, 255, (12, 16, 3), dtype=np.uint8).repeat(4, 0).repeat(4, 1)


def images(topic: str, times, shift: int = 0, **other) -> list[Sent]:
    return [
        image(topic, np.roll(TEXTURE, 3 * i + shift, axis=1), "rgb8", START + round(t * SECOND), **other)
        for i, t in enumerate(times)
    ]


def pair(later: float = 0.002, count: int = 8) -> list[Sent]:
    """Two cameras of 10 images per second, the right one later by so many seconds."""
    times = np.arange(count) / 10
    return [*images(TOPICS[0], times), *images(TOPICS[1], times + later, shift=1)]


def projection(baseline: float, f: float = 60.0) -> np.ndarray:
    return np.array([[f, 0, 31.5, -f * baseline], [0, f, 23.5, 0], [0, 0, 1, 0]])


def stereo_info(baseline: float, R: np.ndarray | None = None) -> list[Sent]:
    """camera_info of both, calibrated as a pair."""
    left, right = (f"{topic.rpartition('/')[0]}/camera_info" for topic in TOPICS)
    own = {"size": SIZE, "K": K, "D": (0.0,) * 5, "stamp": START}
    return [camera_info(left, **own, P=projection(0)), camera_info(right, **own, R=R, P=projection(baseline))]


def read(path: Path, folder: Path, **changes) -> Frames:
    return read_frames(path, folder=folder, **{"fps": 0.0, "rig": TOPICS, **changes})


def pose_of_right(frames: Frames) -> np.ndarray:
    """camera_from_rig of the second camera."""
    assert frames.rig is not None
    return np.array(frames.rig.cameras[1].camera_from_rig)


@pytest.mark.parametrize("version", VERSIONS)
def test_two_topics_are_a_stereo_pair_by_the_times_of_their_headers(version: str, tmp_path: Path):
    frames = read(write_bag(tmp_path, version, [*pair(), *stereo_info(0.12)]), tmp_path / "prepare")
    assert frames.names[:3] == ("left/frame_000000.png", "right/frame_000000.png", "left/frame_000001.png")
    assert [frame.instant for frame in frames] == [i // 2 for i in range(16)]
    assert frames.start_ns == START
    expected = [START + round((i // 2 / 10 + i % 2 * 0.002) * SECOND) for i in range(16)]
    assert frames.stamps_of(frames.names) == tuple(expected)
    np.testing.assert_array_equal(read_rgb(frames.frames[3].path), np.roll(TEXTURE, 4, axis=1))
    np.testing.assert_allclose(pose_of_right(frames)[:3, 3], [-0.12, 0, 0], atol=1e-12)
    assert load_frames(tmp_path / "prepare") == frames


def test_each_camera_has_the_lens_of_its_topic_and_frames_begin_with_the_first(tmp_path: Path):
    left, right = stereo_info(0.12)
    longer = camera_info(
        right.topic, size=SIZE, K=(66.0, 0, 31.5, 0, 66, 23.5, 0, 0, 1), D=(-0.1, 0, 0, 0, 0), stamp=START
    )
    frames = read(write_bag(tmp_path, "mcap", [*pair(), left, longer]), tmp_path / "prepare")
    assert frames.calibration is not None
    assert "camera_name: stereo_left_camera_info" in frames.calibration.read_text()
    assert frames.rig is not None
    lenses = [read_calibration(camera.lens)[0] for camera in frames.rig.cameras if camera.lens is not None]
    np.testing.assert_allclose([lens.K[0, 0] for lens in lenses], [60, 66])
    np.testing.assert_allclose([lens.k[0] for lens in lenses], [0, -0.1])


def test_without_camera_info_no_camera_has_a_lens(tmp_path: Path):
    frames = read(write_bag(tmp_path, "mcap", [*pair(), *stereo_info(0.12)]), tmp_path / "prepare", camera_info=False)
    assert frames.calibration is None
    assert frames.rig is not None
    assert [camera.lens for camera in frames.rig.cameras] == [None, None]


def test_a_lens_of_any_camera_that_changes_is_told_where_its_images_are_used(tmp_path: Path):
    left, right = stereo_info(0.12)
    other = camera_info(right.topic, size=SIZE, K=(66.0, 0, 31.5, 0, 66, 23.5, 0, 0, 1), D=(0.0,) * 5, stamp=START)
    changed = replace(other, stamp=START + round(0.4 * SECOND))
    path = write_bag(tmp_path, "mcap", [*pair(), left, right, changed])
    told = [warning for warning in read(path, tmp_path / "prepare").warnings if "changes" in warning]
    assert len(told) == 1
    assert "The lens in /stereo/right/camera_info changes after 0.4 s" in told[0]
    assert not any("changes" in warning for warning in read(path, tmp_path / "before", end=0.4).warnings)


def test_the_rectification_turns_the_second_camera(tmp_path: Path):
    R = Rotation.from_rotvec([0, 0.05, 0.01]).as_matrix()
    frames = read(write_bag(tmp_path, "bag", [*pair(), *stereo_info(0.12, R)]), tmp_path / "prepare")
    np.testing.assert_allclose(pose_of_right(frames)[:3, :3], R.T, atol=1e-12)
    np.testing.assert_allclose(-R @ pose_of_right(frames)[:3, 3], [0.12, 0, 0], atol=1e-12)


def test_rectified_images_are_turned_already(tmp_path: Path):
    topics = tuple(topic.replace("image_raw", "image_rect") for topic in TOPICS)
    sent = [replace(one, topic=one.topic.replace("image_raw", "image_rect")) for one in pair()]
    R = Rotation.from_rotvec([0, 0.05, 0.01]).as_matrix()
    path = write_bag(tmp_path, "mcap", [*sent, *stereo_info(0.12, R)])
    expected = np.eye(4)
    expected[0, 3] = -0.12
    np.testing.assert_allclose(pose_of_right(read(path, tmp_path / "prepare", rig=topics)), expected, atol=1e-12)


@pytest.mark.parametrize("version", VERSIONS)
def test_static_transforms_give_the_poses_where_lenses_do_not(version: str, tmp_path: Path):
    base = np.eye(4)
    base[:3, :3] = Rotation.from_rotvec([0.3, 1.0, -0.4]).as_matrix()
    base[:3, 3] = (0.5, 0.1, -0.2)
    right = np.eye(4)  # pose of the right camera in the axes of the left one
    right[:3, :3] = Rotation.from_rotvec([0.01, -0.02, 0.005]).as_matrix()
    right[:3, 3] = (0.11, 0.001, 0.002)
    tree = [("base", "mast", base), ("mast", "left_eye", base), ("base", "/right_eye", base @ base @ right)]
    sent = [
        *(replace(one, frame_id="left_eye" if "left" in one.topic else "right_eye") for one in pair()),
        *stereo_info(0.0),
        transforms("/tf_static", tree[:1], START),
        transforms("/tf_static", tree[1:], START + 1),
        transforms("/tf", [("map", "base", right)], START + 2),
    ]
    path = write_bag(tmp_path, version, sent)
    np.testing.assert_allclose(pose_of_right(read(path, tmp_path / "prepare")), np.linalg.inv(right), atol=1e-9)


def test_static_transforms_are_listed_as_such(tmp_path: Path, capsys):
    eye = np.eye(4)
    sent = [transforms(f"/tf{kind}", [("base", "eye", eye)], START) for kind in ("", "_static")]
    main(["topics", str(write_bag(tmp_path, "mcap", [*pair(), *sent]))])
    lines = {line.split()[0]: line for line in capsys.readouterr().out.splitlines()}
    assert "poses of cameras: --rig" in lines["/tf_static"]
    assert "not used" in lines["/tf"]


@pytest.mark.parametrize("baseline", [None, 0.0])
def test_a_bag_that_states_no_poses_leaves_them_to_the_images(baseline: float | None, tmp_path: Path):
    sent = pair() if baseline is None else [*pair(), *stereo_info(baseline)]
    frames = read(write_bag(tmp_path, "mcap", sent), tmp_path / "prepare")
    assert frames.rig is not None
    assert [camera.camera_from_rig for camera in frames.rig.cameras] == [None, None]


def test_a_calibration_of_the_rig_goes_before_what_the_bag_states(tmp_path: Path):
    calibration = tmp_path / "stereo.yaml"
    calibration.write_text(
        "M1: [[60, 0, 31.5], [0, 60, 23.5], [0, 0, 1]]\nD1: [0, 0, 0, 0]\n"
        "M2: [[60, 0, 31.5], [0, 60, 23.5], [0, 0, 1]]\nD2: [0, 0, 0, 0]\n"
        "R: [[1, 0, 0], [0, 1, 0], [0, 0, 1]]\nT: [-0.2, 0, 0]\n"
    )
    path = write_bag(tmp_path, "mcap", [*pair(), *stereo_info(0.12)])
    frames = read(path, tmp_path / "prepare", rig_calibration=calibration)
    np.testing.assert_allclose(pose_of_right(frames)[:3, 3], [-0.2, 0, 0])
    assert frames.calibration is not None
    assert frames.calibration.read_text() == "1 OPENCV 64 48 60 60 32 24 0 0 0 0\n"


def test_topics_that_are_not_synchronized_get_the_message_of_folders(tmp_path: Path):
    path = write_bag(tmp_path, "mcap", pair(later=0.04))
    with pytest.raises(InputError, match=r"instants lack the image of a camera .* 0.04 s apart in the median") as told:
        read(path, tmp_path / "prepare")
    assert told.value.exit_code == 3
    assert "--rig-tolerance" in told.value.hint
    assert not (tmp_path / "prepare").exists()
    assert len(read(path, tmp_path / "prepare", rig_tolerance=0.045)) == 16


def test_a_clock_that_drifts_is_not_synchronized(tmp_path: Path):
    times = np.arange(20) / 10
    sent = [*images(TOPICS[0], times), *images(TOPICS[1], 1.02 * times)]
    with pytest.raises(InputError, match="instants lack the image"):
        read(write_bag(tmp_path, "mcap", sent), tmp_path / "prepare")


def test_clocks_that_have_nothing_in_common_are_told_by_how_far_they_are_apart(tmp_path: Path):
    with pytest.raises(InputError, match=r"1e\+03 s apart"):
        read(write_bag(tmp_path, "mcap", pair(later=1000.0)), tmp_path / "prepare")


def test_a_lost_image_takes_its_instant_with_it_and_is_told(tmp_path: Path):
    sent = pair(count=20)
    del sent[25]
    frames = read(write_bag(tmp_path, "mcap", sent), tmp_path / "prepare")
    assert len(frames) == 38
    assert "1 of 20 instants lack the image of a camera (/stereo/left/image_raw at 0.500 s)" in " ".join(
        frames.warnings
    )


def test_a_damaged_image_takes_its_instant_with_it(tmp_path: Path):
    sent = pair()
    sent[3] = replace(sent[3], fields={**sent[3].fields, "step": 5})
    frames = read(write_bag(tmp_path, "mcap", sent), tmp_path / "prepare")
    assert len(frames) == 14
    assert "1 images of /stereo/left/image_raw" in " ".join(frames.warnings)


def test_a_camera_that_starts_earlier_is_used_from_where_both_are_there(tmp_path: Path):
    times = np.arange(30) / 10
    sent = [*images(TOPICS[0], times), *images(TOPICS[1], times[15:])]
    frames = read(write_bag(tmp_path, "mcap", sent), tmp_path / "prepare")
    assert len(frames) == 30
    assert frames.start_ns == START + round(1.5 * SECOND)
    assert "/stereo/left/image_raw has images for 1.5 s" in " ".join(frames.warnings)


def test_a_rig_is_sampled_like_a_video_by_whole_instants(tmp_path: Path):
    path = write_bag(tmp_path, "mcap", pair(count=31))
    frames = read(path, tmp_path / "prepare", fps=2.0, pick="uniform", start=0.5, end=2.4)
    assert [round(frame.time, 3) for frame in frames if frame.camera == "right"] == [0.502, 1.002, 1.502, 2.002]


def test_what_is_no_rig_of_a_bag_is_refused(tmp_path: Path):
    path = write_bag(tmp_path, "mcap", pair())
    for options, fault in (
        ({"rig": TOPICS[:1]}, "two cameras and more"),
        ({"rig": (TOPICS[0], TOPICS[0])}, "two cameras and more"),
        ({"topic": TOPICS[0]}, "--topic .* and --rig"),
        ({"rig_pairs": "name"}, "for images in files"),
        ({"rig": (TOPICS[0], "/middle")}, "no topic of images /middle"),
    ):
        with pytest.raises(UsageError, match=fault):
            read(path, tmp_path / "prepare", **options)
    with pytest.raises(UsageError, match="2 topics of images") as told:
        read(path, tmp_path / "prepare", rig=())
    assert f"--rig {' '.join(TOPICS)}" in told.value.hint
    other = image("/small/image_raw", TEXTURE[:20], "rgb8", START)
    with pytest.raises(InputError, match="64x20"):
        read(write_bag(tmp_path, "bag", [*pair(), other]), tmp_path / "prepare", rig=(TOPICS[0], "/small/image_raw"))


def test_cameras_are_named_by_what_tells_their_topics_apart():
    assert camera_names(("/stereo/left/image_raw", "/stereo/right/image_raw/compressed")) == ("left", "right")
    assert camera_names(("/cam0/image", "/cam1/image", "/aux/cam2/image")) == ("cam0", "cam1", "aux_cam2")
    assert camera_names(("/camera/left_raw", "/camera/right_raw")) == ("left_raw", "right_raw")
    assert camera_names(("/image", "/top/image")) == ("camera0", "camera1")
    assert camera_names(("/../image", "/a b/image")) == ("_", "a_b")


@pytest.mark.long
def test_a_stereo_dive_in_a_bag_is_that_of_its_folder_and_in_metres(tmp_path: Path):
    dive = DiveSettings(frames=12, width=320, height=214, seed=2, stereo=0.1)
    write_dive(dive, tmp_path / "dive")
    folder = read_frames(tmp_path / "dive", folder=tmp_path / "of_folder")
    truth = read_ground_truth(tmp_path / "dive" / "truth")
    (fx, _, cx), (_, fy, cy), _ = truth.cameras.K[0].tolist()
    relative = torch.linalg.inv(truth.cameras.cam2world[1]) @ truth.cameras.cam2world[0]  # right from left
    R = relative[:3, :3].numpy().T  # the axes of a rectified pair are the left camera's
    own = {"size": (320, 214), "K": (fx, 0, cx - 0.5, 0, fy, cy - 0.5, 0, 0, 1), "D": (0.0,) * 5, "stamp": START}
    P = np.array([[fx, 0, cx, 0], [0, fy, cy, 0], [0, 0, 1, 0]])
    shifted = P.copy()
    shifted[0, 3] = -0.1 * fx
    sent = [
        camera_info("/stereo/left/camera_info", **own, P=P),
        camera_info("/stereo/right/camera_info", **own, R=R, P=shifted),
    ]
    for topic, side in zip(TOPICS, ("left", "right"), strict=True):
        files = sorted((tmp_path / "dive" / "images" / side).iterdir())
        stamps = (START + round(i / 5 * SECOND) for i in range(len(files)))
        sent += [image(topic, read_rgb(f), "rgb8", stamp) for f, stamp in zip(files, stamps, strict=True)]
    frames = read(write_bag(tmp_path, "mcap", sent), tmp_path / "of_bag")
    assert [(one.camera, one.instant, one.split) for one in frames] == [
        (one.camera, one.instant, one.split) for one in folder
    ]
    assert all(torch.equal(frames.image(i), folder.image(i)) for i in range(len(folder)))
    settings = ColmapSettings(intrinsics="fixed", features=FeatureSettings(count=1024))
    rec = as_rig(reconstruct(frames.train, settings, tmp_path / "sfm"), frames.train, settings)
    (estimate,) = rig_estimates(rec, ScaleSettings())
    left = [i for i, name in enumerate(rec.names) if name.startswith("left/")]
    true = [truth.names.index(f"left/{int(rec.names[i][-10:-4]):04d}.png") for i in left]
    onto = align_similarity(rec.cameras.centers[left].double(), truth.cameras.centers[true].double())
    assert abs(estimate.scale / float(onto.scale) - 1) < 0.005
    shutil.rmtree(tmp_path / "sfm")
