"""The page's charts and images."""

import numpy as np
import pytest

from swimm3r.report import charts


@pytest.mark.parametrize("largest", [0.007, 0.3, 1.0, 3.8, 12.0, 980.0])
def test_ticks_are_round_few_and_within(largest: float):
    ticks = charts.ticks(largest)
    assert 3 <= len(ticks) <= 6
    assert ticks[0] == 0
    assert ticks[-1] <= largest
    assert all(f"{t:g}" == f"{t:.3g}" for t in ticks)


def test_a_curve_is_dashed_beyond_what_was_seen():
    x = np.linspace(0, 5, 20, dtype=np.float32)
    svg = charts.line_chart([charts.Curve(x, x**2, "#f00", "R", solid_until=3.0)], "z", "B")
    assert svg.count("<polyline") == 2
    assert svg.count("stroke-dasharray") == 1
    assert ">z<" in svg


def test_near_is_warm_far_is_cold_and_unknown_is_gray():
    near, far, unknown = charts.depth_image(np.array([[1.0, 5.0, 0.0]]), 1.0, 5.0)[0]
    assert near[0] > near[2]
    assert far[2] > far[0]
    assert np.ptp(unknown.astype(int)) < 20


def test_the_plan_view_puts_the_path_over_the_points_below_it():
    rng = np.random.default_rng(0)
    xyz = np.column_stack([rng.uniform(-4, 4, 20_000), rng.uniform(-1, 1, 20_000), np.full(20_000, 3.0)])
    poses = np.eye(4)[None].repeat(9, 0)
    poses[:, 0, 3] = np.linspace(-3, 3, 9)  # swims along x, looks along z
    gray = np.full((20_000, 3), 0.5)
    view = charts.plan_view(xyz, gray, gray, poses)
    painted = (view.restored != 255).any(2)
    columns, rows = view.path.astype(int).T
    assert painted[rows, columns].mean() > 0.7
    steps = np.linalg.norm(np.diff(view.path, axis=0), axis=1) * view.units_per_pixel
    np.testing.assert_allclose(steps, 0.75, rtol=1e-6)
    assert "<circle" in charts.path_overlay(view)
