"""Poses without weights: from images of two textured planes whose poses are known, and from a murky real clip."""

import shutil
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
import torch
from tests.sfm.colmap.two_planes import (
    COUNT,
    FOCAL,
    HEIGHT,
    SETTINGS,
    WIDTH,
    camera_path,
    off_true_lines,
    texture,
    worst_rotation_deg,
)

from swimm3r.cameras import project
from swimm3r.errors import InputError, RegistrationError, StorageError, UsageError
from swimm3r.geometry import align_similarity
from swimm3r.io.colmap.model import read_model
from swimm3r.prepare import read_frames
from swimm3r.scene.frames import Frame, Frames
from swimm3r.scene.reconstruction import Reconstruction
from swimm3r.sfm.colmap import poses as colmap
from swimm3r.sfm.colmap.calibration.start import first_camera
from swimm3r.sfm.colmap.chunks import parts
from swimm3r.sfm.colmap.messages import lens_not_told, too_few
from swimm3r.sfm.colmap.pairs import check_pairs, choose_pairs
from swimm3r.sfm.colmap.settings import MappingSettings
from swimm3r.sfm.features import database as feature_database
from swimm3r.sfm.settings import ColmapSettings
from swimm3r.synthetic import write_dive
from swimm3r.synthetic.settings import DiveSettings


def test_every_frame_of_a_good_clip_is_placed_where_it_was_taken(rec: Reconstruction, frames: Frames) -> None:
    truth = camera_path()
    assert rec.names == frames.names
    assert worst_rotation_deg(rec, truth) < 0.03
    fit = align_similarity(rec.cameras.centers, truth.centers)
    assert (fit.points(rec.cameras.centers) - truth.centers).norm(dim=1).max() < 0.002
    assert rec.backend == "colmap"
    assert not rec.metric


def test_the_lens_is_found_without_being_told(rec: Reconstruction) -> None:
    assert rec.cameras.K[0, 0, 0].item() == pytest.approx(FOCAL, rel=0.03)


def test_points_reproject_where_their_tracks_saw_them(rec: Reconstruction) -> None:
    for i in range(len(rec.names)):
        own = rec.tracks.frame == i
        pixels, z = project(rec.cameras[i], rec.points.xyz[rec.tracks.point[own]][None])
        assert (z > 0).all()
        assert (pixels[0] - rec.tracks.xy[own]).norm(dim=1).mean() < 1.0


def test_points_have_the_color_of_the_image(rec: Reconstruction, frames: Frames) -> None:
    own = rec.tracks.frame == 3
    x, y = rec.tracks.xy[own].long().unbind(1)
    seen = frames.image(3)[y, x]
    assert (seen - rec.points.rgb[rec.tracks.point[own]]).abs().mean() < 0.05


def test_matches_join_projections_of_one_surface_point(rec: Reconstruction) -> None:
    matches = rec.matches
    assert (matches.i != matches.j).all()
    assert len(matches.i) > 1000
    distance = off_true_lines(matches.i, matches.j, matches.xy_i, matches.xy_j)
    assert (distance < 1.5).float().mean() > 0.95


def test_good_images_raise_no_warning(rec: Reconstruction) -> None:
    assert rec.warnings == ()


