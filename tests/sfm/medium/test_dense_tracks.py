"""Dense tracks: where they are, which pixels they hold, and what must not be merged."""

from dataclasses import replace

import torch

from swimm3r.scene.reconstruction import DepthMap, DepthMaps
from swimm3r.sfm.medium.dense_tracks import cubes, frame_overlap, fuse_depth
from swimm3r.sfm.settings import TrackSettings


def test_tracks_of_a_flat_seafloor_lie_on_it(dive):
    tracks = fuse_depth(dive.rec, dive.frames, TrackSettings())
    assert len(tracks.xyz) > 1000
    assert tracks.xyz[:, 2].abs().max() < 1e-4


def test_ray_depth_is_the_distance_from_the_camera_to_the_fused_point(dive):
    tracks = fuse_depth(dive.rec, dive.frames, TrackSettings())
    centers = dive.rec.cameras.centers.float()
    expected = (tracks.xyz[tracks.track] - centers[tracks.frame]).norm(dim=-1)
    torch.testing.assert_close(tracks.ray_depth, expected, atol=1e-5, rtol=1e-5)


def test_a_pixel_belongs_to_at_most_one_track(dive):
    tracks = fuse_depth(dive.rec, dive.frames, TrackSettings())
    pixels = tracks.frame * dive.frames.width * dive.frames.height + tracks.pixel
    assert len(pixels.unique()) == len(pixels)


def test_every_known_pixel_of_a_small_dive_is_in_a_track(dive):
    tracks = fuse_depth(dive.rec, dive.frames, TrackSettings())
    assert len(tracks.pixel) == len(dive.frames) * dive.frames.width * dive.frames.height


def test_points_are_seen_from_several_heights(dive):
    tracks = fuse_depth(dive.rec, dive.frames, TrackSettings())
    length = torch.bincount(tracks.track)
    assert length.max() >= 5
    assert (length >= 2).float().mean() > 0.3


def test_depths_that_disagree_are_not_merged(dive, tmp_path):
    moved = DepthMaps(tmp_path)
    for k, name in enumerate(dive.rec.names):
        depth = dive.rec.depth[name]
        moved.write(name, DepthMap(depth.z_depth * 1.06**k, depth.confidence))
    tracks = fuse_depth(replace(dive.rec, depth=moved), dive.frames, TrackSettings(tolerance=0.02))
    assert torch.bincount(tracks.track).max() == 1


def test_fewer_tracks_are_started_where_memory_is_bounded(dive):
    every = fuse_depth(dive.rec, dive.frames, TrackSettings())
    few = fuse_depth(dive.rec, dive.frames, TrackSettings(max_tracks=2000))
    assert len(few.xyz) <= 2000 < len(every.xyz)


def test_a_frame_farther_away_sees_all_that_a_near_one_sees(dive):
    overlap = frame_overlap(dive.rec, list(range(len(dive.rec.names))))
    assert overlap[0, -1] == 1.0
    assert overlap[-1, 0] < 0.2
    assert (overlap.diagonal() == 0).all()


def test_points_share_a_cube_only_if_it_is_the_same_cube():
    xyz = torch.tensor([[0.1, 0.1, 0.1], [0.9, 0.2, 0.3], [1.1, 0.2, 0.3], [-0.1, 0.1, 0.1], [0.1, 0.1, 0.1]])
    which, count = cubes(xyz, torch.tensor([1.0, 1.0, 1.0, 1.0, 2.0]))
    assert which[0] == which[1]
    assert len(which[[0, 2, 3, 4]].unique()) == 4
    assert count.sum() == len(xyz)
