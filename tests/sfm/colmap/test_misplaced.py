"""Frames that stand in the wrong place: one among others that stand right, and a whole part of the clip."""

import shutil
from dataclasses import replace

import numpy as np
import pycolmap
import pytest

from swimm3r.prepare import read_frames
from swimm3r.progress import silent
from swimm3r.scene.frames import Frames
from swimm3r.sfm.colmap import epipolar_outliers, mapping, poses
from swimm3r.sfm.colmap.calibration import start
from swimm3r.sfm.colmap.calibration.start import lenses_of_pairs
from swimm3r.sfm.colmap.epipolar_outliers import CheckedPair, checked_pairs, contradicting_frames
from swimm3r.sfm.colmap.resection_outliers import misplaced_frames
from swimm3r.sfm.features.database import FeatureDatabase
from swimm3r.sfm.settings import ColmapSettings
from swimm3r.synthetic import write_dive
from swimm3r.synthetic.settings import DiveSettings

SETTINGS = ColmapSettings(threads=2)
INCREMENTAL = replace(SETTINGS, mapping=replace(SETTINGS.mapping, method="incremental"))
WRONG = 3  # image id
WIDTH = 240


@pytest.fixture(scope="module")
def store(tmp_path_factory: pytest.TempPathFactory) -> FeatureDatabase:
    folder = tmp_path_factory.mktemp("resection")
    write_dive(DiveSettings(frames=10, width=WIDTH, height=160), folder / "dive")
    frames: Frames = read_frames(folder / "dive", folder=folder / "prepare").train
    poses.reconstruct(frames, SETTINGS, folder / "sfm")
    shutil.copyfile(folder / "sfm" / "database.db", folder / "mapping.db")
    return FeatureDatabase(folder / "mapping.db", len(frames))


@pytest.fixture
def model(store: FeatureDatabase) -> pycolmap.Reconstruction:
    return mapping.map_frames(store, INCREMENTAL, silent)[0]


def moved(model: pycolmap.Reconstruction, degrees: float, which: tuple[int, ...] = (WRONG,)) -> pycolmap.Reconstruction:
    """The model with frames swung about the scene's center, as the second solution of a flat bottom swings them."""
    center = np.median([point.xyz for point in model.points3D.values()], axis=0)
    turn = pycolmap.Rotation3d(np.array([0.0, np.deg2rad(degrees), 0.0]))
    swing = pycolmap.Rigid3d(turn, center - turn.matrix() @ center)
    out = pycolmap.Reconstruction(model)
    for image_id in which:
        image = out.images[image_id]
        assert image.frame is not None
        image.frame.set_cam_from_world(image.camera_id, image.cam_from_world() * swing)
    return out


def rotations(model: pycolmap.Reconstruction) -> dict[int, np.ndarray]:
    first = model.images[1].cam_from_world().rotation.matrix()
    return {i: model.images[i].cam_from_world().rotation.matrix() @ first.T for i in model.reg_image_ids()}


def test_frames_that_stand_right_are_left_alone(store: FeatureDatabase, model: pycolmap.Reconstruction):
    assert misplaced_frames(store, model) == []
    assert contradicting_frames(store, model) == []
    assert mapping.replace_misplaced(store, model, SETTINGS, silent) is model


def test_a_swung_frame_is_found_and_placed_again(store: FeatureDatabase, model: pycolmap.Reconstruction):
    wrong = moved(model, 25)
    assert misplaced_frames(store, wrong) == [WRONG]
    assert_same(rotations(mapping.replace_misplaced(store, wrong, SETTINGS, silent)), rotations(model))


def test_every_round_of_placing_counts_up_to_its_end(store: FeatureDatabase, model: pycolmap.Reconstruction):
    told: list[tuple[str, int, int]] = []
    settings = replace(SETTINGS, mapping=replace(SETTINGS.mapping, method="auto"))
    mapping.map_frames(store, settings, lambda *call: told.append(call))
    mapping.replace_misplaced(store, moved(model, 25, (1, 2, 3)), settings, lambda *call: told.append(call))
    assert {what for what, _, _ in told} >= {"placing frames", "placing all frames at once"}
    rounds: list[list[tuple[str, int, int]]] = []
    for call in told:
        if not rounds or rounds[-1][-1][0] != call[0] or rounds[-1][-1][1] == rounds[-1][-1][2]:
            rounds.append([])
        rounds[-1].append(call)
    for calls in rounds:
        counts = [done for _, done, _ in calls]
        assert counts == sorted(counts)
        assert calls[-1][1] == calls[-1][2]
    leftover = {total for what, _, total in told if what == "placing the frames left over"}
    assert leftover == {3}  # not of all nine frames


def test_a_part_of_the_clip_that_agrees_with_itself_but_not_with_the_rest_is_placed_again(
    store: FeatureDatabase, model: pycolmap.Reconstruction
):
    part = (1, 2, 3)
    wrong = moved(model, 25, part)
    assert contradicting_frames(store, wrong) == [*part]
    assert_same(rotations(mapping.replace_misplaced(store, wrong, SETTINGS, silent)), rotations(model))


