"""Frames that stand in the wrong place: one among others that stand right, and a whole part of the clip."""

import shutil
from dataclasses import replace

import numpy as np
import pycolmap
import pytest

from swimm3r.frames import Frames
from swimm3r.prepare import read_frames
from swimm3r.progress import silent
from swimm3r.sfm import colmap, mapping
from swimm3r.sfm.feature_database import FeatureDatabase
from swimm3r.sfm.pair_agreement import contradicting_frames, pair_distances
from swimm3r.sfm.resection import misplaced_frames
from swimm3r.sfm.settings import ColmapSettings
from swimm3r.synthetic import write_dive
from swimm3r.synthetic.settings import DiveSettings

SETTINGS = ColmapSettings(threads=2)
INCREMENTAL = replace(SETTINGS, mapping=replace(SETTINGS.mapping, method="incremental"))
WRONG = 3  # image id


@pytest.fixture(scope="module")
def store(tmp_path_factory: pytest.TempPathFactory) -> FeatureDatabase:
    folder = tmp_path_factory.mktemp("resection")
    write_dive(DiveSettings(frames=10, width=240, height=160), folder / "dive")
    frames: Frames = read_frames(folder / "dive", folder=folder / "prepare").train
    colmap.reconstruct(frames, SETTINGS, folder / "sfm")
    shutil.copyfile(folder / "sfm" / "database.db", folder / "mapping.db")
    return FeatureDatabase(folder / "mapping.db", len(frames))


@pytest.fixture
def model(store: FeatureDatabase) -> pycolmap.Reconstruction:
    return mapping.map_frames(store, INCREMENTAL, silent)[0]


def moved(model: pycolmap.Reconstruction, degrees: float, which: tuple[int, ...] = (WRONG,)) -> pycolmap.Reconstruction:
    """The model with frames swung about the scene's centre, as the second solution of a flat bottom swings them."""
    centre = np.median([point.xyz for point in model.points3D.values()], axis=0)
    turn = pycolmap.Rotation3d(np.array([0.0, np.deg2rad(degrees), 0.0]))
    swing = pycolmap.Rigid3d(turn, centre - turn.matrix() @ centre)
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


def test_a_part_of_the_clip_that_agrees_with_itself_but_not_with_the_rest_is_placed_again(
    store: FeatureDatabase, model: pycolmap.Reconstruction
):
    part = (1, 2, 3)
    wrong = moved(model, 25, part)
    assert contradicting_frames(store, wrong) == [*part]
    assert_same(rotations(mapping.replace_misplaced(store, wrong, SETTINGS, silent)), rotations(model))


@pytest.mark.parametrize("wrong_one", ["_climb", "_map_globally"])
def test_of_two_ways_to_place_a_small_clip_the_one_that_explains_more_is_kept(
    store: FeatureDatabase, model: pycolmap.Reconstruction, monkeypatch: pytest.MonkeyPatch, wrong_one: str
):
    wrong = moved(model, 25, (1, 2, 3, 4))
    wrong.update_point_3d_errors()
    for way in ("_climb", "_map_globally"):
        monkeypatch.setattr(mapping, way, lambda *_, found=wrong if way == wrong_one else model: [found])
    monkeypatch.setattr(mapping, "replace_misplaced", lambda store, model, *_: model)
    for thin_points, kept in ((1, model), (100_000, wrong if wrong_one == "_climb" else model)):
        settings = replace(SETTINGS, mapping=replace(SETTINGS.mapping, thin_points=thin_points))
        assert mapping.map_frames(store, settings, silent) == [kept]


def test_distances_from_the_lines_are_below_a_pixel_in_a_right_model_and_grow_with_the_error(
    store: FeatureDatabase, model: pycolmap.Reconstruction
):
    right, wrong = pair_distances(store, model), pair_distances(store, moved(model, 25))
    assert max(right.values()) < 1
    assert all(wrong[pair] == right[pair] for pair in right if WRONG not in pair)
    assert np.median([wrong[pair] / right[pair] for pair in right if WRONG in pair]) > 3


def assert_same(found: dict[int, np.ndarray], expected: dict[int, np.ndarray]) -> None:
    assert found.keys() == expected.keys()
    for i, rotation in expected.items():
        turn = np.linalg.norm(found[i] - rotation) / np.sqrt(2)  # radians, for small angles
        assert np.rad2deg(turn) < 0.5, i  # the lens is not refined yet
