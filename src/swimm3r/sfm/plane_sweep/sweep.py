"""The plane sweep of one view: its depth by its own sources, before other frames are asked.

Surfaces are found on a grid of half the size and refined at full size. Where noise hides a texture from small windows
(far ground under a lamp, murky water), the images at half the size, with half the noise in windows twice as wide,
still tell the depth.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Protocol, runtime_checkable

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor
from torch.nn.functional import avg_pool2d, interpolate

from swimm3r.devices import CPU
from swimm3r.sfm.plane_sweep import kernels, numba_backend
from swimm3r.sfm.plane_sweep.level import Level, Round, SweepNumbers
from swimm3r.sfm.plane_sweep.refinement import window
from swimm3r.sfm.plane_sweep.settings import PlaneSweepSettings
from swimm3r.sfm.plane_sweep.views import SweepView, halved, likely_edge

_MOST_SOURCES = 16
_REACH = np.arange(-3, 4)  # the slanted windows' pixels, along each axis
_ASIDE = 2.5  # source pixels beside a match where it must be worse; nearer, small errors of the poses blur it
_FAINT = 3.0  # times the least texture: where small windows have less, wide ones are asked
_FAINT_EDGE = 2 / 255  # change of gray that makes a depth edge likely in wide windows
_BEND = 0.03  # share of inverse depth that wide windows may lie off the mean of their surroundings
_WIDE_ROUNDS, _WIDE_ASIDE = 2, 1.5  # of refinement; as `_ASIDE`, in pixels of half size


@dataclass(frozen=True)
class RawDepth:
    """One frame's own opinion, before others are asked; 0 = unknown."""

    inverse_depth: Float[Tensor, "h w"]  # 1 / z_depth
    correlation: Float[Tensor, "h w"]  # NCC with the best half of the sources, 0..1


@runtime_checkable
class Backend(Protocol):
    """The kernels of a processor."""

    @staticmethod
    def coarse_depth(level: Level, numbers: SweepNumbers) -> np.ndarray:
        """Inverse depth from the cost volume, smoothed along paths."""
        ...

    @staticmethod
    def refined(
        level: Level, numbers: SweepNumbers, surface: np.ndarray, rounds: Sequence[Round]
    ) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """The slanted surface after all rounds, its cost and its peak."""
        ...


@dataclass(frozen=True)
class _Judged:
    """Surfaces found on one grid, all [h, w]."""

    q: np.ndarray  # inverse depth
    correlation: np.ndarray
    sure: np.ndarray  # bool


def sweep(
    reference: SweepView,
    sources: Sequence[SweepView],
    z_range: tuple[float, float],
    settings: PlaneSweepSettings,
    device: torch.device = CPU,
) -> RawDepth:
    """Depth of one view from the others, between two z depths; 0 where the images do not determine it."""
    if not 1 <= len(sources) <= _MOST_SOURCES:
        raise ValueError(f"a sweep takes 1 to {_MOST_SOURCES} sources, got {len(sources)}")
    half, halves = halved(reference), [halved(source) for source in sources]
    coarse = _level(half, halves, max(settings.window, int(_REACH.max())))
    fine = _level(reference, sources, int(_REACH.max()))
    numbers = SweepNumbers(
        planes=_planes(half.gray.shape, coarse.lenses, z_range, settings.planes),
        radius=settings.window,
        noise=(kernels.SCALE * settings.noise) ** 2,
        edge=likely_edge(reference.gray),
        keep=(len(sources) + 1) // 2,
        smooth=settings.smooth,
        smooth_fine=settings.smooth_fine,
    )
    backend = _backend(device)
    found = backend.coarse_depth(coarse, numbers)
    refined = backend.refined(fine, numbers, kernels.doubled(found), _rounds(settings.rounds, _ASIDE))
    narrow = _judged(fine, refined, numbers.keep, settings)
    frontal = np.stack([found, np.zeros_like(found), np.zeros_like(found)], -1)
    averaged = replace(numbers, noise=numbers.noise / 4, edge=_FAINT_EDGE)
    refined = backend.refined(coarse, averaged, frontal, _rounds(_WIDE_ROUNDS, _WIDE_ASIDE))
    wide = _judged(coarse, refined, numbers.keep, settings)
    added = ~narrow.sure & _at_full_size(_smooth(wide, narrow)) & (_texture(reference) < _FAINT * settings.noise)
    full_size = interpolate(torch.from_numpy(wide.q)[None, None], added.shape, mode="bilinear")[0, 0].numpy()
    q = np.where(added, full_size, np.where(narrow.sure, narrow.q, 0))
    correlation = np.where(added, _at_full_size(wide.correlation), np.where(narrow.sure, narrow.correlation, 0))
    return RawDepth(torch.from_numpy(q), torch.from_numpy(correlation))


