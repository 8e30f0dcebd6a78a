"""Poses without weights: from images of two textured planes whose poses are known, and from a murky real clip."""

import math
import shutil
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
import torch

from swimm3r.cameras import Cameras, project
from swimm3r.errors import InputError, RegistrationError, StorageError, UsageError
from swimm3r.geometry import align_similarity, rotation_angle, so3_exp
from swimm3r.prepare import read_frames
from swimm3r.scene.frames import Frame, Frames
from swimm3r.scene.reconstruction import Points, Reconstruction
from swimm3r.sfm.colmap import plausibility
from swimm3r.sfm.colmap import poses as colmap
from swimm3r.sfm.colmap.absolute_pose import absolute_pose
from swimm3r.sfm.colmap.adjustment import bundle_adjust
from swimm3r.sfm.colmap.calibration.start import first_camera, is_lens
from swimm3r.sfm.colmap.messages import too_few
from swimm3r.sfm.colmap.pairs import choose_pairs
from swimm3r.sfm.colmap.settings import MappingSettings
from swimm3r.sfm.features import database as feature_database
from swimm3r.sfm.settings import ColmapSettings
from swimm3r.synthetic import write_dive
from swimm3r.synthetic.settings import DiveSettings

WIDTH, HEIGHT, FOCAL, COUNT = 320, 240, 260.0, 8
SETTINGS = ColmapSettings(threads=2)


def _texture(seed: int, size: int = 1024) -> np.ndarray:
    rng = np.random.default_rng(seed)
    total = np.zeros((size, size), np.float32)
    for cells in (8, 16, 32, 64, 128, 256):
        total += cv2.resize(rng.random((cells, cells), np.float32), (size, size), interpolation=cv2.INTER_CUBIC)
    return (255 * (total - total.min()) / np.ptp(total)).astype(np.uint8)


def _cameras() -> Cameras:
    K = torch.tensor([[FOCAL, 0, WIDTH / 2], [0, FOCAL, HEIGHT / 2], [0, 0, 1]], dtype=torch.float64)
    cam2world = torch.eye(4, dtype=torch.float64).repeat(COUNT, 1, 1)
    s = torch.linspace(-1, 1, COUNT, dtype=torch.float64)
    zero = torch.zeros_like(s)
    cam2world[:, :3, :3] = so3_exp(torch.stack([0.12 * torch.cos(3 * s), -0.35 * s, 0.05 * s], 1))
    cam2world[:, :3, 3] = torch.stack([1.3 * s, 0.3 * torch.sin(3 * s), zero], 1)
    return Cameras(K.repeat(COUNT, 1, 1), torch.zeros(COUNT, 0, dtype=torch.float64), cam2world, WIDTH, HEIGHT)


def _render(cameras: Cameras, folder: Path) -> Frames:
    """Two planes: z = 4 behind, and slanted in front of it."""
    far, near = _texture(0), _texture(1)
    frames = []
    for i in range(len(cameras)):
        P = (cameras.K[i] @ cameras.world2cam[i, :3]).numpy()

        def homography(origin: list[float], u: list[float], v: list[float], P: np.ndarray = P) -> np.ndarray:
            return P @ np.stack([[*u, 0], [*v, 0], [*origin, 1]], 1)

        image = cv2.warpPerspective(
            far, homography([-5, -5, 4], [10 / 1024, 0, 0], [0, 10 / 1024, 0]), (WIDTH, HEIGHT), borderMode=1
        )
        H = homography([-0.9, -0.6, 2.4], [1.5 / 1024, 0, 0.9 / 1024], [0, 1.2 / 1024, 0.2 / 1024])
        front = cv2.warpPerspective(near, H, (WIDTH, HEIGHT))
        cover = cv2.warpPerspective(np.full_like(near, 255), H, (WIDTH, HEIGHT)) > 127
        path = folder / f"{i}.png"
        folder.mkdir(parents=True, exist_ok=True)
        cv2.imwrite(str(path), np.where(cover, front, image))
        frames.append(Frame(f"dive one/{i}.png", path, float(i), 0.0, "train"))
    return Frames(tuple(frames), WIDTH, HEIGHT, ordered=True)


@pytest.fixture(scope="module")
def frames(tmp_path_factory: pytest.TempPathFactory) -> Frames:
    return _render(_cameras(), tmp_path_factory.mktemp("images"))


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return tmp_path_factory.mktemp("sfm")


@pytest.fixture(scope="module")
def rec(frames: Frames, folder: Path) -> Reconstruction:
    return colmap.reconstruct(frames, SETTINGS, folder)


