"""Moving objects in a small dive of known depth: masks, and a reconstruction without them."""

import shutil
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch

from swimm3r.cameras import project, project_visible
from swimm3r.io import images
from swimm3r.prepare import read_frames
from swimm3r.scene.frame_changes import MovingMasks
from swimm3r.scene.frames import Frames
from swimm3r.scene.reconstruction import DepthMaps, Points, Reconstruction, Tracks
from swimm3r.scene.reconstruction_io import load_reconstruction
from swimm3r.scene.settings import FrameSettings
from swimm3r.sfm.moving.find import find_moving, mask_depth, with_moving, without_moving_observations
from swimm3r.sfm.moving.still_scene import beside_edges, still_scene

ROWS, COLUMNS = slice(24, 50), slice(30, 60)
MOVED = 3  # the frame with the object


@pytest.fixture
def filmed(dive, tmp_path: Path) -> tuple[Frames, Reconstruction]:
    """The flat dive with a black object in one frame, which has no depth there."""
    frames, rec = dive.frames, dive.rec
    shutil.copytree(rec.depth.folder, tmp_path / "sfm" / "z_depth")
    shutil.copytree(frames.frames[0].path.parent, tmp_path / "images")
    frames = replace(frames, frames=tuple(replace(frame, path=tmp_path / "images" / frame.name) for frame in frames))
    rec = replace(rec, depth=DepthMaps(tmp_path / "sfm" / "z_depth"))
    image = frames.image(MOVED).numpy().copy()
    image[ROWS, COLUMNS] = 0.0
    images.write_rgb(frames.frames[MOVED].path, image)
    depth = rec.depth[rec.names[MOVED]]
    z_depth = depth.z_depth.clone()
    z_depth[ROWS, COLUMNS] = 0
    rec.depth.write(rec.names[MOVED], replace(depth, z_depth=z_depth))
    return frames, rec


def moved(frames: Frames) -> torch.Tensor:
    """The object in its frame."""
    truth = torch.zeros(frames.height, frames.width, dtype=torch.bool)
    truth[ROWS, COLUMNS] = True
    return truth


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


def test_an_image_that_is_not_of_the_reconstruction_is_asked_by_its_pose(
    filmed: tuple[Frames, Reconstruction],
) -> None:
    frames, rec = filmed
    image, lens = frames.image(MOVED), rec.cameras[MOVED]
    others = [i for i in range(len(rec.names)) if i != MOVED]
    fewer = replace(rec, names=tuple(rec.names[i] for i in others), cameras=rec.cameras[others])
    found, truth = still_scene(fewer, frames).moving_in(lens, image), moved(frames)
    assert (found & truth).sum() > 0.9 * truth.sum()
    assert (found & ~truth).sum() < 0.15 * truth.sum()


def test_masks_of_the_frames_around_an_image_tell_what_moves_with_the_camera(
    filmed: tuple[Frames, Reconstruction], tmp_path: Path
) -> None:
    frames, rec = filmed
    names = [name for i, name in enumerate(rec.names) if i != MOVED]
    nowhere = replace(rec, names=tuple(names), cameras=rec.cameras[[rec.index(name) for name in names]])
    for name in names:  # no frame measured anything where the object is
        z_depth = rec.depth[name].z_depth.clone()
        z_depth[:, 20:70] = 0
        rec.depth.write(name, replace(rec.depth[name], z_depth=z_depth))
    masked = tmp_path / "masks" / f"{names[MOVED]}.png"
    masked.parent.mkdir()
    images.write_mask(masked, ~moved(frames).numpy())
    image = frames.image(frames.index(names[MOVED])).numpy().copy()
    image[ROWS, COLUMNS] = 0.0
    images.write_rgb(frames.frames[frames.index(names[MOVED])].path, image)
    scene = still_scene(replace(nowhere, moving=MovingMasks(masked.parent)), frames)
    lens, filmed_there, truth = rec.cameras[MOVED], frames.image(MOVED), moved(frames)
    assert not scene.moving_in(lens, filmed_there)[truth].any()
    found = scene.moving_in(lens, filmed_there, neighbors=[names[MOVED - 1], names[MOVED]])
    assert (found & truth).sum() > 0.9 * truth.sum()
    assert (found & ~truth).sum() < 0.15 * truth.sum()


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


def test_surfaces_end_a_pixel_before_depth_edges_and_slopes_and_gaps_are_none() -> None:
    z_depth = np.tile(np.linspace(2, 2.5, 12, dtype=np.float32), (8, 1))
    assert not beside_edges(z_depth).any()
    z_depth[:, 6:] *= 1.5
    z_depth[:, 3] = 0
    assert np.array_equal(np.flatnonzero(beside_edges(z_depth)[4]), [5, 6])
