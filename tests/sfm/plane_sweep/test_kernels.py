"""The compiled kernels against the slow and obvious forms of `oracles`."""

import importlib.util
from pathlib import Path

import numpy as np
import pytest

from swimm3r.sfm.plane_sweep import kernels
from swimm3r.sfm.plane_sweep.refinement import refine, window

_spec = importlib.util.spec_from_file_location("plane_sweep_oracles", Path(__file__).with_name("oracles.py"))
assert _spec
assert _spec.loader
oracles = importlib.util.module_from_spec(_spec)
_spec.loader.exec_module(oracles)

HEIGHT, WIDTH = 20, 26
NOISE, EDGE = (0.8 / 255) ** 2, 0.05
SCALE = kernels.SCALE


def scene(seed: int = 0) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """A reference of smooth texture at q = 0.5, three sources that see it from aside, what they see, and lenses."""
    rng = np.random.default_rng(seed)
    waves = rng.uniform(0.3, 1.2, (12, 2)), rng.uniform(0, 6, 12)

    def texture(x: np.ndarray, y: np.ndarray) -> np.ndarray:
        return 0.02 * np.sum([np.sin(a * x + b * y + c) for (a, b), c in zip(*waves, strict=True)], 0)

    x, y = np.meshgrid(np.arange(WIDTH, dtype=float), np.arange(HEIGHT, dtype=float))
    shifts = ((3.0, 0.4), (-4.0, 0.6), (0.5, 5.0))
    sources = np.stack([texture(x - 0.5 * a, y - 0.5 * b) for a, b in shifts])
    H = np.tile(np.eye(3), (3, 1, 1))
    H[:, 2, 0] = 1e-4  # a little perspective
    lenses = np.concatenate([H.reshape(3, 9), [(a, b, 0.01) for a, b in shifts]], 1).astype(np.float32)
    seen = np.ones(sources.shape, bool)
    seen[1, :, :5] = False
    return texture(x, y).astype(np.float32), sources.astype(np.float32), seen, lenses


def test_two_pixels_share_an_integer_to_its_precision():
    images = np.random.default_rng(0).uniform(-1, 1, (2, 5, 7)).astype(np.float32)
    pairs = kernels.packed(images)
    left = (pairs << 16) >> 16
    assert np.abs(left / SCALE - images).max() <= 0.5 / SCALE * 1.001
    assert ((pairs >> 16)[..., :-1] == left[..., 1:]).all()


def test_the_cost_volume_is_the_mean_of_the_best_correlations():
    reference, sources, seen, lenses = scene()
    planes = np.linspace(0.2, 0.8, 4).astype(np.float64)
    ours = kernels.sweep_costs(
        reference * np.float32(SCALE), kernels.packed(sources), seen, lenses, planes, 2, SCALE**2 * NOISE, 2
    )
    true = oracles.sweep_costs(reference, sources, seen, lenses, planes, 2, NOISE, 2)
    assert np.abs(ours - true).max() < 1e-3
    assert (ours.argmin(-1)[5:-5, 8:-8] == 2).mean() > 0.9  # planes[2] = 0.6 is the nearest to 0.5 beside planes[1]


def test_semi_global_costs_are_those_of_eight_paths():
    rng = np.random.default_rng(1)
    volume, guide = rng.random((6, 9, 7)).astype(np.float32), rng.random((6, 9)).astype(np.float32)
    ours = kernels.semi_global(volume, guide, 0.15, 1.2, 0.2)
    np.testing.assert_allclose(ours, oracles.semi_global(volume.astype(float), guide, 0.15, 1.2, 0.2), rtol=1e-5)


def test_the_best_plane_lies_at_the_minimum_of_a_parabola():
    planes = np.linspace(1.0, 2.0, 11)
    total = ((planes - 1.437) ** 2).astype(np.float32)[None, None].repeat(2, 0)
    np.testing.assert_allclose(kernels.best_plane(total, planes), 1.437, atol=1e-4)


@pytest.mark.parametrize(("step", "reach"), [(1.0, 3), (0.5, 1), (2.5, 0)])
def test_a_round_of_refinement_is_what_its_definition_says(step: float, reach: int):
    reference, sources, seen, lenses = scene()
    rng = np.random.default_rng(2)
    surface = np.zeros((HEIGHT, WIDTH, 3), np.float32)
    surface[..., 0] = 0.5 + 0.05 * rng.standard_normal((HEIGHT, WIDTH))
    surface[..., 1:] = 0.003 * rng.standard_normal((HEIGHT, WIDTH, 2))
    offsets = np.array([(x, y) for y in range(-3, 4) for x in range(-3, 4) if (x + y) % 2 == 0])
    guide = (0.5 + reference).astype(np.float32)
    new, cost, peak = refine(
        reference * np.float32(SCALE), guide, np.ones((HEIGHT, WIDTH), bool), kernels.packed(sources), seen, lenses,
        surface, window(offsets), SCALE**2 * NOISE, EDGE, 2, 0.05, step, reach,
    )  # fmt: skip
    slow = oracles.Refinement(
        reference, guide, sources, seen, lenses, surface, offsets,
        noise=NOISE, edge=EDGE, keep=2, smooth=0.05, step=step, reach=reach,
    )  # fmt: skip
    inner = [(y, x) for y in range(3, HEIGHT - 3) for x in range(3, WIDTH - 3)]
    apart = np.array([[*(new[at] - p), cost[at] - c, peak[at] - k] for at in inner for p, c, k in [slow.pixel(*at)]])
    alike = np.abs(apart) < [1e-3, 1e-4, 1e-4, 3e-3, 3e-3]
    assert alike.all(1).mean() > 0.98  # the rest are ties of two candidates
    assert (np.abs(apart[:, 3]) < 5e-3).all()
