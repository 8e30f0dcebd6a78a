"""The points that maps start from: how they are thinned, and from where frames see them."""

from dataclasses import replace

import numpy as np
import pytest
import torch

from swimm3r.cameras import project_visible, unproject
from swimm3r.scene.reconstruction import DenseCloud, DepthMaps
from swimm3r.splat.primitives import thinning
from swimm3r.splat.primitives.start import mean_directions, starting_points
from swimm3r.splat.primitives.thinning import Shown, covering_sample, voxel_sample
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


def test_no_primitive_starts_brighter_than_white(tiny_dive):
    cloud = tiny_dive.rec.cloud
    bright = replace(tiny_dive.rec, cloud=replace(cloud, restored=2 * cloud.restored), backdrop=None)
    plain = replace(tiny_dive.rec, backdrop=None)
    start, usual = (starting_points(rec, InitialSettings(primitives=500)).rgb for rec in (bright, plain))
    assert start.max() == 1
    torch.testing.assert_close(start, (2 * usual).clamp(max=1))


def test_points_cover_the_frames_evenly(tiny_dive, tmp_path):
    """A shell of points where depth is uncertain gets no more of them than a surface."""
    rec = replace(tiny_dive.rec, depth=DepthMaps(tmp_path))
    rng = torch.Generator().manual_seed(0)
    camera = rec.cameras[3]
    one = replace(rec, names=rec.names[3:4], cameras=camera)
    pixels = torch.rand(60_000, 2, generator=rng).double() * torch.tensor([camera.width, camera.height])
    near = pixels[:, 0] < camera.width / 2
    depth = torch.where(near, 2 + 0.2 * torch.rand(60_000, generator=rng), 6.0).double()
    points = unproject(camera, pixels[None], depth[None])[0].float()
    cloud = replace(one, cloud=DenseCloud(points, points, points), backdrop=None)
    start = starting_points(cloud, InitialSettings(primitives=2000))
    assert len(start.xyz) == pytest.approx(2000, rel=0.02)
    left = project_visible(camera, start.xyz[None])[0][0, :, 0] < camera.width / 2
    assert left.double().mean() == pytest.approx(0.5, abs=0.03)


def test_cells_take_the_point_nearest_to_their_middle_and_one_image_after_the_other():
    first = Shown(np.arange(4), np.array([[1.0, 1.0], [5.0, 5.2], [9.0, 1.0], [15.0, 5.0]]))
    second = Shown(np.array([0, 1, 2, 3, 4]), np.array([[5.0, 5.0], [6.0, 6.0], [15.0, 5.0], [12.0, 9.0], [25.0, 5.0]]))
    chosen = thinning._covering(6, [first, second], 10.0)
    assert np.flatnonzero(chosen).tolist() == [1, 3, 4]


def test_edges_are_bisected_until_the_wanted_number_of_points_is_left():
    rng = np.random.default_rng(0)
    images = [Shown(np.arange(5000), rng.uniform(0, 400, (5000, 2))) for _ in range(3)]
    assert len(covering_sample(5000, 1200, images)) == pytest.approx(1200, rel=0.01)
    assert len(covering_sample(6000, 10_000, images)) == 5000


def test_points_that_no_frame_shows_are_thinned_as_much(tiny_dive, tmp_path):
    rec = replace(tiny_dive.rec, depth=DepthMaps(tmp_path))
    camera = rec.cameras[3]
    one = replace(rec, names=rec.names[3:4], cameras=camera)
    rng = torch.Generator().manual_seed(0)
    pixels = torch.rand(20_000, 2, generator=rng).double() * torch.tensor([camera.width, camera.height])
    seen = unproject(camera, pixels[None], torch.full((1, 20_000), 3.0).double())[0].float()
    points = torch.cat([seen, 2 * camera.centers - seen])  # as many behind it
    cloud = replace(one, cloud=DenseCloud(points, points, points), backdrop=None)
    start = starting_points(cloud, InitialSettings(primitives=2000))
    inside = project_visible(camera, start.xyz[None])[2][0]
    assert inside.double().mean() == pytest.approx(0.5, abs=0.05)


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