def _worst_rotation_deg(rec: Reconstruction, truth: Cameras) -> float:
    fit = align_similarity(rec.cameras.centers, truth.centers)
    turned = fit.poses(rec.cameras.cam2world)[:, :3, :3]
    return torch.rad2deg(rotation_angle(turned.mT @ truth.cam2world[:, :3, :3])).max().item()


def test_every_frame_of_a_good_clip_is_placed_where_it_was_taken(rec: Reconstruction, frames: Frames) -> None:
    truth = _cameras()
    assert rec.names == frames.names
    assert _worst_rotation_deg(rec, truth) < 0.3
    fit = align_similarity(rec.cameras.centers, truth.centers)
    assert (fit.points(rec.cameras.centers) - truth.centers).norm(dim=1).max() < 0.02
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
    truth = _cameras()
    i, j = rec.matches.i, rec.matches.j
    assert (i != j).all()
    assert len(i) > 1000
    R = truth.world2cam[i, :3, :3] @ truth.cam2world[j, :3, :3]
    t = (truth.world2cam[i, :3, :3] @ truth.cam2world[j, :3, 3:] + truth.world2cam[i, :3, 3:]).squeeze(-1)
    K_inverse = torch.linalg.inv(truth.K[0])
    rays_i, rays_j = (
        torch.cat([xy.double(), torch.ones(len(xy), 1, dtype=torch.float64)], 1) @ K_inverse.mT
        for xy in (rec.matches.xy_i, rec.matches.xy_j)
    )
    line = torch.linalg.cross(t, (R @ rays_j[..., None]).squeeze(-1))
    distance = (line * rays_i).sum(1).abs() / line[:, :2].norm(dim=1) * FOCAL
    assert (distance < 1.5).float().mean() > 0.95


def test_good_images_raise_no_warning(rec: Reconstruction) -> None:
    assert rec.warnings == ()


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


def test_the_global_method_finds_the_same_cameras(frames: Frames, folder: Path, rec: Reconstruction) -> None:
    settings = replace(SETTINGS, mapping=MappingSettings(method="global"))
    found = colmap.reconstruct(frames, settings, folder)
    assert found.names == rec.names
    assert _worst_rotation_deg(found, _cameras()) < 0.3


def test_fixed_intrinsics_stay_as_given(frames: Frames, tmp_path: Path) -> None:
    settings = replace(SETTINGS, focal=FOCAL, k1=0.01, intrinsics="fixed")
    found = colmap.reconstruct(frames, settings, tmp_path)
    assert found.cameras.model == "SIMPLE_RADIAL"
    assert found.cameras.K[0, 0, 0].item() == pytest.approx(FOCAL)
    assert found.cameras.distortion[0].tolist() == [0.01]


def test_a_flat_port_before_an_unknown_lens_is_confessed(frames: Frames, tmp_path: Path) -> None:
    found = colmap.reconstruct(frames, replace(SETTINGS, housing="flat"), tmp_path)
    assert any("flat port is not modeled" in warning.what for warning in found.warnings)


def test_the_lens_of_a_centered_dome_is_that_in_air(frames: Frames, tmp_path: Path) -> None:
    settings = replace(SETTINGS, focal=FOCAL, k1=0.01, housing="dome", intrinsics="fixed")
    found = colmap.reconstruct(frames, settings, tmp_path)
    assert found.cameras.model == "OPENCV"
    torch.testing.assert_close(found.cameras.K[0, 0, 0], torch.tensor(FOCAL).double(), rtol=1e-6, atol=0)
    assert found.cameras.distortion[0].tolist() == pytest.approx([0.01, 0, 0, 0], abs=1e-6)


def test_a_lens_that_is_given_is_held(frames: Frames, folder: Path, tmp_path: Path) -> None:
    shutil.copytree(folder, tmp_path, dirs_exist_ok=True)
    given = _cameras()[0]
    K = given.K * torch.tensor([1.02, 0.99, 1.0], dtype=torch.float64)[:, None]
    lens = replace(given, K=K, distortion=torch.tensor([[0.01, 0.0, 0.0, 0.001]]).double(), model="OPENCV")
    rec = colmap.reconstruct(frames, SETTINGS, tmp_path, lens=lens)
    assert len(rec.names) == COUNT
    assert rec.cameras.model == "OPENCV"
    torch.testing.assert_close(rec.cameras.K, K.expand(COUNT, 3, 3))
    torch.testing.assert_close(rec.cameras.distortion, lens.distortion.expand(COUNT, 4))


def test_frames_of_another_place_are_left_out_and_said(frames: Frames, tmp_path: Path) -> None:
    path = tmp_path / "elsewhere.png"
    cv2.imwrite(str(path), cv2.resize(_texture(9), (WIDTH, HEIGHT)))
    stranger = Frame("elsewhere.png", path, 9.0, 0.0, "train")
    found = colmap.reconstruct(replace(frames, frames=(*frames.frames, stranger)), SETTINGS, tmp_path / "sfm")
    assert found.names == frames.names
    assert any("1 of 9 frames could not be placed" in warning.what for warning in found.warnings)


