"""Depth in colors and the numbers beside them."""

import numpy as np
import torch

from swimm3r.imaging.depth_colors import depth_image, depth_scale, depth_span


def test_near_is_warm_far_is_cold_and_unknown_is_gray():
    near, far, unknown = depth_image(np.array([[1.0, 5.0, 0.0]]), 1.0, 5.0)[0]
    assert near[0] > near[2]
    assert far[2] > far[0]
    assert np.ptp(unknown.astype(int)) < 20


def test_a_color_bar_has_the_colors_that_its_depths_have_in_images():
    colors, depths = depth_scale(2.0, 10.0, 5)
    np.testing.assert_allclose(depths[[0, -1]], [2, 10])
    assert (np.diff(depths) > 0).all()
    np.testing.assert_array_equal(depth_image(depths[None], 2.0, 10.0)[0], colors)


def test_the_span_leaves_stray_points_out_and_is_never_empty():
    near, far = depth_span(torch.cat([torch.linspace(2, 4, 100), torch.tensor([0.01, 900.0])]))
    assert 1.9 < near < far < 4.1
    near, far = depth_span(torch.full((10,), 3.0))
    assert near < far
