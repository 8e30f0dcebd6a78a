"""The set that training starts from, and what a change of unit does to it."""

from dataclasses import replace

import pytest
import torch

from swimm3r.cameras import Cameras, project_visible
from swimm3r.scene.reconstruction import DenseCloud, DepthMaps
from swimm3r.splat.primitives.beta import (
    initial_primitives,
    inverse_softplus,
    mean_directions,
    pixel_spacing,
    rescaled,
    starting_points,
    voxel_sample,
)
from swimm3r.splat.rendering import SplatMap
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


def test_with_mean_directions_most_primitives_are_visible_at_first_and_with_uniform_ones_few(tiny_dive):
    from swimm3r.splat.projection.conditioning import condition, queries

    share = {}
    for directions in ("mean", "uniform"):
        settings = InitialSettings(primitives=1000, directions=directions)
        p = initial_primitives(tiny_dive.rec, settings, torch.Generator().manual_seed(0))
        seen = condition(p, queries(p.xyz, tiny_dive.rec.cameras.centers[3].float()))
        share[directions] = (seen.opacity > 0.05).double().mean()
    assert share["mean"] > 0.9
    assert share["uniform"] < 0.3


def test_without_a_dense_cloud_the_sparse_points_are_taken(tiny_dive):
    p = initial_primitives(replace(tiny_dive.rec, cloud=None), InitialSettings(), torch.Generator().manual_seed(0))
    torch.testing.assert_close(p.xyz.double(), tiny_dive.rec.points.xyz, atol=1e-6, rtol=0)


def test_a_bounded_share_of_the_primitives_starts_on_ground_of_guessed_depth(tiny_dive):
    cloud = tiny_dive.rec.cloud
    behind = replace(cloud, xyz=cloud.xyz + 10.0)
    rec = replace(tiny_dive.rec, backdrop=behind)
    settings = InitialSettings(primitives=len(cloud.xyz), backdrop=0.25)
    p = initial_primitives(rec, settings, torch.Generator().manual_seed(0))
    guessed = (p.xyz[:, None] - behind.xyz[None]).abs().amax(-1).amin(-1) < 1e-4
    assert 0.15 * len(cloud.xyz) < guessed.sum() < 0.3 * len(cloud.xyz)
    assert len(p.xyz) < 1.02 * settings.primitives
    without = initial_primitives(rec, replace(settings, backdrop=0.0), torch.Generator().manual_seed(0))
    assert len(without.xyz) == len(cloud.xyz)
    assert (without.xyz < behind.xyz.amin(0)).any(-1).all()


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


def test_softplus_undoes_its_inverse():
    s = torch.tensor([1e-6, 1e-3, 0.5, 4.0, 30.0])
    torch.testing.assert_close(torch.nn.functional.softplus(inverse_softplus(s)), s, rtol=1e-5, atol=1e-9)


def test_a_scene_in_another_unit_looks_the_same(wall, camera):
    """Lengths times ten and coefficients by ten: the same image from the camera moved as far."""
    scene, view = wall(400), camera()
    pose = view.cam2world.clone()
    pose[:, :3, 3] *= 10
    other = wall(400)
    other.field.length.fill_(10.0)
    ten = SplatMap(rescaled(scene.primitives, 10.0), other.field, scene.settings, True, 10.0)
    a, b = scene.render(view), ten.render(Cameras(view.K, view.distortion, pose, view.width, view.height))
    torch.testing.assert_close(a.rgb, b.rgb, atol=2e-4, rtol=0)
    torch.testing.assert_close(10 * a.z_depth, b.z_depth, atol=2e-2, rtol=0)
