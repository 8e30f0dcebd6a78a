"""A camera tracked over a plane that is exactly known."""

import errno
import json
import math
import shutil
import threading
import time
from collections.abc import Iterator
from dataclasses import replace
from itertools import islice
from pathlib import Path
from types import SimpleNamespace

import cv2
import numpy as np
import pytest
import torch
from tests.bag_files import START, image, write_bag
from tests.localization.textured_plane import FEATURES, HEIGHT, WIDTH, camera, photo, reconstruction, texture

from swimm3r.cameras import pixel_grid
from swimm3r.cli.main import main
from swimm3r.errors import InputError, RegistrationError, UsageError
from swimm3r.geometry import rotation_angle
from swimm3r.imaging.turned_rows import half_time_pixels
from swimm3r.io import image_folder
from swimm3r.io.image_folder import GrowingFolder
from swimm3r.io.images import write_rgb
from swimm3r.localization.online import landmark_file
from swimm3r.localization.online.images import StreamImage, stream_images
from swimm3r.localization.online.landmark_map import LandmarkMap, landmark_map
from swimm3r.localization.online.stream import localize_stream
from swimm3r.localization.online.tracker import TrackedPose, Tracker
from swimm3r.localization.settings import StreamSettings, TrackingSettings
from swimm3r.scene.reconstruction import DepthMap, DepthMaps, Tracks

PLACES = [-0.6, -0.3, 0.0, 0.3, 0.6]
NOISE = torch.rand(HEIGHT, WIDTH, 3, generator=torch.Generator().manual_seed(1))


@pytest.fixture(scope="module")
def mapped(tmp_path_factory: pytest.TempPathFactory) -> LandmarkMap:
    rec, frames = reconstruction(tmp_path_factory.mktemp("plane"), PLACES)
    return landmark_map(rec, frames, FEATURES)


@pytest.fixture
def tracker(mapped: LandmarkMap) -> Tracker:
    return Tracker(mapped)


def asked(tracker: Tracker, x: float, at: float) -> TrackedPose:
    return tracker.locate(tracker.describe(photo(camera(x), texture())), at)


def off(found: TrackedPose, x: float) -> tuple[float, float]:
    """Degrees and units from the truth."""
    assert found.cam2world is not None
    truth = camera(x).cam2world[0]
    turn = math.degrees(float(rotation_angle(truth[:3, :3].mT @ found.cam2world[:3, :3])))
    return turn, float((found.cam2world[:3, 3] - truth[:3, 3]).norm())


def test_the_first_image_is_relocalized_and_the_next_ones_are_tracked(tracker: Tracker):
    for k, x in enumerate([-0.5, -0.42, -0.34, -0.26]):
        found = asked(tracker, x, 0.2 * k)
        assert found.status == ("tracked" if k else "relocalized")
        degrees, distance = off(found, x)
        assert degrees < 0.1
        assert distance < 0.005
        assert found.covariance is not None
        assert distance < 6 * float(found.covariance.diagonal()[:3].sum().sqrt())


def turned_photo(x: float, turn: np.ndarray) -> torch.Tensor:
    """The plane from a camera that turns by `turn` while its rows are exposed."""
    seen_by = camera(x)
    pixels = half_time_pixels(seen_by, pixel_grid(HEIGHT, WIDTH).reshape(-1, 2).double(), turn)
    column, row = (pixels - 0.5).float().reshape(HEIGHT, WIDTH, 2).numpy().transpose(2, 0, 1)
    image = photo(seen_by, texture()).numpy()
    filmed = cv2.remap(image, column, row, cv2.INTER_CUBIC, borderMode=cv2.BORDER_REPLICATE)
    return torch.from_numpy(filmed).clamp(0, 1)


def test_a_camera_that_turns_while_it_exposes_is_tracked_with_its_turn(mapped: LandmarkMap, tmp_path: Path):
    turns = [np.array(turn) for turn in ([0.008, -0.012, 0.0], [-0.01, 0.006, 0.0], [0.0, 0.013, 0.0])]
    shown = [turned_photo(0.1 * k, turn) for k, turn in enumerate(turns)]
    still, turning = Tracker(mapped), Tracker(replace(mapped, rows_rectified=True))
    for k, (seen, turn) in enumerate(zip(shown, turns, strict=True)):
        worse, found = (one.locate(one.describe(seen), 0.2 * k) for one in (still, turning))
        assert found.status == ("tracked" if k else "relocalized")
        assert off(found, 0.1 * k)[0] < 0.3 * off(worse, 0.1 * k)[0]
        assert off(found, 0.1 * k)[1] < 0.3 * off(worse, 0.1 * k)[1]
        assert worse.turn is None
        np.testing.assert_allclose(found.turn[:2], turn[:2], atol=0.001)
        assert found.covariance is not None
        assert off(found, 0.1 * k)[1] < 6 * float(found.covariance.diagonal()[:3].sum().sqrt())
    assert turning.locate(turning.describe(shown[2], lens=camera(0.0)), 0.6).turn is None  # of another camera
    values = (shown[0].numpy() * 255).astype(np.uint8)
    localize_stream(turning, iter([StreamImage("a", 0.0, values)]), tmp_path)
    np.testing.assert_allclose(lines(tmp_path)[0]["turn"][:2], turns[0][:2], atol=0.001)