@pytest.mark.long
def test_a_second_run_goes_on_from_the_database_and_ends_in_the_same_poses(
    rec: Reconstruction, frames: Frames, folder: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def never(*_: object) -> None:
        raise AssertionError("what is in the database must not be computed again")

    monkeypatch.setattr(feature_database, "extract_features", never)
    monkeypatch.setattr(feature_database, "match_descriptors", never)
    again = colmap.reconstruct(frames, SETTINGS, folder)
    assert torch.equal(again.cameras.cam2world, rec.cameras.cam2world)
    assert torch.equal(again.points.xyz, rec.points.xyz)


def test_an_interrupted_run_leaves_a_database_that_a_later_one_completes(
    rec: Reconstruction, frames: Frames, tmp_path: Path
) -> None:
    def interrupt_at(stage: str, count: int):
        def progress(what: str, done: int, total: int, /) -> None:
            if what == stage and done >= count:
                raise KeyboardInterrupt

        return progress

    for stage, count in (("finding features", 3), ("matching frames", 5), ("placing frames", 4)):
        with pytest.raises(KeyboardInterrupt):
            colmap.reconstruct(frames, SETTINGS, tmp_path, interrupt_at(stage, count))
    finished = colmap.reconstruct(frames, SETTINGS, tmp_path)
    assert torch.equal(finished.cameras.cam2world, rec.cameras.cam2world)
    assert sorted(path.name for path in tmp_path.iterdir()) == ["database.db", "database.json"]


def test_the_journal_of_a_killed_run_is_not_replayed(rec, frames: Frames, folder: Path, tmp_path: Path) -> None:
    shutil.copytree(folder, tmp_path / "sfm")
    killed = feature_database.FeatureDatabase(tmp_path / "killed" / "mapping.db", COUNT)
    killed.path.parent.mkdir()
    shutil.copyfile(folder / "database.db", killed.path)
    with killed.open() as database:
        database.update_keypoints(1, np.full_like(database.read_keypoints(1), 7))
        for left in killed.path.parent.iterdir():  # as long as it is open, the change is in the journal alone
            shutil.copyfile(left, tmp_path / "sfm" / left.name)
    assert (tmp_path / "sfm" / "mapping.db-wal").stat().st_size > 0

    def progress(what: str, _done: int, _total: int, /) -> None:
        if what == "placing frames":
            with replace(killed, path=tmp_path / "sfm" / "mapping.db").open() as database:
                used.append(database.read_keypoints(1))
            raise KeyboardInterrupt

    used: list[np.ndarray] = []
    with pytest.raises(KeyboardInterrupt):
        colmap.reconstruct(frames, SETTINGS, tmp_path / "sfm", progress)
    assert np.ptp(used[0][:, 0]) > 0.5 * WIDTH
    assert sorted(path.name for path in (tmp_path / "sfm").iterdir()) == ["database.db", "database.json"]


def test_other_settings_start_a_new_database(frames: Frames, tmp_path: Path) -> None:
    camera = first_camera(WIDTH, HEIGHT, SETTINGS)
    store = feature_database.start_database(tmp_path, frames, camera, SETTINGS.features)
    with store.open() as database:
        database.write_keypoints(1, np.zeros((1, 4), np.float32))
    same = feature_database.start_database(tmp_path, frames, camera, SETTINGS.features)
    with same.open() as database:
        assert database.exists_keypoints(1)
    other = feature_database.start_database(tmp_path, frames, camera, replace(SETTINGS.features, count=100))
    with other.open() as database:
        assert not database.exists_keypoints(1)


@pytest.mark.long
def test_the_global_method_finds_the_same_cameras(frames: Frames, folder: Path, rec: Reconstruction) -> None:
    settings = replace(SETTINGS, mapping=MappingSettings(method="global"))
    found = colmap.reconstruct(frames, settings, folder)
    assert found.names == rec.names
    assert worst_rotation_deg(found, camera_path()) < 0.3


def test_fixed_intrinsics_stay_as_given(frames: Frames, tmp_path: Path) -> None:
    settings = replace(SETTINGS, focal=FOCAL, k1=0.01, intrinsics="fixed")
    found = colmap.reconstruct(frames, settings, tmp_path)
    assert found.cameras.model == "SIMPLE_RADIAL"
    assert found.cameras.K[0, 0, 0].item() == pytest.approx(FOCAL)
    assert found.cameras.distortion[0].tolist() == [0.01]


@pytest.mark.long
def test_a_flat_port_before_an_unknown_lens_is_confessed(frames: Frames, tmp_path: Path) -> None:
    found = colmap.reconstruct(frames, replace(SETTINGS, housing="flat"), tmp_path)
    assert any("flat port is not modeled" in warning.what for warning in found.warnings)


@pytest.mark.long
def test_the_lens_of_a_centered_dome_is_that_in_air(frames: Frames, tmp_path: Path) -> None:
    settings = replace(SETTINGS, focal=FOCAL, k1=0.01, housing="dome", intrinsics="fixed")
    found = colmap.reconstruct(frames, settings, tmp_path)
    assert found.cameras.model == "OPENCV"
    torch.testing.assert_close(found.cameras.K[0, 0, 0], torch.tensor(FOCAL).double(), rtol=1e-6, atol=0)
    assert found.cameras.distortion[0].tolist() == pytest.approx([0.01, 0, 0, 0], abs=1e-6)


def test_a_lens_that_is_given_is_held(frames: Frames, folder: Path, tmp_path: Path) -> None:
    shutil.copytree(folder, tmp_path, dirs_exist_ok=True)
    given = camera_path()[0]
    K = given.K * torch.tensor([1.02, 0.99, 1.0], dtype=torch.float64)[:, None]
    lens = replace(given, K=K, distortion=torch.tensor([[0.01, 0.0, 0.0, 0.001]]).double(), model="OPENCV")
    rec = colmap.reconstruct(frames, SETTINGS, tmp_path, lens=lens)
    assert len(rec.names) == COUNT
    assert rec.cameras.model == "OPENCV"
    torch.testing.assert_close(rec.cameras.K, K.expand(COUNT, 3, 3))
    torch.testing.assert_close(rec.cameras.distortion, lens.distortion.expand(COUNT, 4))


@pytest.mark.long
def test_frames_of_another_place_are_left_out_and_said(frames: Frames, tmp_path: Path) -> None:
    path = tmp_path / "elsewhere.png"
    cv2.imwrite(str(path), cv2.resize(texture(9), (WIDTH, HEIGHT)))
    stranger = Frame("elsewhere.png", path, 9.0, 0.0, "train")
    found = colmap.reconstruct(replace(frames, frames=(*frames.frames, stranger)), SETTINGS, tmp_path / "sfm")
    assert found.names == frames.names
    assert any("1 of 9 frames could not be placed" in warning.what for warning in found.warnings)


def test_what_is_cut_off_a_model_whose_scale_jumps_is_a_part(
    rec: Reconstruction, frames: Frames, folder: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Placed again beside the rest with looser limits, its frames are cut off again, and are one part all the same."""

    def cut(part: parts.Part) -> list[parts.Part]:
        pieces = part.images[:3], part.images[3:]
        return [replace(part, cam_from_world={i: part.cam_from_world[i] for i in piece}) for piece in pieces]

    monkeypatch.setattr(parts, "coherent_parts", cut)
    shutil.copytree(folder, tmp_path / "sfm")
    settings = replace(SETTINGS, mapping=MappingSettings(method="incremental", align_keypoints=False))
    found = colmap.reconstruct(frames, settings, tmp_path / "sfm")
    assert found.names == frames.names[3:]
    assert any(f"({COUNT - 3} + 3 of {COUNT})" in warning.what for warning in found.warnings)
    assert read_model(tmp_path / "sfm" / colmap.PARTS / "1").names == frames.names[:3]
    assert not (tmp_path / "sfm" / colmap.PARTS / "2").exists()


@pytest.mark.parametrize("image", ["black", "unrelated"])
def test_images_without_common_ground_fail_with_advice(image: str, tmp_path: Path) -> None:
    frames = []
    for i in range(4):
        path = tmp_path / f"{i}.png"
        gray = np.zeros((HEIGHT, WIDTH), np.uint8)
        cv2.imwrite(str(path), gray if image == "black" else cv2.resize(texture(20 + i), (WIDTH, HEIGHT)))
        frames.append(Frame(path.name, path, float(i), 0.0, "train"))
    with pytest.raises(RegistrationError, match="of 4 frames") as caught:
        colmap.reconstruct(Frames(tuple(frames), WIDTH, HEIGHT, True), SETTINGS, tmp_path / "sfm")
    assert "--fps" in caught.value.hint


@pytest.mark.parametrize(("focal", "doubted"), [(9.8 * WIDTH, True), (1.2 * WIDTH, False), (None, False)])
def test_a_given_focal_length_of_no_lens_is_named_where_frames_cannot_be_placed(
    focal: float | None, doubted: bool, frames: Frames
) -> None:
    error = too_few(0, frames, replace(SETTINGS, focal=focal))
    assert (f"{9.8 * WIDTH:.0f} px" in error.cause and "--calibration" in error.hint) == doubted
    assert ("--fps" in error.hint) != doubted


def test_two_frames_of_an_open_lens_are_refused_with_what_they_lack_and_placed_under_a_held_one(
    frames: Frames, tmp_path: Path
) -> None:
    two, given = frames.select([2, 5]), replace(SETTINGS, focal=FOCAL)
    with pytest.raises(RegistrationError, match="none of 2 frames") as caught:
        colmap.reconstruct(two, given, tmp_path)
    assert "lens" in caught.value.what
    assert "--intrinsics fixed" in caught.value.hint
    assert caught.value.exit_code == 6
    held = colmap.reconstruct(two, replace(given, intrinsics="fixed"), tmp_path)
    assert held.names == two.names


def test_frames_that_overlap_in_pairs_alone_are_told_from_few_frames(frames: Frames) -> None:
    assert "seen in three" not in lens_not_told(frames.select([0, 1])).cause
    assert "seen in three" in lens_not_told(frames.select([0, 1, 2])).cause


def test_many_images_without_a_feature_fail_with_advice(tmp_path: Path) -> None:
    cv2.imwrite(str(tmp_path / "black.png"), np.zeros((HEIGHT, WIDTH), np.uint8))
    black = tuple(Frame(f"{i}.png", tmp_path / "black.png", float(i), 0.0, "train") for i in range(3))
    with pytest.raises(RegistrationError, match="of 3 frames"):
        colmap.reconstruct(Frames(black, WIDTH, HEIGHT, True), replace(SETTINGS, exhaustive_to=2), tmp_path / "sfm")


def test_a_folder_without_similar_images_to_match_is_a_usage_error_before_any_work(frames, tmp_path: Path) -> None:
    settings, folder = replace(SETTINGS, exhaustive_to=4, loops=0), tmp_path / "sfm"
    with pytest.raises(UsageError, match="--loops 0 leaves the 8 images"):
        colmap.reconstruct(replace(frames, ordered=False), settings, folder)
    assert not folder.exists()


@pytest.mark.parametrize("settings", [{"exhaustive_to": COUNT}, {"pairs": "exhaustive"}, {"pairs": "sequential"}])
def test_without_loops_every_pair_or_neighbors_of_a_folder_are_matched(frames: Frames, settings: dict) -> None:
    check_pairs(replace(frames, ordered=False), replace(SETTINGS, **{"exhaustive_to": 4, "loops": 0, **settings}))
    check_pairs(frames, replace(SETTINGS, exhaustive_to=4, loops=0))


def test_a_given_focal_length_is_judged_in_pixels_of_the_frames(tmp_path: Path) -> None:
    cv2.imwrite(str(tmp_path / "black.png"), np.zeros((HEIGHT, WIDTH), np.uint8))
    black = tuple(Frame(f"{i}.png", tmp_path / "black.png", float(i), 0.0, "train") for i in range(2))
    settings = replace(SETTINGS, focal=0.5 * WIDTH, features=replace(SETTINGS.features, long_side=WIDTH // 2))
    with pytest.raises(RegistrationError, match="only 0 of 2") as caught:
        colmap.reconstruct(Frames(black, WIDTH, HEIGHT, True), settings, tmp_path / "sfm")
    assert "focal length" not in caught.value.cause


def test_one_frame_is_an_input_error(frames: Frames, tmp_path: Path) -> None:
    with pytest.raises(InputError, match="at least 2"):
        colmap.reconstruct(frames.select([0]), SETTINGS, tmp_path)


@pytest.mark.parametrize(
    ("settings", "message"),
    [
        (ColmapSettings(camera="SIMPLE_RADIAL", k2=0.1), "has no k2"),
        (ColmapSettings(focal=4.2), "does not fit"),
        (ColmapSettings(intrinsics="fixed"), "need a focal length"),
    ],
)
def test_settings_that_contradict_themselves_are_usage_errors(settings: ColmapSettings, message: str) -> None:
    with pytest.raises(UsageError, match=message):
        first_camera(WIDTH, HEIGHT, settings)


@pytest.mark.parametrize(
    ("message", "error"),
    [
        ("database or disk is full", StorageError),
        ("disk I/O error", StorageError),
        ("attempt to write a readonly database", StorageError),
        ("database disk image is malformed", RuntimeError),
    ],
)
def test_a_disk_that_cannot_be_written_is_a_storage_error_and_damage_is_not(
    message: str, error: type[Exception], frames: Frames, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def failing(*_: object) -> None:
        raise RuntimeError(f"[sqlite3_utils.h:50] SQLite error: {message}")

    monkeypatch.setattr(colmap, "fill_features", failing)
    with pytest.raises(error, match=message):
        colmap.reconstruct(frames, SETTINGS, tmp_path)


def test_video_is_matched_with_neighbors_and_lookalikes_only(rec, frames: Frames, folder: Path) -> None:
    camera = first_camera(WIDTH, HEIGHT, SETTINGS)
    store = feature_database.start_database(folder, frames, camera, SETTINGS.features)
    sparse = replace(SETTINGS, exhaustive_to=4, overlap=1, loops=1)
    pairs = choose_pairs(store, frames, sparse)
    assert {(i, i + 1) for i in range(COUNT - 1)} <= set(pairs)
    assert len(pairs) < COUNT * (COUNT - 1) // 2
    assert len(choose_pairs(store, frames, SETTINGS)) == COUNT * (COUNT - 1) // 2


@pytest.mark.shared
def test_a_murky_real_clip_is_placed_without_any_prior(shared: Path, tmp_path: Path) -> None:
    paths = [p for i, p in enumerate(sorted((shared / "data/ruie_murky/images").iterdir())) if i % 8]
    real = Frames(tuple(Frame(p.name, p, float(i), 0.0, "train") for i, p in enumerate(paths)), 400, 300, False)
    found = colmap.reconstruct(real, SETTINGS, tmp_path)
    assert len(found.names) >= 0.9 * len(real)
    assert not any("implausible" in warning.what for warning in found.warnings)


def test_frames_larger_than_the_images_of_keypoints_are_mapped_in_their_pixels(tmp_path: Path):
    settings = replace(SETTINGS, features=replace(SETTINGS.features, long_side=160))
    dive = DiveSettings(frames=10, width=240, height=160)
    write_dive(dive, tmp_path / "dive")
    frames = read_frames(tmp_path / "dive", folder=tmp_path / "prepare").train
    rec = colmap.reconstruct(frames, settings, tmp_path / "sfm")
    store = feature_database.FeatureDatabase(tmp_path / "sfm" / "database.db", len(frames))
    with store.open() as database:
        assert (database.read_camera(1).width, database.read_camera(1).height) == (160, 107)
        assert database.read_keypoints(1)[:, 0].max() <= 160
    assert (rec.cameras.width, rec.cameras.height) == (240, 160)
    focal = 120 / np.tan(np.deg2rad(dive.fov / 2))
    assert rec.cameras.K[0, 0, 0].item() == pytest.approx(focal, rel=0.05)
    assert rec.cameras.K[0, :2, 2].tolist() == pytest.approx([120, 80])
    assert rec.tracks.xy[:, 0].max() > 170
    assert rec.matches.xy_i[:, 0].max() > 170
    pixels = project(rec.cameras[0], rec.points.xyz[None].double())[0][0]
    own = rec.tracks.frame == 0
    assert (pixels[rec.tracks.point[own]] - rec.tracks.xy[own]).norm(dim=1).median() < 1
