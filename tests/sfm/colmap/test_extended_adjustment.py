"""Bundle adjustment with other unknowns: derivatives against differences, sums against a solver without blocks."""

from dataclasses import dataclass, replace

import numpy as np
import pytest
from scipy import sparse
from scipy.optimize import least_squares
from scipy.spatial.transform import Rotation

from swimm3r.sfm.colmap.extended_adjustment import Bundle, Observed, adjusted, places, pose_jacobian, total

FRAMES, POINTS = 4, 12


@dataclass(frozen=True)
class Stretched:
    """Observations under a lens whose two focal lengths are the other unknowns."""

    frame: np.ndarray
    point: np.ndarray
    xy: np.ndarray
    width: float = 0.5
    prior_std: float = np.inf

    def errors(self, bundle: Bundle) -> np.ndarray:
        at = places(bundle, self)
        return at[:, :2] / at[:, 2:] * bundle.others - self.xy

    def by_place(self, bundle: Bundle) -> np.ndarray:
        at = places(bundle, self)
        out = np.zeros((len(at), 2, 3))
        out[:, [0, 1], [0, 1]] = bundle.others / at[:, 2:]
        out[:, :, 2] = -bundle.others * at[:, :2] / at[:, 2:] ** 2
        return out

    def by_others(self, bundle: Bundle) -> sparse.csr_array:
        at = places(bundle, self)
        return sparse.csr_array(((at[:, :2] / at[:, 2:])[:, :, None] * np.eye(2)).reshape(-1, 2))


def assert_derivatives(bundle: Bundle, observed: Observed) -> None:
    """Derivatives by poses, points and other unknowns are those of the errors, to 2e-3 px per unit."""
    step, at = 1e-6, observed.errors(bundle)
    by_place = observed.by_place(bundle)
    by_pose, by_point = pose_jacobian(places(bundle, observed), by_place), by_place @ bundle.R[observed.frame]
    by_others = observed.by_others(bundle).toarray().reshape(len(at), 2, -1)

    def change(**parts: np.ndarray) -> np.ndarray:
        return (observed.errors(replace(bundle, **parts)) - at) / step

    for axis in range(3):
        along = step * np.eye(3)[axis]
        turn = Rotation.from_rotvec(along).as_matrix()
        np.testing.assert_allclose(
            by_pose[:, :, axis], change(R=turn @ bundle.R, t=bundle.t @ turn.T), rtol=1e-4, atol=2e-3
        )
        np.testing.assert_allclose(by_pose[:, :, 3 + axis], change(t=bundle.t + along), rtol=1e-4, atol=2e-3)
        np.testing.assert_allclose(by_point[:, :, axis], change(xyz=bundle.xyz + along), rtol=1e-4, atol=2e-3)
    for k in range(len(bundle.others)):
        others = bundle.others.copy()
        others[k] += step
        np.testing.assert_allclose(by_others[:, :, k], change(others=others), rtol=1e-4, atol=2e-3)


@pytest.fixture
def clip() -> tuple[Bundle, Stretched]:
    """A bundle near the one that its observations are of, some of which are wrong."""
    rng = np.random.default_rng(0)
    xyz = np.stack([rng.uniform(-1, 1, POINTS), rng.uniform(-1, 1, POINTS), rng.uniform(3, 5, POINTS)], 1)
    R = Rotation.from_rotvec(rng.normal(scale=0.1, size=(FRAMES, 3))).as_matrix()
    truth = Bundle(R, rng.normal(scale=0.4, size=(FRAMES, 3)), xyz, np.array([300.0, 280.0]))
    frame, point = (part.ravel() for part in np.meshgrid(np.arange(FRAMES), np.arange(POINTS), indexing="ij"))
    at_truth = Stretched(frame, point, np.zeros((len(frame), 2))).errors(truth)
    wrong = np.where(rng.random((len(frame), 1)) < 0.1, 8.0, 0.3)
    observed = Stretched(frame, point, at_truth + rng.normal(size=(len(frame), 2)) * wrong)
    near = replace(
        truth,
        R=Rotation.from_rotvec(rng.normal(scale=0.01, size=(FRAMES, 3))).as_matrix() @ R,
        xyz=xyz + rng.normal(scale=0.02, size=xyz.shape),
        others=np.array([310.0, 275.0]),
    )
    return near, observed


@pytest.mark.parametrize("std", [np.inf, 290.0])
def test_the_sum_is_that_of_a_solver_without_blocks(clip: tuple[Bundle, Stretched], std: float):
    bundle, observed = clip[0], replace(clip[1], prior_std=std)

    def moved(x: np.ndarray) -> Bundle:
        poses, points = x[: 6 * FRAMES].reshape(-1, 6), x[6 * FRAMES : -2].reshape(-1, 3)
        R = Rotation.from_rotvec(poses[:, :3]).as_matrix() @ bundle.R
        return Bundle(R, bundle.t + poses[:, 3:], bundle.xyz + points, bundle.others + 100 * x[-2:])

    def residuals(x: np.ndarray) -> np.ndarray:
        found = moved(x)
        error = observed.errors(found) / observed.width
        squared = np.square(error).sum(-1, keepdims=True)
        robust = error * np.sqrt(2 * (np.sqrt(1 + squared) - 1) / squared)
        return np.concatenate([robust.ravel(), found.others / std])

    wanted = total(
        moved(least_squares(residuals, np.zeros(6 * FRAMES + 3 * POINTS + 2), method="lm", max_nfev=20000).x), observed
    )
    found = total(adjusted(bundle, observed, 100), observed)
    assert found < 0.6 * total(bundle, observed)
    assert found == pytest.approx(wanted, rel=1e-3)


def test_errors_of_poses_points_and_lens_have_their_derivatives(clip: tuple[Bundle, Stretched]):
    assert_derivatives(*clip)


def test_frames_and_points_without_observations_stay(clip: tuple[Bundle, Stretched]):
    bundle, observed = clip
    kept = (observed.frame != 2) & (observed.point != 5)
    observed = replace(observed, frame=observed.frame[kept], point=observed.point[kept], xy=observed.xy[kept])
    found = adjusted(bundle, observed, 10)
    np.testing.assert_array_equal(found.R[2], bundle.R[2])
    np.testing.assert_array_equal(found.t[2], bundle.t[2])
    np.testing.assert_array_equal(found.xyz[5], bundle.xyz[5])
    assert np.abs(found.xyz - bundle.xyz).max() > 1e-3


def test_a_prior_holds_unknowns_back(clip: tuple[Bundle, Stretched]):
    free, held = (adjusted(clip[0], replace(clip[1], prior_std=s), 50).others for s in (np.inf, 5.0))
    assert (held < 0.97 * free).all()
