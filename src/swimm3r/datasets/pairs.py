"""Pairs of images of a sequence that overlap: by poses and depth where known, else by time.

    overlap(i, j) = share of i's pixels of known depth that land in j at the depth j measures there

A pair's overlap is the smaller of both directions.
"""

from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from swimm3r.cameras import Cameras, project_visible, unproject
from swimm3r.datasets.sequences import Sequence
from swimm3r.datasets.settings import PairSettings
from swimm3r.io.depth import read_depth

_GRID = 24  # samples per axis: 576 points tell an overlap to 2 %
_LONG_SIDE = 240  # pixels; the depth maps of a whole sequence are held at once
_TOLERANCE = 0.1  # relative difference of depth up to which both shots see the same surface


@dataclass(frozen=True)
class Pair:
    """Two shots of one sequence, i < j, and how much they share (None where only time tells)."""

    i: int
    j: int
    overlap: float | None = None


@dataclass(frozen=True)
class _Posed:
    camera: Cameras
    z_depth: Float[Tensor, "h w"]


def make_pairs(sequence: Sequence, settings: PairSettings) -> list[Pair]:
    """The pairs of a sequence, sorted. Shots of different splits are never paired."""
    shots = sequence.shots
    if sequence.metric and sequence.lens is not None and all(s.name in sequence.cam2world and s.depth for s in shots):
        found = _by_overlap(sequence, settings)
    elif len(shots) > 1 and all(s.time is not None for s in shots):
        found = _by_time(np.array([s.time for s in shots]), settings)
    else:
        found = _by_order(len(shots), settings)
    return sorted((p for p in found if shots[p.i].split == shots[p.j].split), key=lambda p: (p.i, p.j))


def _by_overlap(sequence: Sequence, settings: PairSettings) -> list[Pair]:
    posed = [_posed(sequence, i) for i in range(len(sequence))]
    found = []
    for i in range(len(posed)):
        near = []
        for j in range(i + 1, min(i + 1 + settings.reach, len(posed))):
            share = min(overlap(posed[i], posed[j]), overlap(posed[j], posed[i]))
            if settings.min_overlap <= share <= settings.max_overlap:
                near.append(Pair(i, j, share))
        # evenly over the range of overlaps: easy and hard ones
        near.sort(key=lambda p: -(p.overlap or 0.0))
        chosen = np.unique(np.linspace(0, len(near) - 1, min(settings.per_shot, len(near))).round().astype(int))
        found += [near[k] for k in chosen]
    return found


def _by_time(seconds: np.ndarray, settings: PairSettings) -> list[Pair]:
    found = set()
    for i, now in enumerate(seconds):
        for gap in settings.gaps_s[: settings.per_shot]:
            j = int(np.abs(seconds - now - gap).argmin())
            if j > i and abs(seconds[j] - now - gap) < gap / 4 and j - i <= settings.reach:
                found.add(Pair(i, j))
    return list(found)


def _by_order(count: int, settings: PairSettings) -> list[Pair]:
    steps = settings.steps[: settings.per_shot]
    return [Pair(i, i + step) for i in range(count) for step in steps if i + step < count]


def overlap(seen: _Posed, other: _Posed) -> float:
    """The share of a grid of one shot's surface points that the other shot sees, too."""
    height, width = seen.z_depth.shape
    rows, columns = (torch.linspace(0, n - 1, _GRID).round().long() for n in (height, width))
    z = seen.z_depth[rows][:, columns].flatten()
    pixels = torch.cartesian_prod(rows + 0.5, columns + 0.5).flip(-1).double()
    known = z > 0
    if not bool(known.any()):
        return 0.0
    world = unproject(seen.camera, pixels[known][None], z[known].double()[None])
    xy, expected, visible = project_visible(other.camera, world)
    column, row = xy[visible].long().unbind(-1)
    measured, expected = other.z_depth[row, column].double(), expected[visible]
    agrees = (measured > 0) & ((measured - expected).abs() <= _TOLERANCE * expected)
    return float(agrees.sum() / visible.numel())


def _posed(sequence: Sequence, i: int) -> _Posed:
    shot = sequence.shots[i]
    if shot.depth is None:
        raise ValueError(f"shot {shot.name} has no depth")
    depth = torch.from_numpy(read_depth(shot.depth))
    low, high = sequence.depth_range
    size = [max(1, round(n * min(1.0, _LONG_SIDE / max(depth.shape)))) for n in depth.shape]
    depth = torch.nn.functional.interpolate(depth[None, None], size, mode="nearest-exact")[0, 0]
    camera = sequence.camera(depth.shape[1], depth.shape[0])
    if camera is None:
        raise ValueError(f"sequence {sequence.name} has no lens")
    pose = torch.from_numpy(np.asarray(sequence.cam2world[shot.name], dtype=np.float64))[None]
    placed = Cameras(camera.K, camera.distortion, pose, camera.width, camera.height, camera.model)
    return _Posed(placed, torch.where((depth >= low) & (depth <= high), depth, 0.0))
