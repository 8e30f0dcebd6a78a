"""Groups of points give the same points as asking all of them."""

import torch

from swimm3r.cameras import Cameras, project_visible
from swimm3r.geometry import pose_from, so3_exp
from swimm3r.scene.point_groups import PointGroups

POINTS = torch.rand(200_000, 3, generator=torch.Generator().manual_seed(1)) * 12 - 6


def camera_at(z: float) -> Cameras:
    K = torch.tensor([[600.0, 0, 160], [0, 600, 120], [0, 0, 1]], dtype=torch.float64)[None]
    rotation = so3_exp(torch.tensor([0.1, -0.2, 0.3], dtype=torch.float64))
    pose = pose_from(rotation, torch.tensor([0.5, 0.2, z], dtype=torch.float64))
    return Cameras(K, torch.zeros(1, 0, dtype=torch.float64), pose[None], 320, 240, "PINHOLE")


def sorted_rows(xyz: torch.Tensor) -> torch.Tensor:
    return torch.unique(xyz, dim=0)


def test_no_point_of_a_view_is_left_out_with_the_groups_beside_it():
    groups = PointGroups(POINTS)
    for z in (0.0, 3.0, -9.0):
        camera = camera_at(z)
        _, _, visible = project_visible(camera, POINTS[None].double())
        asked = groups.before(camera)
        _, _, found = project_visible(camera, asked[None].double())
        assert len(asked) < 0.7 * len(POINTS)
        assert found.sum() > 20
        assert torch.equal(sorted_rows(asked[found[0]]), sorted_rows(POINTS[visible[0]]))


def test_points_within_a_sphere_are_all_of_them():
    groups, center = PointGroups(POINTS), torch.tensor([1.0, -2.0, 5.0])
    expected = POINTS[(POINTS - center).norm(dim=-1) < 2.5]
    assert len(expected) > 100
    assert torch.equal(sorted_rows(groups.within(center, 2.5)), sorted_rows(expected))


def test_the_nearest_point_of_each_square_of_pixels_gives_its_depth():
    camera = camera_at(-9.0)
    found = PointGroups(POINTS).z_depth(camera)
    pixels, z, visible = project_visible(camera, POINTS[None].double())
    expected = torch.full((120, 160), torch.inf)
    for (x, y), depth in zip(pixels[visible].tolist(), z[visible].float().tolist(), strict=True):
        expected[int(y / 2), int(x / 2)] = min(expected[int(y / 2), int(x / 2)], depth)
    expected = torch.where(expected.isfinite(), expected, 0.0)
    assert (expected > 0).sum() > 20
    for rows, columns in ((0, 0), (0, 1), (1, 0), (1, 1)):
        assert torch.equal(found[rows::2, columns::2], expected)


def test_none_are_found_among_none():
    groups = PointGroups(torch.zeros(0, 3))
    assert groups.within(torch.zeros(3), 5.0).shape == (0, 3)
    assert groups.before(camera_at(0.0)).shape == (0, 3)
    assert not groups.z_depth(camera_at(0.0)).any()
