"""Warnings of poses that cannot be right: twins, parts that do not join, turns on the spot, leaps, lost scale."""

import math
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
import torch
from tests.sfm.colmap.two_planes import COUNT, HEIGHT, SETTINGS, WIDTH, texture

from swimm3r.errors import RegistrationError
from swimm3r.geometry import so3_exp
from swimm3r.scene.frames import Frames
from swimm3r.scene.reconstruction import Points
from swimm3r.sfm.colmap import plausibility
from swimm3r.sfm.colmap import poses as colmap
from swimm3r.sfm.colmap.calibration.start import first_camera
from swimm3r.sfm.features import database as feature_database


def test_a_tiled_floor_has_twins_and_a_reef_has_none() -> None:
    from swimm3r.sfm.features.settings import FeatureSettings
    from swimm3r.sfm.features.sift import extract_features, unit_descriptors

    usable = torch.ones(HEIGHT, WIDTH, dtype=torch.bool)
    tile = cv2.resize(texture(3), (40, 40))

    def share(gray: np.ndarray) -> float:
        image = torch.from_numpy(np.repeat(gray[..., None], 3, 2).astype(np.float32) / 255)
        found = extract_features(image, usable, FeatureSettings())
        xy = torch.from_numpy(found.keypoints[:, :2].copy())
        return plausibility.twin_share(xy, unit_descriptors(found.descriptors))

    assert share(np.tile(tile, (6, 8))) > 0.6
    assert share(cv2.resize(texture(4), (WIDTH, HEIGHT))) < 0.05


@pytest.mark.long
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
