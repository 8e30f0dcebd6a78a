"""Localization by keypoints."""

from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
import torch

from swimm3r.cameras import Cameras, image_directions, pixel_grid, project
from swimm3r.geometry import pose_from, relative_poses, rotation_angle, so3_exp
from swimm3r.imaging.turned_rows import half_time_pixels
from swimm3r.io.images import write_rgb
from swimm3r.localization.interpolation import between, is_beside_registered, neighbors, pose_from_neighbors
from swimm3r.localization.landmarks import Landmarks, landmarks_of, locate
from swimm3r.pipeline.scores.held_out import first_poses
from swimm3r.scene.frames import Frame, Frames
from swimm3r.scene.ground_truth import GroundTruth
from swimm3r.scene.reconstruction import DepthMap, DepthMaps, Matches, Points, Reconstruction, Tracks
from swimm3r.sfm.features.settings import FeatureSettings
from swimm3r.sfm.features.sift import extract_features

SETTINGS = FeatureSettings(count=600)


@pytest.fixture(scope="module")
def plane(tmp_path_factory: pytest.TempPathFactory) -> tuple[Reconstruction, Frames, Cameras]:
    """Four images of a blotchy plane at z = 2 from a camera that slides and turns; the third is not registered."""
    folder = tmp_path_factory.mktemp("plane")
    rng = torch.Generator().manual_seed(0)
    blotches = torch.zeros(3, 640, 640) + sum(
        torch.nn.functional.interpolate(torch.rand(1, 3, n, n, generator=rng), (640, 640), mode="bicubic")[0] / n**0.3
        for n in (12, 40, 120)
    )
    texture = (blotches - blotches.min()) / (blotches.max() - blotches.min())
    K = torch.tensor([[220.0, 0, 120], [0, 220, 90], [0, 0, 1]], dtype=torch.float64).repeat(4, 1, 1)
    turns = torch.tensor([[0, 0, 0], [0.02, 0, 0.01], [0.03, -0.01, 0.02], [0.02, -0.02, 0.03]], dtype=torch.float64)
    centers = torch.tensor([[-0.15, 0, 0], [-0.05, 0.02, 0.02], [0.05, 0.02, 0.03], [0.15, 0, 0]], dtype=torch.float64)
    cameras = Cameras(K, torch.zeros(4, 0, dtype=torch.float64), pose_from(so3_exp(turns), centers), 240, 180)
    registered = [0, 1, 3]
    frames, points, rows = [], [], []
    for i in range(4):
        xy = _on_plane(cameras[i])
        at = (xy / 1.6).float().reshape(1, 180, 240, 2)  # the texture spans x, y in -1.6..1.6
        image = torch.nn.functional.grid_sample(texture[None], at, align_corners=False)[0].permute(1, 2, 0)
        path = folder / f"{i}.png"
        write_rgb(path, image.numpy())
        frames.append(Frame(path.name, path, float(i), 1.0, "train"))
        if i not in registered:
            continue
        keypoints = torch.from_numpy(extract_features(image, torch.ones(180, 240).bool(), SETTINGS).keypoints)
        for x, y in keypoints[:, :2].double():
            rows.append((len(points), registered.index(i), x, y))
            points.append(_at(cameras[i], x, y))
    listed = Frames(tuple(frames), 240, 180, True)
    none = torch.zeros(0, dtype=torch.int64)
    rec = Reconstruction(
        names=tuple(frames[i].name for i in registered),
        cameras=cameras[registered],
        points=Points(torch.stack(points), torch.zeros(len(points), 3), torch.zeros(len(points))),
        tracks=Tracks(
            torch.tensor([r[0] for r in rows]),
            torch.tensor([r[1] for r in rows]),
            torch.tensor([[r[2], r[3]] for r in rows]),
        ),
        matches=Matches(none, none, torch.zeros(0, 2), torch.zeros(0, 2), torch.zeros(0)),
        depth=DepthMaps(folder),
        backend="truth",
    )
    return rec, listed, cameras


def _at(camera: Cameras, x: torch.Tensor, y: torch.Tensor) -> torch.Tensor:
    ray = torch.linalg.solve(camera.K[0], torch.tensor([float(x), float(y), 1.0], dtype=torch.float64))
    ray = camera.cam2world[0, :3, :3] @ ray
    return camera.centers[0] + ray * (2 - camera.centers[0, 2]) / ray[2]