def test_pairs_that_passed_the_verification_by_chance_take_no_frame_out(
    store: FeatureDatabase, model: pycolmap.Reconstruction, monkeypatch: pytest.MonkeyPatch
):
    """As looser matching finds them between frames that share no ground: with few matches each."""
    pairs = checked_pairs(store, model)
    chance = {
        pair: CheckedPair(150.0, 16) if WRONG in pair and k % 2 else each
        for k, (pair, each) in enumerate(pairs.items())
    }
    wrong = [pair for pair in chance if chance[pair] != pairs[pair]]
    assert len(wrong) > 0.3 * sum(WRONG in pair for pair in pairs)
    monkeypatch.setattr(epipolar_outliers, "checked_pairs", lambda *_: chance)
    assert contradicting_frames(store, model) == []
    strong = {pair: CheckedPair(150.0, pairs[pair].matches) if pair in wrong else each for pair, each in pairs.items()}
    monkeypatch.setattr(epipolar_outliers, "checked_pairs", lambda *_: strong)
    assert contradicting_frames(store, model) == [WRONG]


@pytest.mark.parametrize("wrong_one", ["_try_focal_lengths", "_map_globally"])
def test_of_two_ways_to_place_a_small_clip_the_one_that_explains_more_is_kept(
    store: FeatureDatabase, model: pycolmap.Reconstruction, monkeypatch: pytest.MonkeyPatch, wrong_one: str
):
    wrong = moved(model, 25, (1, 2, 3, 4))
    wrong.update_point_3d_errors()
    for way in ("_try_focal_lengths", "_map_globally"):
        monkeypatch.setattr(mapping, way, lambda *_, found=wrong if way == wrong_one else model: [found])
    monkeypatch.setattr(mapping, "_replaced", lambda store, model, *_: (model, False))
    for thin_points, kept in ((1, model), (100_000, wrong if wrong_one == "_try_focal_lengths" else model)):
        settings = replace(SETTINGS, mapping=replace(SETTINGS.mapping, thin_points=thin_points))
        assert mapping.map_frames(store, settings, silent) == [kept]


@pytest.mark.parametrize(("off", "kept_rough"), [(0.02, False), (0.0005, True)])
def test_a_model_whose_errors_are_large_everywhere_is_compared_with_all_frames_at_once(
    store: FeatureDatabase,
    model: pycolmap.Reconstruction,
    monkeypatch: pytest.MonkeyPatch,
    off: float,
    kept_rough: bool,
):
    """No frame stands against the others where the first pair's motion squeezed the whole scene."""
    rough, rng = pycolmap.Reconstruction(model), np.random.default_rng(0)
    for number, point in rough.points3D.items():
        rough.points3D[number].xyz = point.xyz * (1 + off * rng.standard_normal(3))
    rough.update_point_3d_errors()
    monkeypatch.setattr(mapping, "_try_focal_lengths", lambda *_: [rough])
    monkeypatch.setattr(mapping, "_map_globally", lambda *_: [model])
    monkeypatch.setattr(mapping, "_replaced", lambda store, model, *_: (model, True))
    monkeypatch.setattr(mapping, "flat_share", lambda _: 0.0)
    settings = replace(SETTINGS, mapping=replace(SETTINGS.mapping, thin_points=1))
    assert mapping.map_frames(store, settings, silent) == [rough if kept_rough else model]


@pytest.mark.parametrize("share", [0.7, 1.3])
def test_all_frames_at_once_stay_in_place_though_the_lens_was_far_off(
    store: FeatureDatabase, monkeypatch: pytest.MonkeyPatch, share: float
):
    """Their lens is adjusted before frames are judged: none is taken out, and nothing is mapped in turn."""

    def never(*_, **__):
        pytest.fail("frames were mapped in turn")

    monkeypatch.setattr(mapping, "_map_in_turn", never)
    focal = WIDTH / 2 / np.tan(np.deg2rad(DiveSettings().fov / 2))
    settings = replace(
        SETTINGS, mapping=replace(SETTINGS.mapping, method="global", focal_ladder=(share * focal / WIDTH,))
    )
    found = mapping.map_frames(store, settings, silent)[0]
    assert found.num_reg_images() == store.frames
    assert found.cameras[1].mean_focal_length() == pytest.approx(focal, rel=0.03)


@pytest.mark.parametrize(("known", "expected"), [(None, 0.7), (0.8, 0.8)])
def test_the_lens_that_pairs_agree_on_is_tried_alone_unless_it_is_known(
    store: FeatureDatabase, monkeypatch: pytest.MonkeyPatch, known: float | None, expected: float
):
    monkeypatch.setattr(start, "focal_of_pairs", lambda _: 0.7 * WIDTH)
    settings = replace(SETTINGS, focal=None if known is None else known * WIDTH)
    assert [lens.mean_focal_length() for lens in lenses_of_pairs(store, settings)] == [expected * WIDTH]
    monkeypatch.setattr(start, "focal_of_pairs", lambda _: None)
    tried = [lens.mean_focal_length() for lens in lenses_of_pairs(store, settings)]
    assert tried == ([share * WIDTH for share in SETTINGS.mapping.focal_ladder] if known is None else [known * WIDTH])


def test_distances_from_the_lines_are_below_a_pixel_in_a_right_model_and_grow_with_the_error(
    store: FeatureDatabase, model: pycolmap.Reconstruction
):
    right, wrong = checked_pairs(store, model), checked_pairs(store, moved(model, 25))
    assert max(each.distance for each in right.values()) < 1
    assert all(wrong[pair] == right[pair] for pair in right if WRONG not in pair)
    assert np.median([wrong[pair].distance / right[pair].distance for pair in right if WRONG in pair]) > 3


def assert_same(found: dict[int, np.ndarray], expected: dict[int, np.ndarray]) -> None:
    assert found.keys() == expected.keys()
    for i, rotation in expected.items():
        turn = np.linalg.norm(found[i] - rotation) / np.sqrt(2)  # radians, for small angles
        assert np.rad2deg(turn) < 0.5, i  # the lens is not refined yet