@pytest.mark.parametrize("image", ["black", "unrelated"])
def test_images_without_common_ground_fail_with_advice(image: str, tmp_path: Path) -> None:
    frames = []
    for i in range(4):
        path = tmp_path / f"{i}.png"
        gray = np.zeros((HEIGHT, WIDTH), np.uint8)
        cv2.imwrite(str(path), gray if image == "black" else cv2.resize(_texture(20 + i), (WIDTH, HEIGHT)))
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


def test_a_full_disk_is_a_storage_error(frames: Frames, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def full(*_: object) -> None:
        raise RuntimeError("[sqlite3_utils.h:50] SQLite error: database or disk is full")

    monkeypatch.setattr(colmap, "fill_features", full)
    with pytest.raises(StorageError):
        colmap.reconstruct(frames, SETTINGS, tmp_path)


def test_video_is_matched_with_neighbors_and_lookalikes_only(rec, frames: Frames, folder: Path) -> None:
    camera = first_camera(WIDTH, HEIGHT, SETTINGS)
    store = feature_database.start_database(folder, frames, camera, SETTINGS.features)
    sparse = replace(SETTINGS, exhaustive_to=4, overlap=1, loops=1)
    pairs = choose_pairs(store, frames, sparse)
    assert {(i, i + 1) for i in range(COUNT - 1)} <= set(pairs)
    assert len(pairs) < COUNT * (COUNT - 1) // 2
    assert len(choose_pairs(store, frames, SETTINGS)) == COUNT * (COUNT - 1) // 2


@pytest.mark.parametrize(
    ("params", "believable"),
    [
        ([260, 160, 120, 0.05], True),
        ([30, 160, 120, 0.0], False),  # 160 degrees without a fisheye
        ([26000, 160, 120, 0.0], False),
        ([260, 160, 120, -0.8], False),  # the corner folds back
        ([260, 160, 120, 4.0], False),
    ],
)
def test_only_what_can_be_a_lens_is_kept(params: list[float], believable: bool) -> None:
    import pycolmap

    camera = pycolmap.Camera(model="SIMPLE_RADIAL", width=WIDTH, height=HEIGHT, params=params)
    assert is_lens(camera) is believable


@pytest.mark.parametrize(("tangential", "believable"), [(0.08, True), (-0.12, False)])
def test_a_lens_is_not_far_askew(tangential: float, believable: bool) -> None:
    import pycolmap

    params = [260, 260, 160, 120, 0.05, 0.0, 0.0, tangential]
    camera = pycolmap.Camera(model="OPENCV", width=WIDTH, height=HEIGHT, params=params)
    assert is_lens(camera) is believable


def test_pnp_finds_the_pose_among_outliers() -> None:
    truth = _cameras()[2]
    generator = torch.Generator().manual_seed(0)
    points = torch.rand(100, 3, generator=generator, dtype=torch.float64) * 2 + torch.tensor([-1.0, -1, 2.5])
    pixels, _ = project(truth, points[None])
    pixels = pixels[0].clone()
    pixels[:30] += 50 * torch.rand(30, 2, generator=generator, dtype=torch.float64) + 20
    found = absolute_pose(pixels, points, truth)
    assert found is not None
    pose, inliers = found
    torch.testing.assert_close(pose, truth.cam2world[0], atol=1e-4, rtol=0)
    assert inliers.tolist() == [False] * 30 + [True] * 70


def test_pnp_without_a_consistent_pose_finds_none() -> None:
    generator = torch.Generator().manual_seed(0)
    pixels = torch.rand(3, 2, generator=generator) * 200
    assert absolute_pose(pixels, torch.zeros(3, 3), _cameras()[0]) is None


def test_bundle_adjustment_mends_shaken_poses(rec: Reconstruction) -> None:
    generator = torch.Generator().manual_seed(0)
    shaken = rec.cameras.cam2world.clone()
    shaken[:, :3, 3] += 0.01 * rec.cameras.centers.std() * torch.randn(COUNT, 3, generator=generator)
    mended = bundle_adjust(replace(rec, cameras=replace(rec.cameras, cam2world=shaken)))
    assert mended.names == rec.names
    assert _worst_rotation_deg(mended, _cameras()) < 0.3
    assert mended.points.error.mean() < 1.1 * rec.points.error.mean()


def test_a_tiled_floor_has_twins_and_a_reef_has_none() -> None:
    from swimm3r.sfm.features.settings import FeatureSettings
    from swimm3r.sfm.features.sift import extract_features, unit_descriptors

    usable = torch.ones(HEIGHT, WIDTH, dtype=torch.bool)
    tile = cv2.resize(_texture(3), (40, 40))

    def share(gray: np.ndarray) -> float:
        image = torch.from_numpy(np.repeat(gray[..., None], 3, 2).astype(np.float32) / 255)
        found = extract_features(image, usable, FeatureSettings())
        xy = torch.from_numpy(found.keypoints[:, :2].copy())
        return plausibility.twin_share(xy, unit_descriptors(found.descriptors))

    assert share(np.tile(tile, (6, 8))) > 0.6
    assert share(cv2.resize(_texture(4), (WIDTH, HEIGHT))) < 0.05


def test_halves_that_share_no_points_are_called_badly_joined(rec, frames: Frames, folder: Path) -> None:
    camera = first_camera(WIDTH, HEIGHT, SETTINGS)
    store = feature_database.start_database(folder, frames, camera, SETTINGS.features)
    first = rec.tracks.frame < COUNT // 2
    half = torch.where(first, rec.tracks.point, rec.tracks.point + len(rec.points.xyz))
    doubled = replace(
        rec,
        tracks=replace(rec.tracks, point=half),
        points=Points(rec.points.xyz.repeat(2, 1), rec.points.rgb.repeat(2, 1), rec.points.error.repeat(2)),
    )
    said = [warning.what for warning in plausibility.implausible(doubled, store, frames)]
    assert any("Parts of 4 + 4 frames did not join" in what for what in said)


def test_a_camera_that_only_turned_is_implausible(rec, frames: Frames, folder: Path) -> None:
    camera = first_camera(WIDTH, HEIGHT, SETTINGS)
    store = feature_database.start_database(folder, frames, camera, SETTINGS.features)
    far = replace(rec, points=replace(rec.points, xyz=rec.points.xyz * 300))
    said = [warning.what for warning in plausibility.implausible(far, store, frames)]
    assert any("rays only" in what for what in said)


def test_a_model_without_one_scale_is_refused(frames: Frames, folder: Path, rec, tmp_path: Path, monkeypatch) -> None:
    """A dolphin before open water: all frames placed, the animal some billion times as far in one as in another."""
    depth = rec.cameras.centers.sub(rec.points.xyz.mean(0)).norm(dim=1)
    shrunk = replace(rec, cameras=replace(rec.cameras, cam2world=rec.cameras.cam2world.clone()))
    shrunk.cameras.cam2world[0, :3, 3] -= 2000 * depth[0] * rec.cameras.cam2world[0, :3, 2]
    assert plausibility.depth_change(rec) < 3
    assert plausibility.depth_change(shrunk) > 1000
    monkeypatch.setattr(colmap, "record_of", lambda *_: shrunk)
    with pytest.raises(RegistrationError, match="not in one scale"):
        colmap.reconstruct(frames, SETTINGS, tmp_path)


def test_a_leap_of_the_camera_is_said(rec, frames: Frames, folder: Path) -> None:
    camera = first_camera(WIDTH, HEIGHT, SETTINGS)
    store = feature_database.start_database(folder, frames, camera, SETTINGS.features)
    poses = rec.cameras.cam2world.clone()
    poses[5:, :3, 3] += 100 * rec.cameras.centers.std()
    leap = replace(rec, cameras=replace(rec.cameras, cam2world=poses))
    said = [warning.what for warning in plausibility.implausible(leap, store, frames)]
    assert any(f"jumps 1 time, first at {rec.names[5]}" in what for what in said)


@pytest.mark.parametrize("seconds", [1.0, 2.0])
def test_a_turn_over_a_frame_that_was_held_back_is_no_leap(rec, frames: Frames, folder: Path, seconds: float) -> None:
    camera = first_camera(WIDTH, HEIGHT, SETTINGS)
    store = feature_database.start_database(folder, frames, camera, SETTINGS.features)
    poses = rec.cameras.cam2world.clone()
    about = torch.tensor([0.0, math.radians(40.0), 0.0], dtype=torch.float64)
    back, ahead = poses[4, :3, :3], poses[5, :3, :3].clone()
    poses[5:, :3, :3] = back @ so3_exp(about) @ ahead.mT @ poses[5:, :3, :3]
    turned = replace(rec, cameras=replace(rec.cameras, cam2world=poses))
    late = {name: k + (seconds - 1) * (k >= 5) for k, name in enumerate(rec.names)}
    timed = replace(frames, frames=tuple(replace(f, time=late.get(f.name, f.time)) for f in frames.frames))
    said = [warning.what for warning in plausibility.implausible(turned, store, timed)]
    assert any("path jumps" in what for what in said) == (seconds == 1)


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
