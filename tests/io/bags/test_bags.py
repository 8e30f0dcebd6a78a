"""Bags of all three kinds: their topics, the choice of a camera, its lens, its times, and what damaged ones say."""

from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
import torch
from tests.bag_files import SECOND, START, VERSIONS, Sent, camera_info, compressed, image, write_bag

from swimm3r.cli.main import main
from swimm3r.errors import InputError, UsageError
from swimm3r.io.bags.bag import Bag, is_bag
from swimm3r.io.bags.clip import BagClip
from swimm3r.io.bags.topics import read_topics
from swimm3r.io.calibration.read import read_lens
from swimm3r.io.image_folder import find_images
from swimm3r.io.images import read_rgb, write_rgb
from swimm3r.prepare import check_source, load_frames, read_frames
from swimm3r.sfm.colmap.poses import reconstruct
from swimm3r.sfm.features.settings import FeatureSettings
from swimm3r.sfm.settings import ColmapSettings

K = (60.0, 0, 32, 0, 61, 24, 0, 0, 1)
TEXTURE = np.random.default_rng(0).integers(0, 255, (12, 16, 3), dtype=np.uint8).repeat(4, 0).repeat(4, 1)


def shifted(i: int) -> np.ndarray:
    return np.roll(TEXTURE, 3 * i, axis=1)


def camera(topic: str = "/cam/image_raw", count: int = 6, step: float = 1.0, **other) -> list[Sent]:
    return [image(topic, shifted(i), "rgb8", START + round(i * step * SECOND), **other) for i in range(count)]


def lens(topic: str = "/cam/camera_info", K=K, D=(0.1, 0, 0, 0, 0), size=(64, 48), **other) -> Sent:
    return camera_info(topic, size, K, D, START, **other)


