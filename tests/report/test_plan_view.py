"""The view of the scene along the mean viewing direction."""

import numpy as np

from swimm3r.report.plan_view import least_extended, path_overlay, plan_view


def test_the_plan_view_puts_the_path_over_the_points_below_it():
    rng = np.random.default_rng(0)
    xyz = np.column_stack([rng.uniform(-4, 4, 20_000), rng.uniform(-1, 1, 20_000), np.full(20_000, 3.0)])
    poses = np.eye(4)[None].repeat(9, 0)
    poses[:, 0, 3] = np.linspace(-3, 3, 9)  # swims along x, looks along z
    gray = np.full((20_000, 3), 0.5)
    view = plan_view(xyz, gray, gray, poses)
    painted = (view.restored != 255).any(2)
    columns, rows = view.path.astype(int).T
    assert painted[rows, columns].mean() > 0.7
    steps = np.linalg.norm(np.diff(view.path, axis=0), axis=1) * view.units_per_pixel
    np.testing.assert_allclose(steps, 0.75, rtol=1e-6)
    assert "<circle" in path_overlay(view, "m")


def test_cameras_that_move_along_their_view_or_not_at_all_have_a_view_from_above():
    rng = np.random.default_rng(0)
    xyz = np.column_stack([np.full(500, 3.0), rng.uniform(-1, 1, (500, 2))])
    gray = np.full((500, 3), 0.5)
    poses = np.eye(4)[None].repeat(5, 0)
    poses[:, :3, :3] = [[0, 0, 1], [-1, 0, 0], [0, -1, 0]]  # looks along x
    still = plan_view(xyz, gray, gray, poses)
    poses[:, 0, 3] = np.linspace(0, 1, 5)
    for view in (still, plan_view(xyz, gray, gray, poses)):
        assert np.isfinite(view.path).all()
        assert (view.raw != 255).any()


def test_the_normal_of_a_tilted_ground_is_found_and_a_ball_has_none():
    rng = np.random.default_rng(0)
    flat = np.column_stack([rng.uniform(-4, 4, 5000), rng.uniform(-3, 3, 5000), 0.05 * rng.normal(size=5000)])
    tilt = np.array([[1, 0, 0], [0, 0.6, -0.8], [0, 0.8, 0.6]])
    normal = least_extended(flat @ tilt.T)
    assert normal is not None
    assert abs(normal @ tilt[:, 2]) > 0.99
    assert least_extended(rng.normal(size=(5000, 3))) is None
