"""The points that maps start from: how they are thinned, and from where frames see them."""

from dataclasses import replace

import pytest
import torch

from swimm3r.cameras import project_visible
from swimm3r.scene.reconstruction import DenseCloud, DepthMaps
from swimm3r.splat.primitives.start import mean_directions, pixel_spacing, starting_points, voxel_sample
from swimm3r.splat.settings import InitialSettings


def test_voxels_are_bisected_until_the_wanted_number_of_points_is_left():
    points = torch.rand(20_000, 3, generator=torch.Generator().manual_seed(0)).double()
    chosen = voxel_sample(points, 3000)
    assert abs(len(chosen) - 3000) <= 30
    assert len(chosen.unique()) == len(chosen)


def test_dense_places_lose_more_points_than_sparse_ones():
    rng = torch.Generator().manual_seed(0)
    dense, sparse = torch.rand(9000, 3, generator=rng).double(), torch.rand(1000, 3, generator=rng).double() + 2
    chosen = voxel_sample(torch.cat([dense, sparse]), 1000)
    assert 0.3 < (chosen >= 9000).double().mean() < 0.6


def test_few_points_are_all_kept():
    assert torch.equal(voxel_sample(torch.rand(10, 3).double(), 100), torch.arange(10))


def test_voxels_are_as_large_as_the_spacing_asks():
    points = torch.rand(40_000, 3, generator=torch.Generator().manual_seed(0)).double()
    points[:, 2] = 0
    coarse = points[:, 0] > 0.5
    chosen = voxel_sample(points, 2000, torch.where(coarse, 2.0, 1.0).double())
    assert len(chosen) == pytest.approx(2000, rel=0.01)
    fine, few = float((~coarse[chosen]).sum()), float(coarse[chosen].sum())
    assert fine / few == pytest.approx(4, rel=0.1)
    assert torch.equal(voxel_sample(points, 2000, torch.full((40_000,), 7.0).double()), voxel_sample(points, 2000))


def test_points_are_spaced_by_the_pixels_that_show_them(tiny_dive, tmp_path):
    rec = replace(tiny_dive.rec, depth=DepthMaps(tmp_path))  # nothing hides anything
    camera = rec.cameras[3]
    center, ahead = camera.centers[0].double(), camera.cam2world[0, :3, 2].double()
    points = torch.stack([center + t * ahead for t in (1.0, 1.5, 2.0)])
    one = replace(rec, names=rec.names[3:4], cameras=camera)
    torch.testing.assert_close(pixel_spacing(points, one), torch.tensor([1.0, 1.5, 2.0]).double(), atol=1e-6, rtol=0)

    xyz = rec.points.xyz
    seen = torch.stack([project_visible(camera, xyz[None])[2][0] for camera in (rec.cameras[k] for k in range(7))])
    area = 1 / (xyz - rec.cameras.centers[:, None]).square().sum(-1)
    expected = ((seen * area).sum(0) / seen.sum(0)) ** -0.5
    middle = expected[seen.any(0)].median()
    expected = torch.where(seen.any(0), expected, 3 * middle).clamp(middle / 3, 3 * middle)
    spacing = pixel_spacing(xyz, rec)
    torch.testing.assert_close(spacing, expected, atol=0, rtol=1e-9)
    again = [0, *range(7), 0, 0]  # a camera that rests
    rested = replace(rec, names=tuple(f"{i}.png" for i in range(10)), cameras=rec.cameras[again])
    alone = seen[0] & (seen.sum(0) == 1)
    assert alone.any()
    torch.testing.assert_close(pixel_spacing(xyz, rested)[alone], spacing[alone], atol=0, rtol=0.2)
    behind = pixel_spacing(torch.cat([rec.points.xyz, (center - 5 * ahead)[None]]), one)
    assert behind[-1] == behind.amax()  # no frame sees it


def test_the_mean_direction_is_that_of_the_frames_which_see_the_point(tiny_dive):
    xyz = tiny_dive.rec.points.xyz[:50]
    mean = mean_directions(xyz, tiny_dive.rec, 64)
    assert (mean.norm(dim=-1) <= 1 + 1e-9).all()
    toward = torch.nn.functional.normalize(xyz - tiny_dive.rec.cameras.centers.mean(0), dim=-1)
    assert (torch.nn.functional.normalize(mean, dim=-1) * toward).sum(-1).min() > 0.95


def test_ground_of_guessed_depth_starts_as_densely_as_measured_ground(tiny_dive):
    rng = torch.Generator().manual_seed(0)
    plane = torch.cat([torch.rand(40_000, 2, generator=rng), torch.zeros(40_000, 1)], -1)
    measured, guessed = (
        plane[:36_000],
        plane[36_000:] + torch.tensor([3.0, 0, 0]),
    )  # as large, with a ninth of the points
    rec = replace(
        tiny_dive.rec, cloud=DenseCloud(measured, measured, measured), backdrop=DenseCloud(guessed, guessed, guessed)
    )
    start = starting_points(rec, InitialSettings(primitives=2000, backdrop=0.6))
    share = (start.xyz[:, 0] > 2).double().mean()
    assert share == pytest.approx(0.5, abs=0.05)
    spacing = start.spacing
    assert spacing[start.xyz[:, 0] > 2].median() == pytest.approx(
        float(spacing[start.xyz[:, 0] < 2].median()), rel=0.15
    )
