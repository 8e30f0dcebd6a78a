"""The compiled sums of the water's fit against NumPy's."""

import numpy as np
import pytest
import torch

from swimm3r.lamp import Lamp, nodes_along, scattered
from swimm3r.sfm.medium.least_squares import kernels


@pytest.fixture
def seen() -> dict[str, np.ndarray]:
    """500 observations of 60 points in 12 frames, of which one shows nothing."""
    rng = np.random.default_rng(0)
    T_D, B, I, weight = rng.uniform(0.1, 0.9, (4, 500))
    frame = rng.integers(0, 11, 500)
    return {"T_D": T_D, "B": B, "I": I, "weight": weight, "point": rng.integers(0, 60, 500), "frame": frame}


def colors(T_D: np.ndarray, direct: np.ndarray, weight: np.ndarray, point: np.ndarray) -> np.ndarray:
    J = np.bincount(point, weight * T_D * direct, 60) / np.bincount(point, weight * T_D**2, 60).clip(1e-12)
    return J.clip(0, 1)


def test_colors_of_points_are_their_weighted_least_squares(seen: dict[str, np.ndarray]):
    found = kernels.surface_colors(seen["T_D"], seen["I"] - seen["B"], seen["weight"], seen["point"], 60)
    expected = colors(seen["T_D"], seen["I"] - seen["B"], seen["weight"], seen["point"])
    np.testing.assert_allclose(found, expected, rtol=1e-12)


@pytest.mark.parametrize("gain_std", [0.0, 0.1])
def test_whitening_takes_out_what_a_gain_of_a_frame_explains(gain_std: float, seen: dict[str, np.ndarray]):
    residuals, weight, frame = seen["I"] - 0.5, seen["weight"], seen["frame"]
    r, p = weight * residuals, weight * (seen["I"] - residuals)
    square = np.bincount(frame, p * p).clip(1e-12)
    share = (1 - 1 / np.sqrt(1 + gain_std**2 * square)) / square
    expected = r - p * (share * np.bincount(frame, p * r))[frame]
    np.testing.assert_allclose(
        kernels.whitened(residuals, seen["I"], weight, frame, 11, gain_std), expected, atol=1e-12
    )


def test_gains_of_frames_are_found_by_turns_with_the_colors(seen: dict[str, np.ndarray]):
    T_D, B, I, weight, point, frame = (seen[name] for name in ("T_D", "B", "I", "weight", "point", "frame"))
    gain, present = np.ones(12), np.unique(frame)
    for _ in range(5):
        p = colors(T_D, I / gain[frame] - B, weight, point)[point] * T_D + B
        gain = (np.bincount(frame, weight * I * p, 12) + 100.0) / (np.bincount(frame, weight * p * p, 12) + 100.0)
        gain /= np.exp(np.log(gain)[present].mean())
    found = kernels.frame_gains(T_D, B, I, weight, point, frame, 60, np.bincount(frame, minlength=12) > 0, 100.0, 5)
    np.testing.assert_allclose(found, gain, rtol=1e-10)


def test_light_scattered_along_rays_is_that_of_the_lamp():
    rng = np.random.default_rng(1)
    direction = rng.normal([0, 0, 1], 0.4, (40, 3))
    direction /= np.linalg.norm(direction, axis=1, keepdims=True)
    z, beta = rng.uniform(0, 9, 40), np.array([1.1, 0.4, 0.1])
    beam = torch.tensor([0.3, -0.2, -1.0, 0.1, 0.2, -0.1], dtype=torch.float64)
    lamp = Lamp(torch.tensor([0.3, -0.2, 0.1], dtype=torch.float64), 2.0, 0.9, 1.0, beam, torch.zeros(6))
    expected = scattered(torch.from_numpy(direction), torch.from_numpy(z), lamp, torch.from_numpy(beta), nodes=16)
    found = kernels.scattered(direction, z, *nodes_along(16), lamp.position.numpy(), 2.0, 0.9, beam.numpy(), beta)
    np.testing.assert_allclose(found, expected.numpy(), rtol=1e-12)
