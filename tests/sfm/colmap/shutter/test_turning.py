"""Turns of the camera within a frame: found from planted observations, believed where held-out ones say so."""

from dataclasses import replace

import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation
from tests.sfm.colmap.shutter.test_readout import TIMES, degrees_off, filmed
from tests.sfm.colmap.test_extended_adjustment import assert_derivatives

from swimm3r.cameras import Cameras, project
from swimm3r.imaging.turned_rows import filmed_pixels, half_time_pixels
from swimm3r.scene.reconstruction import Reconstruction
from swimm3r.sfm.colmap.adjustment import bundle_adjust
from swimm3r.sfm.colmap.shutter import turning
from swimm3r.sfm.colmap.shutter.turning import turned_pose, turned_rows

TURNS = np.random.default_rng(3).normal(0, 0.006, (len(TIMES), 3))  # rad; no two frames alike


@pytest.fixture(scope="module")
def shaken() -> Reconstruction:
    """A clip whose camera turned anew in every frame, its poses and points adjusted as if it had not."""
    at_rest = filmed(0.0)
    xy = at_rest.tracks.xy.clone()
    for i in range(len(at_rest.names)):
        rows = at_rest.tracks.frame == i
        xy[rows] = filmed_pixels(at_rest.cameras[i], xy[rows], TURNS[i])
    return bundle_adjust(replace(at_rest, tracks=replace(at_rest.tracks, xy=xy)))


def straightened(rec: Reconstruction, lens: Cameras, turns: dict[str, np.ndarray]) -> Reconstruction:
    xy = rec.tracks.xy.clone()
    for i, name in enumerate(rec.names):
        rows = rec.tracks.frame == i
        xy[rows] = half_time_pixels(lens, xy[rows], turns[name])
    return bundle_adjust(replace(rec, tracks=replace(rec.tracks, xy=xy)))


def test_turns_of_single_frames_are_found_and_poses_with_them(shaken: Reconstruction):
    found = turned_rows(shaken)
    assert found is not None
    assert tuple(found.turns) == shaken.names
    off = np.stack([found.turns[name] for name in shaken.names]) - TURNS
    off = np.diff(off, axis=0)  # a turn that neighbors share looks like a bend of the path, or like another lens
    assert np.sqrt(np.square(off).mean()) < 0.15 * TURNS.std()
    assert found.typical == pytest.approx(np.degrees(np.median(np.linalg.norm(TURNS, axis=1))), rel=0.2)
    straight = straightened(shaken, found.lens, found.turns)
    assert degrees_off(straight.cameras).median() < 0.5 * degrees_off(shaken.cameras).median()
    assert straight.points.error.median() < 0.5 * shaken.points.error.median()


def test_stretches_of_a_long_clip_have_the_turns_of_the_whole(shaken: Reconstruction, monkeypatch: pytest.MonkeyPatch):
    whole = turned_rows(shaken)
    monkeypatch.setattr(turning, "_STRETCH", 12)
    parts = turned_rows(shaken)
    assert whole is not None
    assert parts is not None
    assert tuple(parts.turns) == shaken.names
    off = np.diff(np.stack([parts.turns[name] - whole.turns[name] for name in shaken.names]), axis=0)
    assert np.median(np.abs(off)) < 0.1 * TURNS.std()


def test_a_rolling_shutter_on_a_smooth_path_is_one_of_them():
    film = bundle_adjust(filmed(0.02))
    found = turned_rows(film)
    assert found is not None
    straight = straightened(film, found.lens, found.turns)
    assert degrees_off(straight.cameras).max() < 0.7 * degrees_off(film.cameras).max()


def test_frames_that_were_exposed_at_once_stay_as_filmed():
    assert turned_rows(bundle_adjust(filmed(0.0))) is None


def test_few_frames_or_observations_or_a_fisheye_say_nothing(shaken: Reconstruction):
    few = replace(shaken, names=shaken.names[:5])
    assert turned_rows(few) is None
    fisheye = replace(shaken.cameras, distortion=torch.zeros(len(shaken.names), 4), model="OPENCV_FISHEYE")
    assert turned_rows(replace(shaken, cameras=fisheye)) is None
    rows = torch.arange(len(shaken.tracks.point))[::40]
    thin = replace(shaken.tracks, **{name: values[rows] for name, values in vars(shaken.tracks).items()})
    assert turned_rows(replace(shaken, tracks=thin)) is None


def test_errors_of_rays_have_the_derivatives_that_are_told(shaken: Reconstruction):
    observed, bundle = turning._stretch(turning._observed(shaken), turning._start(shaken), 0, 8)
    assert_derivatives(bundle, observed)
    turns = np.random.default_rng(0).normal(0, 0.01, 3 * len(bundle.R))
    assert_derivatives(replace(bundle, others=turns), observed)


def test_a_pose_is_found_with_its_turn():
    at_rest = filmed(0.0)
    camera, turn = at_rest.cameras[7], np.array([0.006, -0.004, 0.003])
    xyz = at_rest.points.xyz[torch.unique(at_rest.tracks.point[at_rest.tracks.frame == 7])]
    xy = filmed_pixels(camera, project(camera, xyz[None])[0][0], turn)
    cam2world = camera.cam2world.clone()
    cam2world[0, :3, 3] += torch.tensor([0.01, -0.02, 0.01])
    cam2world[0, :3, :3] = cam2world[0, :3, :3] @ torch.from_numpy(Rotation.from_rotvec([0.01, 0, 0]).as_matrix())
    pose, found = turned_pose(replace(camera, cam2world=cam2world), xy, xyz)
    np.testing.assert_allclose(found, turn, atol=4e-4)  # held back by what turns usually are
    assert (pose[:3, 3] - camera.cam2world[0, :3, 3]).norm() < 0.002
