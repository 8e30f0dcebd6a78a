"""Lengths and areas on a wall at a known distance."""

import numpy as np
import pytest
import torch
from tests.viewer.conftest import DISTANCE
from tests.viewer.test_layers import frame_view

from swimm3r.viewer import measuring
from swimm3r.viewer.layers import LayerChoice, Painter
from swimm3r.viewer.measuring import Measured, SurfacePoint, area, cloud_point, length, surface_point, told
from swimm3r.viewer.viewed_run import ViewedRun

CORNERS = ((0.3, 0.3), (0.6, 0.3), (0.6, 0.7), (0.3, 0.7))


def clicked(wall: ViewedRun) -> list[SurfacePoint]:
    painter, view = Painter(wall), frame_view(wall)
    found = [surface_point(painter, view, at, LayerChoice()) for at in CORNERS]
    assert None not in found
    return [point for point in found if point is not None]


def sides(wall: ViewedRun) -> tuple[float, float]:
    """Width and height of the clicked rectangle on the wall, metres."""
    view = frame_view(wall)
    down = 2 * DISTANCE * np.tan(view.fov / 2)
    return 0.3 * down * view.aspect, 0.4 * down


def test_a_clicked_length_is_that_on_the_wall(wall: ViewedRun):
    points = clicked(wall)
    width, height = sides(wall)
    assert length(points[:2]).value == pytest.approx(width, rel=0.02)
    assert length(points).value == pytest.approx(2 * width + height, rel=0.02)


def test_a_clicked_area_is_that_on_the_wall(wall: ViewedRun):
    width, height = sides(wall)
    found = area(clicked(wall))
    assert found.value == pytest.approx(width * height, rel=0.03)


def test_the_spread_between_frames_is_small_on_a_surface_that_all_agree_on(wall: ViewedRun):
    points = clicked(wall)
    assert all(point.std is not None and point.std < 0.05 for point in points)
    found = length(points[:2])
    assert found.std is not None
    assert found.std < 0.05
    assert area(points).std is not None


def test_nothing_is_measured_where_nothing_is(wall: ViewedRun):
    painter, view = Painter(wall), frame_view(wall)
    away = view.cam2world.clone()
    away[:3, :3] = away[:3, :3] @ torch.diag(torch.tensor([-1.0, 1.0, -1.0]).double())
    assert surface_point(painter, type(view)(away, view.fov, view.aspect), (0.5, 0.5), LayerChoice()) is None


def test_a_length_across_the_rays_has_no_part_of_the_spread_along_them():
    ahead = np.array([0.0, 0.0, 1.0])
    points = [SurfacePoint(np.array([x, 0.0, 3.0]), ahead, 0.1) for x in (0.0, 1.0)]
    assert length(points) == Measured(1.0, 0.0)
    deep = [points[0], SurfacePoint(np.array([0.0, 0.0, 5.0]), ahead, 0.1)]
    assert length(deep).value == 2.0
    assert length(deep).std == pytest.approx(0.1 * 2**0.5)


def test_a_point_that_one_frame_sees_makes_a_length_without_spread():
    ahead = np.array([0.0, 0.0, 1.0])
    points = [SurfacePoint(np.array([x, 0.0, 3.0]), ahead, std) for x, std in ((0.0, 0.1), (1.0, None))]
    assert length(points).std is None


def test_the_nearest_point_of_a_cloud_along_the_ray_is_taken():
    xyz = np.array([[0.0, 0, 5], [0.01, 0, 3], [0.5, 0, 2], [0, 0, -1]])
    found = cloud_point(xyz, np.zeros(3), np.array([0.0, 0, 1]))
    assert found is not None
    assert np.array_equal(found.xyz, xyz[1])
    assert cloud_point(xyz, np.zeros(3), np.array([0.0, 1, 0])) is None


@pytest.mark.parametrize(
    ("value", "std", "text"),
    [
        (1.2432, 0.0181, "1.243 ± 0.018 m"),
        (12.04, 0.81, "12.04 ± 0.81 m"),
        (1.2432, None, "1.24 m"),
        (215.0, 32.0, "215 ± 32 m"),
    ],
)
def test_numbers_have_the_digits_that_their_spread_leaves(value: float, std: float | None, text: str):
    assert told(measuring.Measured(value, std), "m") == text
