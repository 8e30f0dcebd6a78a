"""Keypoints of two textured planes, whose cameras are known, where patches of the images agree."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from tests.sfm.colmap.two_planes import COUNT, SETTINGS, camera_path, off_true_lines, worst_rotation_deg

from swimm3r.scene.frames import Frames
from swimm3r.scene.reconstruction import Reconstruction
from swimm3r.sfm.colmap import poses as colmap
from swimm3r.sfm.colmap.settings import MappingSettings
from swimm3r.sfm.features.database import FeatureDatabase

_AS_FOUND = replace(SETTINGS, mapping=MappingSettings(align_keypoints=False))


@pytest.fixture(scope="module")
def folder_as_found(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return tmp_path_factory.mktemp("as_found")


@pytest.fixture(scope="module")
def as_found(frames: Frames, folder_as_found: Path) -> Reconstruction:
    return colmap.reconstruct(frames, _AS_FOUND, folder_as_found)


def _off_true_lines(rec: Reconstruction) -> float:
    """Median distance of observations from the true epipolar lines of others of the same point in pixels."""
    tracks = rec.tracks
    order = tracks.point.argsort(stable=True)
    same = (tracks.point[order].diff() == 0) & (tracks.frame[order].diff() != 0)
    first, second = order[:-1][same], order[1:][same]
    found = off_true_lines(tracks.frame[first], tracks.frame[second], tracks.xy[first], tracks.xy[second])
    return float(found.median())


def test_aligned_keypoints_are_nearer_to_the_truth_and_so_are_the_cameras(
    rec: Reconstruction, as_found: Reconstruction
):
    assert _off_true_lines(rec) < 0.6 * _off_true_lines(as_found)
    assert rec.points.error.median() < 0.6 * as_found.points.error.median()
    assert worst_rotation_deg(rec, camera_path()) < worst_rotation_deg(as_found, camera_path())


@pytest.mark.long
def test_keypoints_of_reduced_images_are_aligned_in_these(frames: Frames, tmp_path: Path):
    errors = []
    for name, settings in (("aligned", SETTINGS), ("as found", _AS_FOUND)):
        reduced = replace(settings, features=replace(settings.features, long_side=210))  # of 157.5 rows, which are 158
        errors.append(_off_true_lines(colmap.reconstruct(frames, reduced, tmp_path / name)))
    assert errors[0] < 0.7 * errors[1]


def test_observations_are_the_keypoints_of_their_matches(rec: Reconstruction):
    for i in range(len(rec.names)):
        own = rec.tracks.xy[rec.tracks.frame == i].float().numpy()
        matched = torch.cat([rec.matches.xy_i[rec.matches.i == i], rec.matches.xy_j[rec.matches.j == i]]).numpy()
        among = {tuple(np.round(xy, 3)) for xy in matched.tolist()}
        assert all(tuple(np.round(xy, 3)) in among for xy in own.tolist())


def test_the_database_that_runs_go_on_from_keeps_keypoints_as_found(
    rec: Reconstruction, as_found: Reconstruction, folder: Path, folder_as_found: Path
):
    assert not torch.equal(rec.matches.xy_i, as_found.matches.xy_i)
    stores = [FeatureDatabase(path / "database.db", COUNT) for path in (folder, folder_as_found)]
    for image in range(1, COUNT + 1):
        with stores[0].open() as one, stores[1].open() as other:
            assert np.array_equal(one.read_keypoints(image), other.read_keypoints(image))
