"""Patches of surface: the same surface in every frame that shows them, whole, and without clipped pixels."""

from dataclasses import replace
from pathlib import Path

import pytest
import torch
from tests.sfm.conftest import FlatDive, flat_dive

from swimm3r.medium import Medium
from swimm3r.scene.reconstruction import DepthMap, DepthMaps
from swimm3r.sfm.medium.dense_tracks import DenseTracks, fuse_depth
from swimm3r.sfm.medium.patches import Patches, SeenPatches, group_tracks, patches_seen
from swimm3r.sfm.medium.settings import SeathruSettings, TrackSettings

SETTINGS = SeathruSettings()


@pytest.fixture(scope="module")
def in_air(tmp_path_factory: pytest.TempPathFactory) -> FlatDive:
    """Flat ground without any water: a surface has one color from everywhere."""
    nothing = Medium(torch.zeros(3), torch.full((3,), 1e-9), torch.full((3,), 1e-9))
    return flat_dive(tmp_path_factory.mktemp("air"), nothing, (1.0, 1.3, 1.7, 2.2, 2.8, 3.4, 4.0))


def grouped(dive: FlatDive) -> Patches:
    tracks = fuse_depth(dive.rec, dive.frames, TrackSettings())
    return group_tracks(dive.rec, tracks, SETTINGS)


def seen_by(dive: FlatDive, i: int, patches: Patches, settings: SeathruSettings = SETTINGS) -> SeenPatches:
    own = torch.nonzero(patches.tracks.frame == i)[:, 0]
    return patches_seen(dive.rec, dive.frames, i, own, patches, settings)


def spread(I: torch.Tensor, patch: torch.Tensor) -> float:
    """Standard deviation of the colors of patches over the frames that show them."""
    count = torch.bincount(patch).clamp(min=1)[:, None]
    mean = torch.zeros(len(count), 3).index_add_(0, patch, I) / count
    return float((I - mean[patch])[count[patch, 0] > 1].std())


def own_means(dive: FlatDive, i: int, patches: Patches) -> tuple[torch.Tensor, torch.Tensor]:
    """The mean colors of what each frame itself observed of the patches: other parts of them in every frame."""
    tracks: DenseTracks = patches.tracks
    own = torch.nonzero(tracks.frame == i)[:, 0]
    of_first_grid = patches.of_track[0, tracks.track[own]]
    patch, which, count = torch.unique(of_first_grid, return_inverse=True, return_counts=True)
    I = torch.zeros(len(patch), 3).index_add_(0, which, dive.frames.colors(i, tracks.pixel[own])) / count[:, None]
    enough = count >= SETTINGS.patch_observations
    return I[enough], patch[enough]


def test_a_patch_has_one_color_in_all_frames(in_air: FlatDive):
    patches = grouped(in_air)
    seen = [seen_by(in_air, i, patches) for i in range(len(in_air.frames))]
    own = [own_means(in_air, i, patches) for i in range(len(in_air.frames))]
    whole = spread(torch.cat([s.I for s in seen]), torch.cat([s.patch for s in seen]))
    in_part = spread(torch.cat([I for I, _ in own]), torch.cat([patch for _, patch in own]))
    assert sum(len(s.patch) for s in seen) > 300
    assert whole < 0.012
    assert whole < in_part / 3


def test_its_distance_and_direction_are_those_of_its_middle(in_air: FlatDive):
    patches = grouped(in_air)
    seen = seen_by(in_air, 3, patches)
    toward = patches.middle[seen.patch] - in_air.rec.cameras.centers[3].float()
    edge = patches.size[seen.patch]
    assert ((seen.ray_depth - toward.norm(dim=-1)).abs() < 0.15 * edge).all()
    found = seen.direction * seen.ray_depth[:, None]  # the cameras' axes are those of the world
    assert ((found - toward).norm(dim=-1) < 0.3 * edge).all()


def test_the_tracks_of_patches_are_all_that_lie_in_them(dive: FlatDive):
    patches = grouped(dive)
    asked = torch.tensor([5, 2, len(patches.count) - 1])
    tracks = patches.tracks_of(asked)
    expected = torch.cat([torch.nonzero(patches.of_track == p)[:, 1] for p in asked])
    assert tracks.tolist() == expected.tolist()
    assert len(patches.tracks_of(asked[:0])) == 0


def test_each_grid_holds_every_track_once_and_has_its_borders_elsewhere(dive: FlatDive):
    patches = grouped(dive)
    grids = SETTINGS.patch_grids
    assert patches.of_track.shape == (grids, len(patches.tracks.xyz))
    numbers = [set(of_grid.tolist()) for of_grid in patches.of_track]
    assert sum(map(len, numbers)) == len(set().union(*numbers)) == len(patches.count)
    assert int(patches.count.sum()) == grids * len(patches.tracks.xyz)
    first, second = patches.of_track[:2]
    split = torch.unique(torch.stack([first, second]), dim=1).shape[1]  # parts that both grids' borders cut
    assert split > 1.5 * len(numbers[0])


def test_a_patch_that_something_covers_in_part_is_not_seen(in_air: FlatDive, tmp_path: Path):
    patches, depth = grouped(in_air), DepthMaps(tmp_path)
    for i, name in enumerate(in_air.rec.names):
        z = in_air.rec.depth[name].z_depth.clone()
        if i == 2:
            z[:, : z.shape[1] // 2] *= 0.9  # something nearer, in the left half of one frame
        depth.write(name, DepthMap(z, torch.ones_like(z)))
    covered = replace(in_air, rec=replace(in_air.rec, depth=depth))
    before, after = seen_by(in_air, 2, patches), seen_by(covered, 2, patches)
    assert 0 < len(after.patch) < len(before.patch)
    reach = patches.size[after.patch] / 2 / after.ray_depth
    assert (after.direction[:, 0] > -reach).all()
    entirely_right = before.direction[:, 0] > patches.size[before.patch] / before.ray_depth
    assert set(before.patch[entirely_right].tolist()) <= set(after.patch.tolist())


def test_a_patch_with_a_clipped_pixel_is_not_seen(in_air: FlatDive):
    patches = grouped(in_air)
    bright = float(seen_by(in_air, 2, patches).I.amax(-1).median())
    darker = seen_by(in_air, 2, patches, replace(SETTINGS, saturated=bright))
    assert len(darker.patch) > 0
    assert darker.I.max() < bright


def test_more_of_a_patch_is_asked_for_where_the_share_is_higher(in_air: FlatDive):
    patches = grouped(in_air)
    counts = [len(seen_by(in_air, 0, patches, replace(SETTINGS, patch_share=s, patch_offset=1.0)).patch)
              for s in (0.1, 0.8, 1.0)]  # fmt: skip
    assert counts[0] > counts[1] >= counts[2] > 0