def test_no_pose_is_made_of_noise_or_of_another_place(tracker: Tracker):
    for known in (False, True):
        if known:
            assert asked(tracker, 0.0, 0.0).status == "relocalized"
        for k, shown in enumerate([NOISE, torch.zeros(HEIGHT, WIDTH, 3), photo(camera(0.0), texture(seed=7))]):
            found = tracker.locate(tracker.describe(shown), 0.2 + 0.2 * k)
            assert found.status == "lost"
            assert found.cam2world is None
            assert found.covariance is None
            assert found.reason


def test_a_lost_camera_is_found_again(tracker: Tracker):
    asked(tracker, 0.0, 0.0)
    assert tracker.locate(tracker.describe(NOISE), 0.2).status == "lost"
    found = asked(tracker, 0.4, 5.0)
    assert found.status == "relocalized"
    assert off(found, 0.4)[1] < 0.005


def test_a_leap_that_no_camera_makes_is_no_pose(mapped: LandmarkMap):
    slow = Tracker(mapped, TrackingSettings(most_speed=0.1))
    asked(slow, -0.5, 0.0)
    leap = asked(slow, 0.5, 0.2)
    assert leap.status == "lost"
    assert "median distances from the last one" in leap.reason
    assert asked(slow, 0.5, 10.0).status == "relocalized"


def test_few_landmarks_are_no_pose(mapped: LandmarkMap):
    strict = Tracker(mapped, TrackingSettings(least_inliers=100_000))
    assert asked(strict, 0.0, 0.0).status == "lost"


def test_a_pose_that_the_landmarks_leave_open_is_none(mapped: LandmarkMap):
    strict = Tracker(mapped, TrackingSettings(most_shift_error=1e-7))
    found = asked(strict, 0.0, 0.0)
    assert found.status == "lost"
    assert "standard error" in found.reason


def test_landmarks_in_view_are_those_of_the_nearest_frames_each_point_once(mapped: LandmarkMap):
    rows = mapped.visible(camera(0.3, 0.3), frames=2)
    assert len(rows) > 100
    assert len(torch.unique(mapped.point[rows])) == len(rows)
    shared = torch.bincount(mapped.frame[rows], minlength=len(PLACES))
    assert int((shared > 0).sum()) == 2
    assert int(shared.argmax()) == 3


def test_a_camera_that_looks_away_sees_no_landmarks(mapped: LandmarkMap):
    behind = camera(0.0)
    pose = behind.cam2world.clone()
    pose[0, :3, :3] = pose[0, :3, :3] @ torch.diag(torch.tensor([-1.0, 1, -1], dtype=torch.float64))
    assert len(mapped.visible(replace(behind, cam2world=pose), frames=3)) == 0


def test_without_tracks_depth_maps_give_the_landmarks(tmp_path: Path):
    rec, frames = reconstruction(tmp_path, PLACES)
    none = torch.zeros(0, dtype=torch.int64)
    depth = DepthMaps(tmp_path / "z_depth")
    for i, name in enumerate(rec.names):
        grid = torch.stack(torch.meshgrid(torch.arange(WIDTH) + 0.5, torch.arange(HEIGHT) + 0.5, indexing="xy"), -1)
        one = rec.cameras[i]
        rays = torch.linalg.solve(one.K[0], torch.cat([grid.double(), torch.ones(HEIGHT, WIDTH, 1)], -1).mT).mT
        along = (rays @ one.cam2world[0, :3, :3].mT)[..., 2]
        z = ((2 - one.centers[0, 2]) / along).float()
        depth.write(name, DepthMap(z, torch.ones_like(z)))
    bare = replace(rec, tracks=Tracks(none, none, torch.zeros(0, 2)), depth=depth)
    found = asked(Tracker(landmark_map(bare, frames, FEATURES)), 0.15, 0.0)
    assert off(found, 0.15)[1] < 0.01


