"""A frame that stands in the wrong place, among others that stand right."""

import shutil

import numpy as np
import pycolmap
import pytest

from swimm3r.frames import Frames
from swimm3r.prepare import read_frames
from swimm3r.progress import silent
from swimm3r.sfm import colmap, mapping
from swimm3r.sfm.feature_database import FeatureDatabase
from swimm3r.sfm.resection import misplaced_frames
from swimm3r.sfm.settings import ColmapSettings
from swimm3r.synthetic import write_dive
from swimm3r.synthetic.settings import DiveSettings

SETTINGS = ColmapSettings(threads=2)
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
    return mapping.map_frames(store, SETTINGS, "incremental", silent)[0]


def moved(model: pycolmap.Reconstruction, degrees: float) -> pycolmap.Reconstruction:
    """The model with one frame swung about the scene's centre, as the second solution of a flat bottom swings it."""
    centre = np.median([point.xyz for point in model.points3D.values()], axis=0)
    turn = pycolmap.Rotation3d(np.array([0.0, np.deg2rad(degrees), 0.0]))
    swing = pycolmap.Rigid3d(turn, centre - turn.matrix() @ centre)
    out = pycolmap.Reconstruction(model)
    image = out.images[WRONG]
    assert image.frame is not None
    image.frame.set_cam_from_world(image.camera_id, image.cam_from_world() * swing)
    return out


def rotations(model: pycolmap.Reconstruction) -> dict[int, np.ndarray]:
    first = model.images[1].cam_from_world().rotation.matrix()
    return {i: model.images[i].cam_from_world().rotation.matrix() @ first.T for i in model.reg_image_ids()}


def test_frames_that_stand_right_are_left_alone(store: FeatureDatabase, model: pycolmap.Reconstruction):
    assert misplaced_frames(store, model) == []
    assert mapping.replace_misplaced(store, model, SETTINGS, silent) is model


def test_a_swung_frame_is_found_and_placed_again(store: FeatureDatabase, model: pycolmap.Reconstruction):
    wrong = moved(model, 25)
    assert misplaced_frames(store, wrong) == [WRONG]
    mended = rotations(mapping.replace_misplaced(store, wrong, SETTINGS, silent))
    assert mended.keys() == rotations(model).keys()
    for i, expected in rotations(model).items():
        turn = np.linalg.norm(mended[i] - expected) / np.sqrt(2)  # radians, for small angles
        assert np.rad2deg(turn) < 0.2, i