def _on_plane(camera: Cameras) -> torch.Tensor:
    y, x = torch.meshgrid(torch.arange(180) + 0.5, torch.arange(240) + 0.5, indexing="ij")
    rays = torch.stack([x, y, torch.ones_like(x)], -1).reshape(-1, 3).double()
    rays = torch.linalg.solve(camera.K[0], rays.mT).mT @ camera.cam2world[0, :3, :3].mT
    return (camera.centers[0] + rays * ((2 - camera.centers[0, 2]) / rays[:, 2])[:, None])[:, :2]


def test_a_image_is_placed_where_it_was_taken(plane):
    rec, frames, cameras = plane
    landmarks = landmarks_of(rec, frames, SETTINGS)
    near = [landmarks(name) for name in neighbors(rec, frames, "2.png", 3)]
    lens = replace(rec.cameras[0])
    found = locate(frames.image(2), frames.mask(2), lens, near, SETTINGS)
    assert found is not None
    assert found.inliers > 50
    assert rotation_angle(relative_poses(cameras.cam2world[2], found.cam2world)[:3, :3]) < 3e-3
    points = rec.points.xyz[None]
    there = replace(lens, cam2world=found.cam2world[None])
    assert (project(there, points)[0] - project(cameras[2], points)[0]).norm(dim=-1).median() < 0.5


def test_measured_depth_places_a_image_where_no_point_was_triangulated(plane, tmp_path):
    """As at the end of a strip: one frame shares ground with it, and no third one has that in its image."""
    rec, frames, cameras = plane
    none = torch.zeros(0, dtype=torch.int64)
    rec = replace(rec, tracks=Tracks(none, none, torch.zeros(0, 2)), depth=DepthMaps(tmp_path))
    lens = rec.cameras[0]
    without = landmarks_of(rec, frames, SETTINGS)("1.png")
    assert not len(without.xyz)
    assert locate(frames.image(2), frames.mask(2), lens, [without], SETTINGS) is None
    z_depth = _depth_of_plane(cameras[1])
    z_depth[:, 120:] = 0  # unknown
    rec.depth.write("1.png", DepthMap(z_depth, (z_depth > 0).float()))
    landmarks = landmarks_of(rec, frames, SETTINGS)("1.png")
    assert (landmarks.xyz[:, 2] - 2).abs().max() < 0.01
    found = locate(frames.image(2), frames.mask(2), lens, [landmarks], SETTINGS)
    assert found is not None
    points = rec.points.xyz[None]
    there = replace(lens, cam2world=found.cam2world[None])
    assert (project(there, points)[0] - project(cameras[2], points)[0]).norm(dim=-1).median() < 1


def _depth_of_plane(camera: Cameras) -> torch.Tensor:
    rays = image_directions(camera).double() @ camera.cam2world[0, :3, :3].mT
    return ((2 - camera.centers[0, 2]) / rays[..., 2]).float()


def test_a_image_of_another_place_is_not_placed(plane):
    rec, frames, _ = plane
    landmarks = landmarks_of(rec, frames, SETTINGS)
    noise = torch.rand(180, 240, 3, generator=torch.Generator().manual_seed(1))
    assert locate(noise, frames.mask(0), rec.cameras[0], [landmarks("0.png"), landmarks("1.png")], SETTINGS) is None


def test_nothing_to_match_with_is_no_pose(plane):
    rec, frames, _ = plane
    nothing = Landmarks(torch.zeros(0, 128), torch.zeros(0, 3, dtype=torch.float64))
    assert locate(frames.image(0), frames.mask(0), rec.cameras[0], [nothing], SETTINGS) is None


def test_neighbors_come_nearest_first(plane):
    rec, frames, _ = plane
    assert neighbors(rec, frames, "2.png", 2) == ["1.png", "3.png"]


def test_half_way_is_half_the_turn_and_half_the_motion():
    turn = torch.tensor([0.0, 0.4, 0.0], dtype=torch.float64)
    start = torch.eye(4, dtype=torch.float64)
    end = pose_from(so3_exp(turn), torch.tensor([2.0, 0, 0], dtype=torch.float64))
    torch.testing.assert_close(between(start, end, 0.5)[:3, :3], so3_exp(turn / 2))
    assert between(start, end, 0.5)[0, 3] == pytest.approx(1)
    torch.testing.assert_close(between(start, end, 1.0), end)
    assert between(start, end, -0.5)[0, 3] == pytest.approx(-1)  # carried on


