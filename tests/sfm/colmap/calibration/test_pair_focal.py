"""The focal length from fundamental matrices: found where pairs turn and move, left open where they do not tell."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from swimm3r.sfm.colmap.calibration.pair_focal import agreed_focal

WIDTH, HEIGHT = 400, 300


def fundamental_matrices(focal: float, turn_deg: float, noise: float = 0.0, count: int = 200) -> np.ndarray:
    """Of pairs that move in any direction and turn by up to `turn_deg` degrees; the noise is relative."""
    g = np.random.default_rng(2)
    inverse = np.linalg.inv([[focal, 0, WIDTH / 2], [0, focal, HEIGHT / 2], [0, 0, 1]])
    out = []
    for _ in range(count):
        R = Rotation.from_rotvec(np.deg2rad(turn_deg) * g.uniform(-1, 1, 3)).as_matrix()
        E = np.cross(np.eye(3), g.normal(size=3)) @ R
        E = E + noise * np.linalg.norm(E) * g.normal(size=(3, 3))
        out.append(inverse.T @ E @ inverse)
    return np.array(out)


@pytest.mark.parametrize("share", [0.5, 0.9, 1.6])
def test_the_focal_length_of_turning_cameras_is_found_within_a_step(share: float):
    found = agreed_focal(fundamental_matrices(share * WIDTH, 20.0, noise=0.005), WIDTH, HEIGHT)
    assert found == pytest.approx(share * WIDTH, rel=0.04)


def test_a_third_of_wrong_pairs_changes_nothing():
    F = fundamental_matrices(360.0, 20.0, noise=0.005)
    F[::3] = np.random.default_rng(0).normal(size=F[::3].shape)
    assert agreed_focal(F, WIDTH, HEIGHT) == pytest.approx(360.0, rel=0.04)


def test_scale_and_sign_of_the_matrices_do_not_matter():
    F = fundamental_matrices(360.0, 20.0)
    scales = np.random.default_rng(1).normal(size=(len(F), 1, 1))
    assert agreed_focal(F * scales, WIDTH, HEIGHT) == agreed_focal(F, WIDTH, HEIGHT)


@pytest.mark.parametrize(
    "F",
    [
        fundamental_matrices(360.0, 0.0, noise=0.005),
        fundamental_matrices(360.0, 20.0, count=60),
        np.random.default_rng(3).normal(size=(200, 3, 3)),
    ],
    ids=["cameras that only move", "too few pairs", "noise"],
)
def test_where_pairs_do_not_tell_nothing_is_said(F: np.ndarray):
    assert agreed_focal(F, WIDTH, HEIGHT) is None
