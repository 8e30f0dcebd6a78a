"""Frames of a rig whose cameras have different lenses are placed with the lens and beside the frames of their own."""

from dataclasses import replace
from pathlib import Path

import pytest
import torch
from tests.localization.textured_plane import FEATURES, HEIGHT, WIDTH, camera, filmed

from swimm3r.cameras import Cameras
from swimm3r.geometry import relative_poses, rotation_angle
from swimm3r.localization.interpolation import is_beside_registered, lens_of, pose_from_neighbors
from swimm3r.pipeline.scores.held_out import first_poses
from swimm3r.progress import silent
from swimm3r.scene.frames import Frames, Part
from swimm3r.scene.reconstruction import Reconstruction, Tracks
from swimm3r.scene.rig import Rig, RigCamera
from swimm3r.sfm.between import place_between, read_between

FOCAL = {"left": 440.0, "right": 600.0}
RIG_LENS = f"1 OPENCV {WIDTH} {HEIGHT} 600 600 240 180 0 0 0 0"


def camera_of(side: str, x: float) -> Cameras:
    """The right one is 0.15 above the left one's path, which follows y = 0.05 x."""
    one = camera(x, turn=x)
    K, pose = one.K.clone(), one.cam2world.clone()
    K[0, 0, 0] = K[0, 1, 1] = FOCAL[side]
    pose[0, 1, 3] += 0.15 * (side == "right")
    return replace(one, K=K, cam2world=pose)


@pytest.fixture(scope="module")
def everything(tmp_path_factory: pytest.TempPathFactory) -> tuple[Reconstruction, Frames]:
    """Three instants, all six frames registered: left and right in turn, as in every rig's list."""
    cameras = [camera_of(side, x) for x in (-0.08, 0.0, 0.08) for side in FOCAL]
    rec, frames = filmed(tmp_path_factory.mktemp("rig"), cameras)
    listed = (replace(f, time=float(i // 2), camera=tuple(FOCAL)[i % 2], instant=i // 2) for i, f in enumerate(frames))
    return rec, replace(frames, frames=tuple(listed), rig=Rig((RigCamera("left"), RigCamera("right"))))


def without(everything: tuple[Reconstruction, Frames], part: Part, lost: str = "") -> tuple[Reconstruction, Frames]:
    """The frames of the middle instant left out of the reconstruction, and all of a camera that is lost."""
    rec, frames = everything
    held_back = [replace(frame, split=part if frame.instant == 1 else "train") for frame in frames]
    rows = [i for i, frame in enumerate(held_back) if frame.instant != 1 and frame.camera != lost]
    kept = torch.isin(rec.tracks.frame, torch.tensor(rows))
    number = torch.zeros(len(frames), dtype=torch.long).index_put((torch.tensor(rows),), torch.arange(len(rows)))
    tracks = Tracks(rec.tracks.point[kept], number[rec.tracks.frame[kept]], rec.tracks.xy[kept])
    part_of = replace(rec, names=tuple(rec.names[i] for i in rows), cameras=rec.cameras[rows], tracks=tracks)
    return part_of, replace(frames, frames=tuple(held_back))


def check_pose(found: torch.Tensor, truth: torch.Tensor) -> None:
    assert rotation_angle(relative_poses(truth, found)[:3, :3]) < 3e-3
    assert (truth[:3, 3] - found[:3, 3]).norm() < 0.01  # of a plane 2 away


@pytest.mark.parametrize("i", [2, 3])
def test_lens_and_pose_by_neighbors_are_of_the_frames_own_camera(everything, i: int):
    rec, frames = without(everything, "test")
    name, truth = frames.names[i], everything[0].cameras[i]
    lens = lens_of(rec, frames, name)
    assert lens is not None
    torch.testing.assert_close(lens.K, truth.K)
    torch.testing.assert_close(pose_from_neighbors(rec, frames, name), truth.cam2world[0], atol=1e-3, rtol=0)


def test_test_frames_of_a_rig_are_placed_through_their_own_lens(everything):
    rec, frames = without(everything, "test")
    found = first_poses(rec, frames, FEATURES)
    assert [pose.source for pose in found.values()] == ["2D-3D matches"] * 2
    for name, pose in found.items():
        check_pose(pose.cam2world, everything[0].cameras.cam2world[frames.index(name)])


def test_a_camera_without_registered_frames_has_the_lens_of_the_calibration(everything):
    rec, frames = without(everything, "test", lost="right")
    frames = replace(frames, rig=Rig((RigCamera("left"), RigCamera("right", lens=RIG_LENS))))
    assert not is_beside_registered(rec, frames, frames.names[3])
    found = first_poses(rec, frames, FEATURES)
    check_pose(found[frames.names[3]].cam2world, everything[0].cameras.cam2world[3])


def test_a_test_frame_whose_lens_is_not_known_is_not_placed_and_that_is_said(everything, caplog):
    rec, frames = without(everything, "test", lost="right")
    assert lens_of(rec, frames, frames.names[3]) is None
    assert list(first_poses(rec, frames, FEATURES)) == [frames.names[2]]
    assert frames.names[3] in caplog.text
    assert "lens is not known" in caplog.text


def test_frames_between_keyframes_of_a_rig_have_their_own_lenses_and_poses(everything, tmp_path: Path):
    rec, frames = without(everything, "between")
    place_between(rec, frames, tmp_path, silent)
    table = read_between(tmp_path)
    assert table is not None
    assert table.names == frames.names[2:4]
    assert [K[0, 0] for K in table.K] == list(FOCAL.values())
    for i in range(2):
        check_pose(torch.from_numpy(table.cam2world[i]), everything[0].cameras.cam2world[2 + i])


def test_frames_between_keyframes_of_a_camera_without_keyframes_have_no_pose(everything, tmp_path: Path, caplog):
    rec, frames = without(everything, "between", lost="right")
    place_between(rec, frames, tmp_path, silent)
    table = read_between(tmp_path)
    assert table is not None
    assert table.names == frames.names[2:3]
    assert "of right have no pose" in caplog.text