def test_nothing_to_match_with_is_said(tmp_path: Path):
    rec, frames = reconstruction(tmp_path, [0.0, 0.3])
    none = torch.zeros(0, dtype=torch.int64)
    with pytest.raises(InputError, match="no points that images could be matched with"):
        landmark_map(replace(rec, tracks=Tracks(none, none, torch.zeros(0, 2))), frames, FEATURES)


def written(folder: Path, count: int) -> Path:
    folder.mkdir(exist_ok=True)
    for k in range(count):
        write_rgb(folder / f"{k}.png", photo(camera(-0.4 + 0.05 * k), texture()).numpy())
    return folder


def lines(out: Path) -> list[dict]:
    return [json.loads(line) for line in (out / "stream.jsonl").read_text().splitlines()]


def test_a_folder_gives_a_line_per_image_and_what_cannot_be_read_is_lost(tracker: Tracker, tmp_path: Path):
    folder = written(tmp_path / "in", 4)
    (folder / "2.png").write_bytes((folder / "2.png").read_bytes()[:500])
    said: list[str] = []
    outcome = localize_stream(tracker, stream_images(folder, StreamSettings()), tmp_path, say=said.append, tum=True)
    entries = lines(tmp_path)
    assert [entry["name"] for entry in entries] == ["0.png", "1.png", "2.png", "3.png"]
    assert [entry["status"] for entry in entries] == ["relocalized", "tracked", "lost", "tracked"]
    assert [json.loads(line) for line in said] == entries
    assert "cannot be read" in entries[2]["reason"]
    assert entries[2]["c2w"] is None
    assert np.array(entries[0]["covariance"]).shape == (6, 6)
    assert len((tmp_path / "stream.tum").read_text().splitlines()) == 3
    assert dict(outcome.counts) == {"relocalized": 1, "tracked": 2, "lost": 1}


def test_ctrl_c_ends_a_stream_with_what_was_found(tracker: Tracker, tmp_path: Path):
    def stopped() -> Iterator[StreamImage]:
        yield from islice(stream_images(written(tmp_path / "in", 2), StreamSettings()), 2)
        raise KeyboardInterrupt

    outcome = localize_stream(tracker, stopped(), tmp_path, live=True)
    assert outcome.interrupted
    assert len(lines(tmp_path)) == 2


def test_a_stream_of_other_places_is_refused_with_its_record_kept(tracker: Tracker, tmp_path: Path):
    values = (NOISE.numpy() * 255).astype(np.uint8)
    with pytest.raises(RegistrationError, match="none of the 2 images"):
        localize_stream(tracker, iter([StreamImage("a", 0.0, values), StreamImage("b", 0.2, values)]), tmp_path)
    assert [entry["status"] for entry in lines(tmp_path)] == ["lost", "lost"]


def test_an_image_of_another_shape_is_lost_and_says_why(tracker: Tracker, tmp_path: Path):
    tall = np.zeros((400, 300, 3), np.uint8)
    stream = iter([StreamImage("tall", 0.0, tall), *stream_images(written(tmp_path / "in", 1), StreamSettings())])
    localize_stream(tracker, stream, tmp_path)
    assert "its lens is of images of" in lines(tmp_path)[0]["reason"]


def test_a_folder_that_is_being_written_is_followed(tmp_path: Path):
    folder = tmp_path / "in"
    folder.mkdir()
    whole = written(tmp_path / "whole", 3)

    def write() -> None:
        for k in range(3):
            data = (whole / f"{k}.png").read_bytes()
            with (folder / f"{k}.png").open("wb") as file:  # in two parts, as a slow camera does
                file.write(data[:1000])
                file.flush()
                time.sleep(0.15)
                file.write(data[1000:])

    writer = threading.Thread(target=write)
    writer.start()
    found = list(stream_images(folder, StreamSettings(follow=True, idle=1.5)))
    writer.join()
    assert [one.name for one in found] == ["0.png", "1.png", "2.png"]
    assert all(one.pixels is not None for one in found)


def test_of_waiting_images_only_the_latest_is_taken(tmp_path: Path):
    folder = written(tmp_path / "in", 3)
    found = list(stream_images(folder, StreamSettings(follow=True, idle=0.3, latest=True)))
    assert [one.name for one in found] == ["2.png"]


def test_a_folder_ends_after_seconds_without_an_image_not_after_a_slow_one(tmp_path: Path):
    folder = written(tmp_path / "in", 1)
    found = []
    for one in stream_images(folder, StreamSettings(follow=True, idle=0.4)):
        found.append(one.name)
        if len(found) == 1:
            time.sleep(0.5)  # an image that takes longer to place than --idle
            shutil.copy(folder / "0.png", folder / "1.png")
    assert found == ["0.png", "1.png"]