def test_a_frame_without_matches_is_placed_between_its_neighbors(plane):
    rec, frames, cameras = plane
    pose = pose_from_neighbors(rec, frames, "2.png")
    torch.testing.assert_close(pose, between(cameras.cam2world[1], cameras.cam2world[3], 0.5))


def test_a_frame_before_the_first_is_carried_on_backwards(plane):
    rec, frames, cameras = plane
    later = replace(rec, names=("1.png", "3.png"), cameras=cameras[[1, 3]])
    pose = pose_from_neighbors(later, frames, "0.png")
    torch.testing.assert_close(pose, between(cameras.cam2world[1], cameras.cam2world[3], -0.5))


@pytest.mark.parametrize(("lost", "known"), [(2, True), (3, False)])
def test_neighbors_tell_a_pose_only_where_they_are_near_in_the_order_of_the_dive(plane, lost, known):
    """Frame 2 with `lost` training frames, which are not registered, between it and frame 3."""
    rec, frames, _ = plane
    gap = [replace(frames.frames[1], name=f"lost{k}.png", time=2 + (k + 1) / (lost + 1)) for k in range(lost)]
    apart = replace(frames, frames=(*frames.frames[:3], *gap, frames.frames[3]))
    assert is_beside_registered(rec, apart, "2.png") is known


def test_a_test_frame_beyond_everything_registered_is_not_placed(plane, tmp_path: Path, caplog):
    """Frame 2 shows the scene; another one, long after the last registered frame, shows nothing of it."""
    rec, frames, _ = plane
    noise = tmp_path / "far.png"
    write_rgb(noise, torch.rand(180, 240, 3, generator=torch.Generator().manual_seed(1)).numpy())
    lost = [replace(frames.frames[1], name=f"lost{k}.png", time=4.0 + k) for k in range(5)]
    tests = [
        replace(frames.frames[2], split="test"),
        replace(frames.frames[2], name="far.png", path=noise, time=9.0, split="test"),
    ]
    dive = replace(frames, frames=(*frames.frames[:2], tests[0], frames.frames[3], *lost, tests[1]))
    assert list(first_poses(rec, dive, SETTINGS)) == ["2.png"]
    assert "far.png" in caplog.text
    assert first_poses(rec, replace(dive, frames=(*dive.frames[:2], *dive.frames[3:])), SETTINGS) == {}


def test_a_test_frame_is_placed_with_the_turn_of_its_camera(plane, tmp_path: Path):
    """The frame that is not registered, as filmed by a camera that turned while its rows were exposed."""
    rec, frames, cameras = plane
    turn, truth = np.array([0.012, -0.01, 0.02]), cameras[2]
    grid = pixel_grid(180, 240).reshape(-1, 2).double()
    column, row = (half_time_pixels(truth, grid, turn) - 0.5).float().reshape(180, 240, 2).unbind(-1)
    filmed = cv2.remap(frames.image(2).numpy(), column.numpy(), row.numpy(), cv2.INTER_CUBIC)
    write_rgb(tmp_path / "2.png", filmed.clip(0, 1))
    held_back = replace(frames.frames[2], path=tmp_path / "2.png", split="test")
    frames = replace(frames, frames=(*frames.frames[:2], held_back, frames.frames[3]))

    at_once = first_poses(rec, frames, SETTINGS)["2.png"]
    turned = first_poses(rec, replace(frames, rows_rectified=True), SETTINGS)["2.png"]
    assert at_once.turn is None
    assert turned.turn is not None
    np.testing.assert_allclose(turned.turn, turn, atol=0.002)
    off = [rotation_angle(truth.cam2world[0, :3, :3].mT @ p.cam2world[:3, :3]) for p in (at_once, turned)]
    assert off[1] < 0.3 * off[0]
    stated = GroundTruth(frames.names, cameras, metric=True)
    known = first_poses(rec, replace(frames, rows_rectified=True), SETTINGS, stated)["2.png"]
    assert known.source == "reference"
    assert known.turn is not None
    torch.testing.assert_close(known.cam2world, truth.cam2world[0], atol=1e-6, rtol=0)
