"""The plane sweep on a CUDA device: one view's arrays go there, its planes and costs come back (`numba_backend`)."""

import threading
from collections.abc import Sequence
from typing import Any

import numpy as np
import warp as wp

from swimm3r.sfm.plane_sweep.cuda import kernels
from swimm3r.sfm.plane_sweep.level import Level, Round, SweepNumbers

_one_at_a_time = threading.Lock()  # a view's volume is the largest thing in the device's memory
_DIRECTIONS = ((0, 1), (0, -1), (1, 0), (-1, 0), (1, 1), (1, -1), (-1, 1), (-1, -1))


def coarse_depth(level: Level, numbers: SweepNumbers, device: str = "cuda") -> np.ndarray:
    """Inverse depth from the cost volume, smoothed along paths. Other threads wait for the device."""
    with _one_at_a_time:
        h, w = level.reference.shape
        count = len(numbers.planes)
        reference, guide, flat, seen, lenses = _images(level, device)
        planes = _sent(numbers.planes.astype(np.float32), device)
        volume, total = (wp.zeros((count, h, w), dtype=float, device=device) for _ in range(2))
        wp.launch(
            kernels.sweep_costs, dim=(count, h, w), device=device,
            inputs=[reference, flat, seen, lenses, planes, numbers.radius, numbers.noise, numbers.keep, volume],
        )  # fmt: skip
        kept = wp.empty((2, count, h + w), dtype=float, device=device)
        for dy, dx in _DIRECTIONS:
            wp.launch(
                kernels.follow_paths, dim=h + w, device=device,
                inputs=[volume, guide, numbers.smooth, 8 * numbers.smooth, numbers.edge, dy, dx, kept, total],
            )  # fmt: skip
        q = wp.empty((h, w), dtype=float, device=device)
        wp.launch(kernels.best_plane, dim=(h, w), device=device, inputs=[total, planes, q])
        return q.numpy()


def refined(
    level: Level, numbers: SweepNumbers, surface: np.ndarray, rounds: Sequence[Round], device: str = "cuda"
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """The slanted surface after all rounds, its cost and its peak. Other threads wait for the device."""
    with _one_at_a_time:
        h, w = level.reference.shape
        reference, guide, flat, seen, lenses = _images(level, device)
        usable = _sent(level.usable.astype(np.uint8), device)
        now, new = _sent(surface, device), wp.empty(surface.shape, dtype=float, device=device)
        cost, peak = (wp.empty((h, w), dtype=float, device=device) for _ in range(2))
        for turn in rounds:
            margin = int(np.abs(turn.offsets[:2]).max())
            wp.launch(
                kernels.refine, dim=(h, w), device=device,
                inputs=[
                    reference, guide, usable, flat, seen, lenses, now, _sent(turn.offsets, device), numbers.noise,
                    numbers.edge, numbers.keep, numbers.smooth_fine, turn.step, turn.reach, margin, new, cost, peak,
                ],
            )  # fmt: skip
            now, new = new, now
        return now.numpy(), cost.numpy(), peak.numpy()


def _images(level: Level, device: str) -> tuple[Any, Any, Any, Any, Any]:
    """The arrays of a level that every kernel reads, on the device."""
    arrays = (level.reference, level.guide, level.flat, level.seen.astype(np.uint8), level.lenses)
    return tuple(_sent(array, device) for array in arrays)  # type: ignore[return-value]


def _sent(array: np.ndarray, device: str) -> Any:
    """A copy on the device; on Warp's CPU device too, which would else share the memory it writes to."""
    return wp.array(np.ascontiguousarray(array), device=device, copy=True)
