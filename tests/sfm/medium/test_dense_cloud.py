"""The dense cloud: colors of the seafloor, as many points as asked for, and more of a larger surface."""

from dataclasses import replace

import pytest
import torch

from swimm3r.appearance import FrameColors
from swimm3r.medium import MediumFit
from swimm3r.scene.reconstruction import DenseCloud
from swimm3r.scene.surface import surface_of
from swimm3r.sfm.medium.dense_cloud import dense_cloud, restored_points, thinned, times_as_many
from swimm3r.sfm.medium.dense_tracks import fuse_depth, fuse_in_batches
from swimm3r.sfm.medium.settings import RestoreSettings, TrackSettings

FEW = TrackSettings(max_tracks=600)


def test_restored_points_have_the_clear_colors_of_the_seafloor(dive, known_water: MediumFit):
    tracks = fuse_depth(dive.rec, dive.frames, TrackSettings())
    cloud = restored_points(dive.rec, dive.frames, tracks, known_water)
    assert (cloud.restored - dive.seafloor(cloud.xyz[:, :2])).abs().mean() < 0.02
    assert (cloud.raw - cloud.restored).abs().mean() > 0.05


def test_points_brighter_than_white_without_the_water_are_told_apart_to_twice_white(dive, known_water: MediumFit):
    tracks = fuse_depth(dive.rec, dive.frames, FEW)
    names, water = tuple(dive.rec.names), replace(known_water, Binf=torch.zeros(3))  # nothing to subtract
    thrice = FrameColors(names, torch.eye(3, 4).repeat(len(names), 1, 1) / 3)
    usual = restored_points(dive.rec, dive.frames, tracks, water).restored
    brighter = restored_points(dive.rec, replace(dive.frames, own_colors=thrice), tracks, water).restored
    assert (brighter.amax(-1) > 1.2).float().mean() > 0.05
    assert brighter.max() == 2
    seen = usual < 2 / 3
    torch.testing.assert_close(brighter[seen], 3 * usual[seen], atol=0.02, rtol=0)  # hues of others count a little


def test_far_points_have_the_hue_of_the_dive_in_channels_that_no_frame_shows(dive, known_water: MediumFit):
    """The same frames, said to be taken through water that takes nearly all red."""
    tracks = fuse_depth(dive.rec, dive.frames, FEW)
    without_red = replace(known_water.curve, a=known_water.curve.a * torch.tensor([50.0, 1.0, 1.0]))
    plain = restored_points(dive.rec, dive.frames, tracks, known_water).restored
    seen = restored_points(dive.rec, dive.frames, tracks, replace(known_water, curve=without_red)).restored
    assert (seen[:, 1:] - plain[:, 1:]).abs().median() < 1e-3
    assert (seen[:, 0] - seen[:, 1:].mean(1)).abs().mean() < 0.02  # gray, as no surface is known in red


def test_a_cloud_is_thinned_to_the_asked_count_and_keeps_its_extent(dive, known_water: MediumFit):
    tracks = fuse_depth(dive.rec, dive.frames, TrackSettings())
    full = restored_points(dive.rec, dive.frames, tracks, known_water)
    thin = thinned(full, 800)
    assert 300 < len(thin.xyz) <= 800 < len(full.xyz)
    assert (thin.xyz.amax(0)[:2] > 0.85 * full.xyz.amax(0)[:2]).all()
    torch.testing.assert_close(thin.restored.mean(0), full.restored.mean(0), atol=0.05, rtol=0)


@pytest.mark.parametrize("length", [1.0, 300.0])
def test_a_long_dive_keeps_as_many_points_as_a_compact_one(length: float):
    rng = torch.Generator().manual_seed(0)
    xyz = torch.rand(20_000, 3, generator=rng) * torch.tensor([length, 1.0, 0.0])
    few = thinned(DenseCloud(xyz, xyz.clamp(0, 1), xyz.clamp(0, 1)), 4000)
    assert 0.8 * 4000 < len(few.xyz) <= 4000


def test_a_surface_has_points_by_its_area(dive, known_water: MediumFit):
    tracks = fuse_depth(dive.rec, dive.frames, FEW)
    area = float(surface_of(dive.rec, float(tracks.ray_depth.median()), tracks.xyz).area.sum())
    settings = RestoreSettings(max_points=300, max_points_area=area / 5)
    assert times_as_many(dive.rec, tracks, settings) == pytest.approx(5)
    cloud = dense_cloud(dive.rec, dive.frames, tracks, known_water, settings, FEW)
    assert 0.7 * 1500 < len(cloud.xyz) <= 1500
    assert (cloud.restored - dive.seafloor(cloud.xyz[:, :2])).abs().mean() < 0.03


@pytest.mark.parametrize("share", [0.0, 1.01])
def test_a_surface_within_the_area_has_the_tracks_of_the_water(share: float, dive, known_water: MediumFit):
    tracks = fuse_depth(dive.rec, dive.frames, FEW)
    area = float(surface_of(dive.rec, float(tracks.ray_depth.median()), tracks.xyz).area.sum())
    settings = RestoreSettings(max_points=300, max_points_area=share * area)
    cloud = dense_cloud(dive.rec, dive.frames, tracks, known_water, settings, FEW)
    whole = thinned(restored_points(dive.rec, dive.frames, tracks, known_water), 300)
    for name, values in vars(whole).items():
        assert torch.equal(getattr(cloud, name), values)


def test_batches_hold_the_tracks_of_one_pass(dive):
    whole = fuse_depth(dive.rec, dive.frames, TrackSettings(max_tracks=4 * FEW.max_tracks))
    batches = list(fuse_in_batches(dive.rec, dive.frames, FEW, 4.0))
    assert len(batches) > 2
    assert torch.equal(torch.cat([batch.xyz for batch in batches]), whole.xyz)
    assert torch.equal(torch.cat([batch.pixel for batch in batches]), whole.pixel)
    for batch in batches:
        assert torch.equal(batch.track.unique(), torch.arange(len(batch.xyz)))
