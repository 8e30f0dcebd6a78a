"""Stills that see ground twice: points of two frames hold their poses, where most features match in one other alone."""

import itertools
from dataclasses import replace
from pathlib import Path

import numpy as np
import pycolmap
import pytest
import torch
from scipy.spatial.transform import Rotation
from tests.sfm.colmap.two_planes import SETTINGS

from swimm3r.geometry import align_similarity
from swimm3r.progress import silent
from swimm3r.scene.frames import Frame, Frames
from swimm3r.sfm.colmap import mapping
from swimm3r.sfm.colmap.calibration.refinement import refine, refine_again
from swimm3r.sfm.features.database import MIN_INLIERS, FeatureDatabase, start_database, with_overlap

WIDTH, HEIGHT, FOCAL, COUNT = 320, 240, 300.0, 12
HELD = replace(SETTINGS, intrinsics="fixed", focal=FOCAL, mapping=replace(SETTINGS.mapping, method="incremental"))


def centers(step: float) -> np.ndarray:
    """A line over ground one unit below, swaying a little."""
    k = np.arange(COUNT)
    return np.stack([step * k, 0.02 * np.sin(k), 0.02 * np.cos(2 * k)], 1)


def survey(step: float, folder: Path) -> FeatureDatabase:
    """Keypoints, 0.3 pixels off, and verified matches of frames that look down on rough ground, a step apart.

    Two features of five are found in a frame.
    """
    rng = np.random.default_rng(1)
    camera = pycolmap.Camera(
        model="SIMPLE_RADIAL", width=WIDTH, height=HEIGHT, params=[FOCAL, WIDTH / 2, HEIGHT / 2, 0.0], camera_id=1
    )
    camera.has_prior_focal_length = True
    frames = Frames(
        tuple(Frame(f"{i}.png", folder / f"{i}.png", float(i), 0.0, "train") for i in range(COUNT)), WIDTH, HEIGHT, True
    )
    store = start_database(folder, frames, camera, SETTINGS.features)
    x = rng.uniform(-1.2, step * COUNT + 1.2, round(8000 * (step * COUNT + 1.6)))
    ground = np.stack([x, rng.uniform(-0.9, 0.9, len(x)), 1 + rng.uniform(-0.15, 0.15, len(x))], 1)
    shown, pixels = [], []
    with store.open() as database:
        for i, center in enumerate(centers(step)):
            turn = Rotation.from_rotvec([0.1 * np.sin(1.3 * i), 0.1 * np.cos(1.7 * i), 0.5 * np.sin(0.9 * i)])
            local = turn.apply(ground - center)
            uv = FOCAL * local[:, :2] / local[:, 2:] + (WIDTH / 2, HEIGHT / 2) + rng.normal(0, 0.3, (len(x), 2))
            inside = np.flatnonzero(((uv > 0) & (uv < (WIDTH, HEIGHT))).all(1) & (rng.random(len(x)) < 0.4))
            shown.append(inside)
            pixels.append(uv[inside])
            database.write_keypoints(i + 1, np.pad(uv[inside], ((0, 0), (0, 2))).astype(np.float32))
        options = pycolmap.TwoViewGeometryOptions()
        options.ransac.random_seed = 0
        for i, j in itertools.combinations(range(COUNT), 2):
            _, of_i, of_j = np.intersect1d(shown[i], shown[j], return_indices=True)
            matches = np.stack([of_i, of_j], 1).astype(np.uint32)
            if len(matches) >= MIN_INLIERS:
                found = pycolmap.estimate_two_view_geometry(camera, pixels[i], camera, pixels[j], matches, options)
                database.write_matches(i + 1, j + 1, matches)
                database.write_two_view_geometry(i + 1, j + 1, found)
    return with_overlap(store)


@pytest.fixture(scope="module")
def stills(tmp_path_factory: pytest.TempPathFactory) -> FeatureDatabase:
    return survey(0.3, tmp_path_factory.mktemp("stills"))


def placed(store: FeatureDatabase) -> pycolmap.Reconstruction:
    return mapping.map_frames(store, HELD, silent)[0]


def off_line(model: pycolmap.Reconstruction, step: float) -> float:
    """Root mean square distance of the frames from where they were, in heights above ground."""
    rows = [int(image.name) for image in model.images.values()]
    found = torch.tensor(np.array([image.projection_center() for image in model.images.values()]))
    truth = torch.from_numpy(centers(step))[rows]
    return (align_similarity(found, truth).points(found) - truth).square().sum(1).mean().sqrt().item()


def test_stills_that_see_ground_twice_are_told_from_video(stills: FeatureDatabase, tmp_path: Path) -> None:
    assert stills.little_overlap
    assert not survey(0.08, tmp_path).little_overlap


def test_a_database_without_matches_is_not_one_of_little_overlap(tmp_path: Path) -> None:
    assert not survey(2.0, tmp_path).little_overlap


def of_two(model: pycolmap.Reconstruction) -> float:
    """Share of the points that two frames alone see."""
    return float(np.mean([point.track.length() == 2 for point in model.points3D.values()]))


def test_points_of_two_frames_hold_the_poses_of_stills(stills: FeatureDatabase) -> None:
    model = placed(stills)
    assert model.num_reg_images() == COUNT
    assert of_two(model) > 0.5
    assert off_line(model, 0.3) < 0.004
    assert len(placed(replace(stills, little_overlap=False)).points3D) < 0.5 * len(model.points3D)


def test_while_the_lens_is_open_points_of_two_frames_do_not_count(stills: FeatureDatabase) -> None:
    opened = replace(HELD, intrinsics="prior")
    alone = mapping.map_frames(stills, opened, silent)[0]
    assert of_two(alone) < 0.3
    refined = refine(stills, alone, opened, silent)
    assert refined.refined
    assert of_two(refined.model) < 0.3
    assert refined.model.cameras[1].focal_length == pytest.approx(FOCAL, rel=0.02)
    held = refine(stills, refined.model, HELD, silent)
    assert of_two(held.model) > 0.5
    assert of_two(refine_again(stills, held, silent).model) > 0.5
    assert held.model.num_reg_images() == COUNT
    assert held.model.cameras[1].focal_length == refined.model.cameras[1].focal_length


def test_stills_of_which_each_feature_is_seen_twice_at_most_need_a_lens_that_is_held(tmp_path: Path) -> None:
    pairs = survey(0.75, tmp_path)  # a still overlaps the next by a third, and none further
    assert pairs.little_overlap
    assert not mapping.map_frames(pairs, replace(HELD, intrinsics="prior"), silent)
    assert mapping.map_frames(pairs, HELD, silent)