@pytest.mark.parametrize("version", VERSIONS)
def test_topics_are_listed_with_their_counts_rates_and_times(version: str, tmp_path: Path, capsys):
    depth = image("/depth/image", np.zeros((4, 4), np.uint16), "16UC1", START)
    path = write_bag(tmp_path, version, [*camera(step=0.1), lens(), depth])
    assert is_bag(path)
    assert check_source(path) == path
    found = {topic.name: topic for topic in read_topics(path).known}
    raw = found["/cam/image_raw"]
    assert (raw.type, raw.count, raw.use, raw.detail) == ("sensor_msgs/msg/Image", 6, "images", "64x48 rgb8")
    assert (raw.first, raw.last) == (START, START + SECOND // 2)
    assert raw.rate == pytest.approx(10)
    assert found["/depth/image"].use is None
    main(["topics", str(path)])
    told = capsys.readouterr().out.splitlines()
    assert any(line.startswith("/cam/image_raw") and "2023-11-14 22:13:20.123" in line for line in told)
    assert any("/depth/image" in line and "not read" in line for line in told)


def test_one_file_of_a_bag_is_a_bag_and_so_is_a_folder_without_its_metadata(tmp_path: Path):
    for version in ("sqlite3", "mcap"):
        path = write_bag(tmp_path, version, camera())
        (path / "metadata.yaml").unlink()
        assert len(read_frames(path, folder=tmp_path / f"{version}_folder")) == 6
        (file,) = path.iterdir()
        assert len(read_frames(file, folder=tmp_path / f"{version}_file")) == 6


def test_several_cameras_are_listed_and_one_is_chosen(tmp_path: Path):
    path = write_bag(tmp_path, "mcap", [*camera("/left/image_raw"), *camera("/right/image_raw", 4)])
    with pytest.raises(UsageError, match=r"/left/image_raw \(6 messages, 64x48 rgb8\), /right") as told:
        read_frames(path, folder=tmp_path / "run" / "prepare")
    assert "--topic /left/image_raw" in told.value.hint
    assert not (tmp_path / "run").exists()
    assert len(read_frames(path, folder=tmp_path / "right", topic="/right/image_raw")) == 4
    with pytest.raises(UsageError, match="no topic of images /middle"):
        read_frames(path, folder=tmp_path / "middle", topic="/middle")


def test_raw_and_compressed_images_of_one_camera_are_one_camera(tmp_path: Path):
    import cv2

    jpegs = [
        compressed("/cam/image_raw/compressed", cv2.imencode(".jpg", image)[1].tobytes(), "jpeg", START + i * SECOND)
        for i, image in enumerate(map(shifted, range(6)))
    ]
    path = write_bag(tmp_path, "bag", [*camera(), *jpegs, lens()])
    frames = read_frames(path, folder=tmp_path / "raw")
    np.testing.assert_array_equal(read_rgb(frames.frames[1].path), shifted(1))
    lossy = read_frames(path, folder=tmp_path / "lossy", topic="/cam/image_raw/compressed")
    assert lossy.calibration is not None
    assert len(lossy) == 6


def test_a_bag_is_sampled_like_a_video(tmp_path: Path):
    path = write_bag(tmp_path, "mcap", camera(count=21, step=0.1))
    frames = read_frames(path, folder=tmp_path / "prepare", fps=2.0, pick="uniform")
    assert [frame.time for frame in frames] == [0.0, 0.5, 1.0, 1.5, 2.0]
    later = read_frames(path, folder=tmp_path / "part", fps=0.0, start=0.5, end=1.05)
    assert later.stamps_of(later.names) == tuple(START + round(t * SECOND) for t in (0.5, 0.6, 0.7, 0.8, 0.9, 1.0))


@pytest.mark.parametrize("stamps", ["header", "received"])
@pytest.mark.parametrize("version", VERSIONS)
def test_a_late_start_passes_over_what_was_recorded_long_before(version: str, stamps, tmp_path: Path, monkeypatch):
    path = write_bag(tmp_path, version, camera(count=40, step=10.0))
    clip, stated = BagClip(path, stamps=stamps), []
    whole = [frame.time for frame in clip.frames()]
    messages = Bag.messages

    def counted(bag: Bag, *topics: str, since: int | None = None):
        for message in messages(bag, *topics, since=since):
            stated.append(message.stamp)
            yield message

    monkeypatch.setattr(Bag, "messages", counted)
    assert [frame.time for frame in clip.frames(start=200.0)] == [time for time in whole if time >= 200]
    assert 20 <= len(stated) <= 27


def test_a_driver_that_is_calibrated_later_gives_its_lens(tmp_path: Path):
    unset = [replace(lens(K=(0.0,) * 9), stamp=START + i * SECOND // 10) for i in range(3)]
    path = write_bag(tmp_path, "bag", [*camera(), *unset, replace(lens(), stamp=START + SECOND)])
    frames = read_frames(path, folder=tmp_path / "prepare")
    assert frames.calibration is not None
    assert not any("lens" in warning for warning in frames.warnings)


def test_the_lens_is_that_of_camera_info_in_pixels_of_the_frames(tmp_path: Path):
    path = write_bag(tmp_path, "sqlite3", [*camera(), lens()])
    frames = read_frames(path, folder=tmp_path / "prepare", long_side=32)
    assert frames.calibration is not None
    camera_of = read_lens(frames.calibration, frames.width, frames.height).camera
    np.testing.assert_allclose(camera_of.K[0].numpy(), [[30, 0, 16.25], [0, 30.5, 12.25], [0, 0, 1]])
    frames.save(tmp_path / "copy")
    again = load_frames(tmp_path / "copy")
    assert again.calibration == tmp_path / "copy" / "camera_info.yaml"
    assert (again.start_ns, again.recorded) == (START, "2023-11-14T22:13:20.123456")
    assert read_frames(path, folder=tmp_path / "without", camera_info=False).calibration is None


def test_the_lens_of_a_part_of_the_sensor_moves_with_it(tmp_path: Path):
    path = write_bag(
        tmp_path, "bag", [*camera(), lens(size=(128, 96), K=(60, 0, 64, 0, 60, 48, 0, 0, 1), roi=(30, 20, 64, 48))]
    )
    frames = read_frames(path, folder=tmp_path / "prepare")
    assert frames.calibration is not None
    middle = read_lens(frames.calibration, 64, 48).camera.K[0, :2, 2]
    np.testing.assert_allclose(middle.numpy(), [34.5, 28.5])


def test_rectified_images_have_the_lens_of_the_projection(tmp_path: Path):
    path = write_bag(tmp_path, "mcap", [*camera("/cam/image_rect_color"), lens()])
    frames = read_frames(path, folder=tmp_path / "prepare")
    assert frames.calibration is not None
    found = read_lens(frames.calibration, 64, 48).camera
    assert found.model == "PINHOLE"


OTHER = lens(K=(33.0, 0, 32, 0, 33, 24, 0, 0, 1))


def at(second: float, sent: Sent) -> Sent:
    return replace(sent, stamp=START + round(second * SECOND))


def about_lenses(path: Path, folder: Path, **changes) -> list[str]:
    return [warning for warning in read_frames(path, folder=folder, **changes).warnings if "lens" in warning]


@pytest.mark.parametrize(
    ("later", "told"),
    [
        (lens(), None),
        (OTHER, "to fx 33 fy 33"),
        (lens(D=(0.2, 0, 0, 0, 0)), "px distortion 0.2: the"),
        (lens(K=(0,) * 9), None),  # the driver shuts down
    ],
)
@pytest.mark.parametrize("version", VERSIONS)
def test_a_lens_that_changes_is_told(version: str, later: Sent, told: str | None, tmp_path: Path):
    path = write_bag(tmp_path, version, [*camera(), lens(), at(1, later)])
    frames = read_frames(path, folder=tmp_path / "prepare")
    assert frames.calibration is not None
    np.testing.assert_allclose(read_lens(frames.calibration, 64, 48).camera.K[0, 0, 0].numpy(), K[0])
    changes = [warning for warning in frames.warnings if "changes" in warning]
    assert len(changes) == (told is not None)
    assert all(told in warning and "changes after 1 s, from fx 60" in warning for warning in changes if told)


@pytest.mark.parametrize("version", VERSIONS)
def test_a_lens_that_changes_and_reverts_is_told_with_the_first_time(version: str, tmp_path: Path):
    sent = [at(i, OTHER if i in (2, 3) else lens()) for i in range(6)]
    (told,) = about_lenses(write_bag(tmp_path, version, [*camera(), *sent]), tmp_path / "prepare")
    assert "changes 2 times, first after 2 s, from fx 60 fy 61" in told
    assert "to fx 33 fy 33" in told


def test_only_the_lenses_of_the_time_that_is_used_count(tmp_path: Path):
    sent = [at(i, OTHER if i >= 3 else lens()) for i in range(8)]
    path = write_bag(tmp_path, "mcap", [*camera(), *sent])
    assert about_lenses(path, tmp_path / "before", end=3.0) == []
    later = read_frames(path, folder=tmp_path / "after", start=3.0)
    assert later.calibration is not None
    assert read_lens(later.calibration, 64, 48).camera.K[0, 0, 0] == 33
    assert not any("lens" in warning for warning in later.warnings)
    assert about_lenses(path, tmp_path / "without", camera_info=False) == []
    once = write_bag(tmp_path, "bag", [*camera(), lens()])
    assert read_frames(once, folder=tmp_path / "once", start=3.0).calibration is not None


@pytest.mark.parametrize(
    ("info", "told"),
    [
        (None, "no camera_info beside /cam/image_raw"),
        (lens(K=(0,) * 9), "is not calibrated"),
        (lens(size=(64, 64)), "calibration is of images of 64x64"),
        (lens(topic="/other/camera_info"), "no camera_info beside /cam/image_raw"),
    ],
)
def test_images_without_a_lens_that_can_be_used_say_so(info: Sent | None, told: str, tmp_path: Path):
    path = write_bag(tmp_path, "mcap", camera() if info is None else [*camera(), info])
    frames = read_frames(path, folder=tmp_path / "prepare")
    assert frames.calibration is None
    assert any(told in warning for warning in frames.warnings)


@pytest.mark.parametrize(
    ("times", "fault"),
    [
        ((0, 1, 2, 1, 3, 4), "runs back by 1 s at image 4"),
        ((0, 1, 2, 1000, 1001, 1002), "leaps ahead by 998 s at image 4"),
        ((-START // SECOND,) * 6, "stamp of zero"),
    ],
)
def test_headers_that_are_no_times_are_refused_unless_those_of_recording_are_asked_for(times, fault, tmp_path: Path):
    sent = [
        image("/cam/image_raw", shifted(i), "rgb8", 0 if t < 0 else START + t * SECOND, received=START + i * SECOND)
        for i, t in enumerate(times)
    ]
    path = write_bag(tmp_path, "mcap", sent)
    with pytest.raises(InputError, match=fault) as told:
        read_frames(path, folder=tmp_path / "run" / "prepare", fps=0.0)
    assert "--stamps received" in told.value.hint
    assert not (tmp_path / "run").exists()
    frames = read_frames(path, folder=tmp_path / "prepare", fps=0.0, stamps="received")
    assert [frame.time for frame in frames] == [0, 1, 2, 3, 4, 5]


def test_a_pause_of_the_recording_is_no_leap_of_the_clock(tmp_path: Path):
    sent = [image("/cam/image_raw", shifted(i), "rgb8", START + (i + 500 * (i > 2)) * SECOND) for i in range(6)]
    frames = read_frames(write_bag(tmp_path, "bag", sent), folder=tmp_path / "prepare")
    assert frames.frames[-1].time == 505


def test_an_image_that_was_sent_twice_counts_once(tmp_path: Path):
    frames = read_frames(write_bag(tmp_path, "bag", [*camera(), camera()[3]]), folder=tmp_path / "p", fps=0.0)
    assert len(frames) == 6


def test_images_that_change_their_size_are_refused_with_the_second(tmp_path: Path):
    other = image("/cam/image_raw", TEXTURE[:40], "rgb8", START + 7 * SECOND)
    with pytest.raises(InputError, match=r"change their size from 64x48 to 64x40 after 7\.0 s"):
        read_frames(write_bag(tmp_path, "mcap", [*camera(), other]), folder=tmp_path / "prepare")


def test_damaged_images_are_left_out_and_counted(tmp_path: Path):
    broken = compressed("/cam/compressed", b"\xff\xd8\xff no image", "jpeg", START + SECOND // 2)
    import cv2

    whole = [
        compressed("/cam/compressed", cv2.imencode(".png", shifted(i))[1].tobytes(), "png", START + i * SECOND)
        for i in range(6)
    ]
    frames = read_frames(write_bag(tmp_path, "mcap", [*whole, broken]), folder=tmp_path / "prepare")
    assert len(frames) == 6
    assert any("1 images of /cam/compressed in dive_mcap are damaged" in warning for warning in frames.warnings)


def test_a_bag_without_images_says_what_it_holds(tmp_path: Path):
    path = write_bag(tmp_path, "mcap", [lens(), image("/depth", np.zeros((4, 4), np.uint16), "16UC1", START)])
    with pytest.raises(InputError, match=r"no images of a camera \(/depth: 4x4 16UC1, which is not read\)"):
        BagClip(path)


@pytest.mark.parametrize("version", VERSIONS)
@pytest.mark.parametrize("share", [0.0, 0.3, 0.9])
def test_a_bag_cut_short_names_the_remedy_and_leaves_nothing_behind(version: str, share: float, tmp_path: Path, capsys):
    path = write_bag(tmp_path, version, [*camera(count=20), lens()])
    files = [path] if path.is_file() else [file for file in path.iterdir() if file.suffix in (".mcap", ".db3")]
    for file in files:
        file.write_bytes(file.read_bytes()[: int(share * file.stat().st_size)])
    before = sorted(tmp_path.rglob("*"))
    with pytest.raises(SystemExit) as left:
        main(["prepare", str(path), "--out", str(tmp_path / "run")])
    assert left.value.code == 3
    told = capsys.readouterr().err
    assert "cannot be read as a ROS bag" in told
    assert "reindex" in told or "mcap recover" in told
    assert sorted(tmp_path.rglob("*")) == before


def test_messages_end_where_the_bag_breaks_off_and_the_fault_is_kept(tmp_path: Path):
    connection = SimpleNamespace(topic="/cam", msgtype="sensor_msgs/msg/Image", msgcount=9)

    def broken(chosen: list, start: int | None):
        yield from ((connection, START + i, bytes(12)) for i in range(2))
        raise ValueError("Truncated record")

    bag = Bag(tmp_path, SimpleNamespace(connections=[connection], messages=broken, is2=False), (ValueError,))
    assert [message.received for message in bag.messages("/cam")] == [START, START + 1]
    assert bag.cut == "Truncated record"


@pytest.mark.parametrize("version", VERSIONS)
def test_a_bag_of_a_real_clip_gives_the_frames_of_its_folder(version: str, tmp_path: Path, shared: Path):
    images = find_images(shared / "data" / "ruie_teal_rocks" / "images").paths[:12]
    folder = tmp_path / "folder"
    folder.mkdir()
    for i, path in enumerate(images):
        write_rgb(folder / f"{i:03d}.png", read_rgb(path))
    bag = write_bag(
        tmp_path,
        version,
        [image("/cam/image_raw", read_rgb(path), "rgb8", START + i * SECOND) for i, path in enumerate(images)],
    )
    expected, found = (read_frames(one, folder=tmp_path / name) for one, name in ((folder, "a"), (bag, "b")))
    assert [(f.time, f.split, f.sharpness) for f in found] == [(f.time, f.split, f.sharpness) for f in expected]
    for one, other in zip(expected, found, strict=True):
        np.testing.assert_array_equal(read_rgb(one.path), read_rgb(other.path))


@pytest.mark.long
def test_bags_of_a_real_clip_give_the_reconstruction_of_its_folder_under_the_same_lens(tmp_path: Path, shared: Path):
    images = [read_rgb(path) for path in find_images(shared / "data" / "ruie_teal_rocks" / "images").paths[:10]]
    height, width = images[0].shape[:2]
    folder = tmp_path / "folder"
    folder.mkdir()
    for i, rgb in enumerate(images):
        write_rgb(folder / f"{i:03d}.png", rgb)
    settings = ColmapSettings(features=FeatureSettings(count=800))
    sent = [image("/cam/image_raw", rgb, "rgb8", START + i * SECOND) for i, rgb in enumerate(images)]
    sent.append(lens(K=(300.0, 0, width / 2, 0, 300, height / 2, 0, 0, 1), D=(0.08, 0, 0, 0, 0), size=(width, height)))
    made = {}
    for version in VERSIONS:
        frames = read_frames(write_bag(tmp_path, version, sent), folder=tmp_path / version).train
        made[version] = reconstruct(frames, settings, tmp_path / f"{version}_sfm")
    frames = read_frames(folder, folder=tmp_path / "prepared").train
    given = replace(settings, calibration=tmp_path / "bag" / "camera_info.yaml")
    expected = reconstruct(frames, given, tmp_path / "folder_sfm")
    assert len(expected.names) == 8
    for found in made.values():
        torch.testing.assert_close(found.cameras.cam2world, expected.cameras.cam2world, rtol=0, atol=0)
        torch.testing.assert_close(found.cameras.K, expected.cameras.K, rtol=0, atol=0)
        torch.testing.assert_close(found.points.xyz, expected.points.xyz, rtol=0, atol=0)
