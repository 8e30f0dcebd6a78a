"""Similarities in numpy: composition, inverse, and the least squares fit."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from swimm3r.sim3 import IDENTITY, Sim3, fit_similarity

RNG = np.random.default_rng(3)
POINTS = RNG.normal(size=(7, 3))
A, B = (Sim3(scale, Rotation.from_rotvec(RNG.normal(size=3)).as_matrix(), RNG.normal(size=3)) for scale in (0.3, 4.0))


def test_a_similarity_and_its_inverse_take_points_there_and_back():
    np.testing.assert_allclose(A.inverse()(A(POINTS)), POINTS, atol=1e-12)
    np.testing.assert_allclose(B.after(A)(POINTS), B(A(POINTS)), atol=1e-12)
    np.testing.assert_array_equal(IDENTITY.after(A)(POINTS), A(POINTS))


def test_the_fit_finds_the_similarity_of_exact_points():
    found = fit_similarity(POINTS, A(POINTS))
    assert found is not None
    assert found.scale == pytest.approx(A.scale, rel=1e-12)
    np.testing.assert_allclose(found(POINTS), A(POINTS), atol=1e-12)


def test_a_point_without_weight_has_no_part_in_the_fit():
    target = A(POINTS)
    target[0] += 5
    found = fit_similarity(POINTS, target, np.array([0.0, 1, 1, 1, 1, 1, 1]))
    assert found is not None
    np.testing.assert_allclose(found(POINTS[1:]), target[1:], atol=1e-12)


def test_points_on_a_line_fix_no_similarity():
    line = np.outer(np.arange(5.0), [1.0, 2.0, 3.0])
    assert fit_similarity(line, line) is None