def test_an_image_that_is_removed_before_its_turn_is_lost_and_the_stream_goes_on(tmp_path: Path):
    folder = written(tmp_path / "in", 3)
    for settings in (StreamSettings(), StreamSettings(follow=True, idle=0.3)):
        written(folder, 3)
        stream = stream_images(folder, settings)
        first = next(stream)
        (folder / "1.png").unlink()
        rest = list(stream)
        assert [one.name for one in rest] == ["1.png", "2.png"]
        assert first.pixels is not None
        assert rest[0].pixels is None
        assert rest[0].fault
        assert rest[1].pixels is not None
        assert rest[0].time == first.time


def test_a_followed_folder_that_vanishes_is_said(tmp_path: Path):
    folder = written(tmp_path / "in", 1)
    stream = stream_images(folder, StreamSettings(follow=True))
    next(stream)
    shutil.rmtree(folder)
    with pytest.raises(InputError, match="no longer there"):
        next(stream)


def test_looking_for_new_images_reads_the_list_and_no_more(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    growing = GrowingFolder(tmp_path)
    for name in ("b10.jpg", "b9.jpg", "b9_mask.png", ".hidden.jpg", "notes.txt"):
        (tmp_path / name).touch()
    assert [path.name for path in growing.new_images()] == ["b9.jpg", "b10.jpg"]
    keyed: list[Path] = []
    monkeypatch.setattr(image_folder, "natural_key", lambda path, _: keyed.append(path) or [path.name])
    (tmp_path / "b11.jpg").touch()
    (tmp_path / "b10_mask.png").touch()
    assert [path.name for path in growing.new_images()] == ["b11.jpg"]
    assert growing.new_images() == []
    assert keyed == [tmp_path / "b11.jpg"]


def test_a_source_without_images_leaves_the_record_of_an_earlier_stream(tracker: Tracker, tmp_path: Path):
    (tmp_path / "in").mkdir()
    for source in ("in", "none.mp4"):
        with pytest.raises(InputError):
            stream_images(tmp_path / source, StreamSettings())  # before the record is opened
    out = written(tmp_path / "out", 1)
    (out / "stream.tum").write_text("of an earlier stream")
    localize_stream(tracker, stream_images(out, StreamSettings()), out)
    assert not (out / "stream.tum").exists()


def test_landmarks_of_a_run_that_cannot_be_written_to_are_made_with_a_warning(
    mapped: LandmarkMap, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
):
    def refused(*_: object, **__: object) -> None:
        raise OSError(errno.EROFS, "Read-only file system")

    parts = {"run_frames": SimpleNamespace(rows_rectified=False), "run_rectification": None, "content_digest": ""}
    parts |= {"load_reconstruction": SimpleNamespace(still=lambda _: None), "landmark_map": mapped}
    for name, value in (parts | {"has_several_lenses": False}).items():
        monkeypatch.setattr(landmark_file, name, lambda *_, value=value: value)
    monkeypatch.setattr(landmark_file.np, "savez", refused)
    found = landmark_file.landmarks_of_run(tmp_path, FEATURES)
    assert found.xyz is mapped.xyz
    assert "Read-only file system" in caplog.text


def test_a_bag_keeps_its_stamps_and_its_rate_is_thinned(tmp_path: Path):
    pixels = (photo(camera(0.0), texture()).numpy() * 255).astype(np.uint8)
    sent = [image("/cam/image_raw", pixels, "rgb8", START + k * 100_000_000) for k in range(6)]
    bag = write_bag(tmp_path, "mcap", sent)
    found = list(stream_images(bag, StreamSettings(fps=5)))
    assert [one.stamp_ns for one in found] == [START + k * 200_000_000 for k in range(3)]
    assert [round(one.time, 6) for one in found] == [0.0, 0.2, 0.4]


def test_a_video_cannot_be_followed(tmp_path: Path):
    path = tmp_path / "dive.mp4"
    path.write_bytes(b"")
    with pytest.raises(UsageError, match="no folder of images"):
        stream_images(path, StreamSettings(follow=True))


def test_an_empty_folder_is_refused(tmp_path: Path):
    with pytest.raises(InputError, match="holds no images"):
        list(stream_images(tmp_path, StreamSettings()))


def test_images_and_a_stream_are_one_too_many(tmp_path: Path, capsys: pytest.CaptureFixture[str]):
    with pytest.raises(SystemExit) as stop:
        main(["localize", str(tmp_path), "a.png", "--stream", str(tmp_path)])
    assert stop.value.code == 2
    assert "both images and --stream" in capsys.readouterr().err
