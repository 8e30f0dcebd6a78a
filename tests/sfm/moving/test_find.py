"""Masks of moving objects, and a reconstruction without them."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from tests.sfm.moving.conftest import MOVED, moved

from swimm3r.cameras import project, project_visible
from swimm3r.io import images
from swimm3r.prepare import read_frames
from swimm3r.scene.frames import Frames
from swimm3r.scene.reconstruction import Points, Reconstruction, Tracks
from swimm3r.scene.reconstruction_io import load_reconstruction
from swimm3r.scene.settings import FrameSettings
from swimm3r.sfm.moving.find import find_moving, mask_depth, with_moving, without_moving_observations


def test_the_object_is_found_and_nothing_else(filmed: tuple[Frames, Reconstruction], tmp_path: Path) -> None:
    frames, rec = filmed
    masks = find_moving(rec, frames, tmp_path / "sfm" / "masks")
    assert [name for name in rec.names if name in masks] == [rec.names[MOVED]]
    found, truth = ~masks.on(frames).mask(MOVED), moved(frames)
    assert (found & truth).sum() > 0.9 * truth.sum()
    assert (found & ~truth).sum() < 0.15 * truth.sum()


def test_frames_of_a_still_scene_have_no_masks(dive, tmp_path: Path) -> None:
    masks = find_moving(dive.rec, dive.frames, tmp_path / "masks")
    assert masks.folder.is_dir()
    assert not list(masks.shares(dive.frames))


def test_masks_of_users_stay_and_are_not_counted(filmed: tuple[Frames, Reconstruction], tmp_path: Path) -> None:
    frames, rec = filmed
    usable = np.ones((frames.height, frames.width), bool)
    usable[:10] = False
    images.write_mask(tmp_path / "rim.png", usable)
    frames = replace(frames, frames=tuple(replace(frame, mask=tmp_path / "rim.png") for frame in frames))
    masks = find_moving(rec, frames, tmp_path / "masks")
    assert not masks.on(frames).mask(MOVED)[:10].any()
    ((_, share),) = masks.shares(frames)
    assert share == pytest.approx(float(moved(frames)[10:].float().mean()), rel=0.1)


def test_observations_of_moving_objects_go(filmed: tuple[Frames, Reconstruction], tmp_path: Path) -> None:
    frames, rec = filmed
    rec = with_moving(with_points(rec), frames, tmp_path / "sfm" / "masks")
    still = without_moving_observations(rec, frames)
    left = still.tracks.xy[still.tracks.frame == MOVED].long()
    assert rec.still(frames).mask(MOVED)[left[:, 1], left[:, 0]].all()
    assert 0 < len(still.tracks.point) < len(rec.tracks.point)
    assert (torch.bincount(still.tracks.point) >= 2).all()
    for i, name in enumerate(still.names):
        mine = still.tracks.frame == i
        uv = project(still.cameras[i], still.points.xyz[still.tracks.point[mine]][None])[0][0]
        torch.testing.assert_close(uv, still.tracks.xy[mine], msg=name)


def test_depth_of_moving_objects_goes_and_other_depth_stays(
    filmed: tuple[Frames, Reconstruction], tmp_path: Path
) -> None:
    frames, rec = filmed
    rec = replace(rec, moving=find_moving(rec, frames, tmp_path / "sfm" / "masks"))
    name, usable = rec.names[MOVED], rec.still(frames).mask(MOVED)
    ghost = replace(rec.depth[name], z_depth=torch.ones(frames.height, frames.width))
    rec.depth.write(name, ghost)
    mask_depth(rec, frames)
    assert torch.equal(rec.depth[name].z_depth > 0, usable)
    assert torch.equal(rec.depth[name].confidence > 0, usable)


def test_a_user_is_told_once_of_objects_that_cover_much(filmed: tuple[Frames, Reconstruction], tmp_path: Path) -> None:
    frames, rec = filmed
    rec = with_moving(rec, frames, tmp_path / "sfm" / "masks")
    rec = with_moving(rec, frames, tmp_path / "sfm" / "masks")
    (warning,) = rec.warnings
    assert "Moving objects cover 1." in warning.what


def test_masks_are_saved_with_the_reconstruction(filmed: tuple[Frames, Reconstruction], tmp_path: Path) -> None:
    frames, rec = filmed
    rec = with_moving(with_points(rec), frames, tmp_path / "sfm" / "masks")
    rec.save(tmp_path / "copy", frames)
    read = load_reconstruction(tmp_path / "copy", frames)
    assert torch.equal(read.still(frames).mask(MOVED), rec.still(frames).mask(MOVED))
    assert read.still(frames).frames[0].mask is None


def test_found_masks_are_given_back_as_a_users(filmed: tuple[Frames, Reconstruction], tmp_path: Path) -> None:
    frames, rec = filmed
    masks = find_moving(rec, frames, tmp_path / "sfm" / "masks")
    again = read_frames(tmp_path / "images", FrameSettings(masks=masks.folder), tmp_path / "prepare")
    assert torch.equal(again.mask(MOVED), masks.on(frames).mask(MOVED))


def with_points(rec: Reconstruction) -> Reconstruction:
    """The reconstruction with sparse points on the ground, and their observations."""
    y, x = np.meshgrid(np.linspace(-0.6, 0.6, 12), np.linspace(-0.8, 0.8, 16))
    xyz = torch.from_numpy(np.stack([x.ravel(), y.ravel(), 0 * x.ravel()], -1))
    count = len(rec.names)
    uv, _, visible = project_visible(rec.cameras, xyz[None].expand(count, -1, -1))
    frame, point = visible.nonzero().unbind(-1)
    points = Points(xyz, torch.zeros(len(xyz), 3), torch.zeros(len(xyz), dtype=torch.float64))
    return replace(rec, points=points, tracks=Tracks(point, frame, uv[frame, point]))