def _judged(
    level: Level, refined: tuple[np.ndarray, np.ndarray, np.ndarray], keep: int, settings: PlaneSweepSettings
) -> _Judged:
    """Refined surfaces, and where the images determine them: well correlated, and worse where they are moved.

    `keep` sources counted in the refinement.
    """
    surface, cost, peak = refined
    q = np.ascontiguousarray(surface[..., 0])
    # where two or more count, the sweep has counted a second source, which does not see the pixel, as no match
    alone = (keep > 1) & (_sighting(level, q) == 1)
    cost, peak = np.where(alone, 2 * cost - 1, cost).clip(0), np.where(alone, 2 * peak, peak)
    cost, peak = _with_neighbors(cost), _with_neighbors(peak)
    sure = (1 - cost >= settings.min_ncc) & (peak >= settings.min_peak * (cost + 0.03)) & (q > 0)
    return _Judged(q, 1 - cost, sure)


def _smooth(wide: _Judged, narrow: _Judged) -> np.ndarray:
    """Mask of sure wide windows that lie on one surface with all of their neighbors: none stands before another.

    Windows that reach over a silhouette take what lies behind it for the surface before it.
    """
    here, q = (torch.from_numpy(values.astype(np.float32))[None, None] for values in (wide.sure, wide.q))
    there = torch.from_numpy(np.stack([narrow.sure, narrow.sure * narrow.q]).astype(np.float32))[None]
    there = avg_pool2d(there, 2)
    side = len(_REACH)
    around = torch.cat([here + there[:, :1], here * q + there[:, 1:]], 1)
    count, total = avg_pool2d(around, side, 1, side // 2, count_include_pad=False)[0]
    bent = (total / count.clamp(min=1e-6) - q[0, 0]).abs() > _BEND * q[0, 0]
    return _with_neighbors((wide.sure & ~bent.numpy()).astype(np.float32)) > 0.99


def _texture(view: SweepView) -> np.ndarray:
    """Standard deviation of the view's detail in windows of 7 x 7 pixels."""
    both = torch.stack([view.detail, view.detail**2])[None]
    side = len(_REACH)
    mean, square = avg_pool2d(both, side, 1, side // 2)[0]
    return (square - mean**2).clamp(min=0).sqrt().numpy()


def _at_full_size(values: np.ndarray) -> np.ndarray:
    return values.repeat(2, 0).repeat(2, 1)


def _sighting(level: Level, q: np.ndarray) -> np.ndarray:
    """Number of sources that see each pixel's point, by its inverse depth."""
    h, w = q.shape
    y, x = np.mgrid[:h, :w].astype(np.float32)
    count = np.zeros((h, w), np.int32)
    for lens, seen in zip(level.lenses, level.seen, strict=True):
        H, e = lens[:9].reshape(3, 3), lens[9:]
        X, Y, Z = (H[k, 0] * x + H[k, 1] * y + H[k, 2] + q * e[k] for k in range(3))
        u, v = (axis / np.maximum(Z, 1e-9) for axis in (X, Y))
        inside = (Z > 0) & (u >= 0) & (v >= 0) & (u < w - 1) & (v < h - 1)
        count[inside] += seen[v[inside].astype(int), u[inside].astype(int)]
    return count


def _backend(device: torch.device) -> Backend:
    """The kernels of a processor."""
    if device.type == "cpu":
        return numba_backend
    from swimm3r.sfm.plane_sweep.cuda import backend as cuda_backend

    return cuda_backend


def _rounds(count: int, aside: float) -> list[Round]:
    """The rounds that look for better planes, and a last one that judges: is it good, is it worse `aside`."""
    every = np.stack(np.meshgrid(_REACH, _REACH), -1).reshape(-1, 2).astype(np.float32)
    chequered = window(every[np.abs(every).sum(1) % 2 == 0])  # half of the window judges as well as all of it
    odd = window(every[(np.abs(every) % 2 == 1).all(1)])  # and a third finds as well
    moves = [Round(odd, 0.5 if n else 1.0, (3, 1)[n % 2]) for n in range(count)]
    return [*moves, Round(chequered, aside, 0)]


def _with_neighbors(values: np.ndarray) -> np.ndarray:
    """Means of 3 x 3 pixels: single-pixel NCC is too noisy without texture."""
    padded = torch.nn.functional.pad(torch.from_numpy(values)[None, None], (1, 1, 1, 1), mode="replicate")
    return torch.nn.functional.avg_pool2d(padded, 3, stride=1)[0, 0].numpy()


def transfer(K: np.ndarray, pose: np.ndarray, K_there: np.ndarray, pose_there: np.ndarray) -> tuple:
    """H and e that take a pixel index at inverse depth q to H x + q e in another view."""
    half = np.array([[0, 0, 0.5], [0, 0, 0.5], [0, 0, 0]])  # pixel centers stand at +0.5, indices do not
    there = pose_there @ np.linalg.inv(pose)
    K_there = K_there - half
    return K_there @ there[:3, :3] @ np.linalg.inv(K - half), K_there @ there[:3, 3]


def _transfers(reference: SweepView, sources: Sequence[SweepView]) -> tuple[np.ndarray, np.ndarray]:
    pairs = [
        transfer(*(t.double().numpy() for t in (reference.K, reference.world2cam, s.K, s.world2cam))) for s in sources
    ]
    return np.stack([H for H, _ in pairs]), np.stack([e for _, e in pairs])


def _level(view: SweepView, sources: Sequence[SweepView], margin: int) -> Level:
    """The arrays of the kernels; a source sees where a window of half width `margin` lies wholly in what it shows."""
    H, e = _transfers(view, sources)
    unseen = torch.stack([(~s.seen).float() for s in sources])[:, None]
    near = torch.nn.functional.max_pool2d(unseen, 2 * margin + 1, stride=1, padding=margin)[:, 0]
    return Level(
        reference=view.detail.numpy() * np.float32(kernels.SCALE),
        guide=view.gray.numpy(),
        usable=view.seen.numpy(),
        flat=kernels.packed(torch.stack([s.detail for s in sources]).numpy()),
        seen=(near == 0).numpy(),
        lenses=np.concatenate([H.reshape(-1, 9), e], 1).astype(np.float32),
    )


def _planes(shape: torch.Size, lenses: np.ndarray, z_range: tuple[float, float], most: int) -> np.ndarray:
    """Inverse depths from far to near, evenly spaced: one per pixel of the largest motion, 32 to `most` of them."""
    near, far = z_range
    h, w = shape
    H, e = lenses[:, :9].reshape(-1, 3, 3).astype(np.float64), lenses[:, 9:].astype(np.float64)
    x = np.array([[0.5 * w, 0.5 * h, 1], [0, 0, 1], [w, 0, 1], [0, h, 1], [w, h, 1]])
    ends = [x @ H.transpose(0, 2, 1) + q * e[:, None] for q in (1 / far, 1 / near)]
    a, b = (p[..., :2] / np.maximum(p[..., 2:], 1e-3) for p in ends)
    motion = float(np.median(np.linalg.norm(a - b, axis=-1), axis=1).max())
    return np.linspace(1 / far, 1 / near, int(np.clip(np.ceil(motion), 32, most)))
