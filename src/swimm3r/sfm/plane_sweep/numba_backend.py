"""The plane sweep on the CPU, compiled by Numba."""

from collections.abc import Sequence

import numpy as np

from swimm3r.sfm.plane_sweep import kernels
from swimm3r.sfm.plane_sweep.level import Level, Round, SweepNumbers
from swimm3r.sfm.plane_sweep.refinement import refine


def coarse_depth(level: Level, numbers: SweepNumbers) -> np.ndarray:
    """Inverse depth from the cost volume, smoothed along paths."""
    n = numbers
    volume = kernels.sweep_costs(
        level.reference, level.flat, level.seen, level.lenses, n.planes, n.radius, n.noise, n.keep
    )
    total = kernels.semi_global(volume, level.guide, n.smooth, 8 * n.smooth, n.edge)
    return kernels.best_plane(total, n.planes)


def refined(
    level: Level, numbers: SweepNumbers, surface: np.ndarray, rounds: Sequence[Round]
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """The slanted surface after all rounds, its cost and its peak."""
    n = numbers
    cost = peak = np.zeros(level.reference.shape, np.float32)
    for turn in rounds:
        surface, cost, peak = refine(
            level.reference, level.guide, level.usable, level.flat, level.seen, level.lenses, surface, turn.offsets,
            n.noise, n.edge, n.keep, n.smooth_fine, turn.step, turn.reach,
        )  # fmt: skip
    return surface, cost, peak
