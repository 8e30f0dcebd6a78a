"""Gains of all frames at once: weighted least squares over frames and points together."""

import numpy as np
import pytest

from swimm3r.imaging.joint_gains import GainEvidence, joint_gains


def chain(frames: int, terms: int, seed: int = 0) -> tuple[np.ndarray, ...]:
    """Points that three frames in a row see, at random places: terms, weights, points and frames."""
    rng = np.random.default_rng(seed)
    first = rng.integers(0, frames - 2, 12 * frames)
    frame = (first[:, None] + np.arange(3)).ravel()
    point = np.repeat(rng.permutation(len(first)) * 7, 3)  # numbered with gaps
    places = rng.standard_normal((len(frame), terms - 1))
    return np.column_stack([np.ones(len(frame)), places]), rng.uniform(0.5, 2, len(frame)), point, frame


def held(frames: int, terms: int, channels: int, stay: float, seed: int = 1) -> GainEvidence:
    pulled = 0.1 * np.random.default_rng(seed).standard_normal((frames, terms, channels))
    return GainEvidence(np.tile(stay * np.eye(terms), (frames, 1, 1)), stay * pulled)


@pytest.mark.parametrize("terms", [1, 4])
def test_frames_and_points_are_solved_together(terms):
    frames, channels = 9, 2
    seen, weight, point, frame = chain(frames, terms)
    delta = 0.2 * np.random.default_rng(2).standard_normal((len(frame), channels))
    alone = held(frames, terms, channels, 0.3)
    found = joint_gains(delta, seen, weight, point, frame, alone)

    numbers = np.unique(point, return_inverse=True)[1]
    A = np.zeros((len(frame), frames * terms + numbers.max() + 1))
    for k in range(terms):
        A[np.arange(len(frame)), frame * terms + k] = seen[:, k]
    A[np.arange(len(frame)), frames * terms + numbers] = 1
    normal = (A * weight[:, None]).T @ A
    own = slice(None, frames * terms)
    normal[own, own] += 0.3 * np.eye(frames * terms)
    right = (A * weight[:, None]).T @ delta
    right[own] += alone.products.reshape(-1, channels)
    mean = np.zeros((terms, len(normal)))  # of the gains, by a Lagrange multiplier each
    for k in range(terms):
        mean[k, k : frames * terms : terms] = 1
    system = np.block([[normal, mean.T], [mean, np.zeros((terms, terms))]])
    dense = np.linalg.solve(system, np.concatenate([right, np.zeros((terms, channels))]))
    gains = dense[own].reshape(frames, terms, channels)
    np.testing.assert_allclose(found.gains, gains, atol=2e-3 * np.abs(gains).max())
    changes = dense[frames * terms : len(normal)][numbers]
    np.testing.assert_allclose(found.changes, changes, atol=2e-3 * np.abs(changes).max())


def test_frames_far_apart_in_a_long_chain_agree():
    """Differences of gains that nothing holds are exact, though no point links more than three frames."""
    frames = 200
    seen, weight, point, frame = chain(frames, 1)
    gains = np.cumsum(0.02 * np.random.default_rng(3).standard_normal(frames))
    gains -= gains.mean()
    of_points = np.random.default_rng(4).standard_normal(point.max() + 1)
    delta = (gains[frame] + of_points[point])[:, None]
    found = joint_gains(delta, seen, weight, point, frame, held(frames, 1, 1, 0.0))
    np.testing.assert_allclose(found.gains[:, 0, 0], gains, atol=0.01 * np.abs(gains).max())


def test_frames_that_see_nothing_have_the_gains_they_are_held_to():
    seen, weight, point, frame = chain(6, 1)
    alone = GainEvidence(np.tile(np.eye(1), (8, 1, 1)), np.zeros((8, 1, 1)))
    found = joint_gains(0.1 * seen, seen, weight, point, frame, alone)
    np.testing.assert_allclose(found.gains, 0, atol=1e-6)
