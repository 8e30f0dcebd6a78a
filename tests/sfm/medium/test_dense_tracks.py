"""Dense tracks: where they are, which pixels they hold, and what must not be merged."""

from dataclasses import replace

import torch

from swimm3r.scene.reconstruction import DepthMap, DepthMaps
from swimm3r.sfm.medium.dense_tracks import Surfaces, cubes, fuse_depth
from swimm3r.sfm.medium.settings import TrackSettings


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
    last = len(dive.rec.names) - 1
    surfaces = Surfaces(dive.rec, list(range(last + 1)))
    (near, of_near), (far, of_far) = surfaces.overlap(0), surfaces.overlap(last)
    assert of_near[near == last] == 1.0
    assert not (near == 0).any()
    assert 0.0 not in of_far[far == 0]
    assert of_far[far == 0] < 0.2


def test_points_share_a_cube_only_if_it_is_the_same_cube():
    xyz = torch.tensor([[0.1, 0.1, 0.1], [0.9, 0.2, 0.3], [1.1, 0.2, 0.3], [-0.1, 0.1, 0.1], [0.1, 0.1, 0.1]])
    which, count = cubes(xyz, torch.tensor([1.0, 1.0, 1.0, 1.0, 2.0]))
    assert which[0] == which[1]
    assert len(which[[0, 2, 3, 4]].unique()) == 4
    assert count.sum() == len(xyz)


def test_the_surface_of_a_frame_is_looked_up_in_frames_near_it_only(dive, tmp_path):
    """A second dive far away: the frames of either overlap with their own only, and the tracks are those of both."""
    far = dive.rec.cameras.cam2world.clone()
    far[:, 0, 3] += 1000.0
    count = len(dive.rec.names)
    cameras = replace(dive.rec.cameras, **{
        "K": dive.rec.cameras.K.repeat(2, 1, 1), "distortion": dive.rec.cameras.distortion.repeat(2, 1),
        "cam2world": torch.cat([dive.rec.cameras.cam2world, far]),
    })  # fmt: skip
    depth, twice = DepthMaps(tmp_path), tuple(f"{part}/{name}" for part in ("a", "b") for name in dive.rec.names)
    for k, name in enumerate(twice):
        depth.write(name, dive.rec.depth[dive.rec.names[k % count]])
    rec = replace(dive.rec, names=twice, cameras=cameras, depth=depth)
    frames = replace(dive.frames, frames=tuple(
        replace(dive.frames.frames[k % count], name=name) for k, name in enumerate(twice)
    ))  # fmt: skip
    surfaces = Surfaces(rec, list(range(2 * count)))
    assert (surfaces.overlap(0)[0] < count).all()
    assert (surfaces.overlap(count)[0] >= count).all()
    alone, both = (fuse_depth(a, b, TrackSettings()) for a, b in ((dive.rec, dive.frames), (rec, frames)))
    assert len(both.xyz) == 2 * len(alone.xyz)
    assert len(both.pixel) == 2 * len(alone.pixel)
