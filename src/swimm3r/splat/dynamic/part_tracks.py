"""Tracks of moving parts: association from frame to frame, and the shifts between.

A camera that swims shifts what moves by more than its own length from one frame to the next, and what has a pattern
looks alike a few pixels on. So parts are laid over each other, outlines and colors, wherever they may be.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float
from torch import Tensor
from torch.nn.functional import grid_sample

from swimm3r.cameras import pixel_grid

_OVERHANG = 0.03  # squared difference of color that a pixel of one part counts which the other does not cover
_ALIKE = 0.8 * _OVERHANG  # mean cost of two parts, laid over each other, that may be the same
_SIZES = (0.8, 0.9, 1.0, 1 / 0.9, 1 / 0.8)  # that a part may come to have in the next frame
_OVERLAP = 0.3  # of the smaller part, at least
_MOST = 6  # parts of a frame that are followed: every two of two frames are compared


@dataclass(frozen=True)
class Part:
    """A moving region of one frame, in a small image of it."""

    frame: int
    time: float
    mask: Bool[Tensor, "h w"]
    rgb: Float[Tensor, "3 h w"]  # of the whole frame


@dataclass(frozen=True)
class Fit:
    """The best alignment of a part with another."""

    cost: float
    whole: Float[Tensor, "2 3"]  # affine, of homogeneous pixels of the small images


@dataclass(frozen=True)
class Track:
    """One thing that moves, in frames that follow each other."""

    parts: tuple[Part, ...]
    fits: tuple[Fit, ...]  # of each part to the next


def tracks(parts: Sequence[Sequence[Part]]) -> list[Track]:
    """Every part in one track; `parts` are those of each frame, in the order of time. Small ones are not followed."""
    done: list[Track] = []
    running: list[Track] = []
    for everything in parts:
        largest_first = sorted(everything, key=lambda part: -int(part.mask.sum()))
        here = largest_first[:_MOST]
        done += [Track((part,), ()) for part in largest_first[_MOST:]]
        fits = {
            (i, j): fit
            for i, track in enumerate(running)
            for j, part in enumerate(here)
            if part.time > track.parts[-1].time and (fit := laid_over(track.parts[-1], part)) is not None
        }
        joined: dict[int, int] = {}  # part -> track, the best fits first
        for i, j in sorted(fits, key=lambda pair: fits[pair].cost):
            if i not in joined.values() and j not in joined:
                joined[j] = i
        done += [track for i, track in enumerate(running) if i not in joined.values()]
        running = [
            Track((*running[joined[j]].parts, part), (*running[joined[j]].fits, fits[joined[j], j]))
            if j in joined
            else Track((part,), ())
            for j, part in enumerate(here)
        ]
    return done + running


def laid_over(a: Part, b: Part) -> Fit | None:
    """The best fit of all shifts and some sizes; None if two parts do not fit each other.

    Its cost is a mean over the pixels that either covers: squared difference of color where both do, else a fixed
    cost. Parts that leave the image do not count.
    """
    tones = [part.rgb[:, part.mask].mean(1) for part in (a, b)]
    if float((tones[0] - tones[1]).square().mean()) > _ALIKE:
        return None
    fits = [fit for size in _SIZES if (fit := _shifted(a, b, size)) is not None]
    return min(fits, key=lambda fit: fit.cost, default=None)


def _shifted(a: Part, b: Part, size: float) -> Fit | None:
    """The best fit of all shifts of a part enlarged around its middle."""
    height, width = a.mask.shape
    middle = a.mask.nonzero().double().mean(0).flip(0) + 0.5
    at = middle + (pixel_grid(height, width).double() - middle) / size
    at = 2 * at / torch.tensor([width, height]) - 1
    maps = torch.cat(
        [torch.ones(1, height, width), a.mask[None], a.mask * a.rgb, (a.mask * a.rgb.square()).sum(0)[None]]
    )
    shown, mine, *rgb, squares = grid_sample(maps[None].double(), at[None], align_corners=False)[0]
    theirs = b.mask.double()
    everywhere, both, color, covered = _correlations(
        [(mine, torch.ones_like(theirs))],
        [(mine, theirs)],
        [
            (squares, theirs),
            (mine, theirs * b.rgb.square().sum(0)),
            *((-2 * c, theirs * d) for c, d in zip(rgb, b.rgb, strict=True)),
        ],
        [(shown, theirs)],
    )
    alone = everywhere + covered - 2 * both
    cost = (color / 3 + _OVERHANG * alone) / (both + alone).clamp(min=1)
    cost[both < _OVERLAP * min(float(mine.sum()), float(theirs.sum()))] = torch.inf
    best = int(cost.argmin())
    if float(cost.flatten()[best]) > _ALIKE:
        return None
    y, x = divmod(best, cost.shape[1])
    shift = torch.tensor([x if x < width else x - cost.shape[1], y if y < height else y - cost.shape[0]])
    whole = torch.cat([size * torch.eye(2), ((1 - size) * middle + shift)[:, None]], 1).double()
    return Fit(float(cost.flatten()[best]), whole)


def _correlations(*sums: Sequence[tuple[Tensor, Tensor]]) -> list[Float[Tensor, "H W"]]:
    """For each sum of pairs (a, b): sum over p of a(p) b(p + d), at row and column d; negative d count from the end."""
    from scipy.fft import next_fast_len

    height, width = sums[0][0][0].shape
    size = (next_fast_len(2 * height, real=True), next_fast_len(2 * width, real=True))
    pairs = [pair for one in sums for pair in one]
    spectra = torch.fft.rfft2(torch.stack([torch.stack(pair) for pair in pairs]), size)
    products = (spectra[:, 0].conj() * spectra[:, 1]).split([len(one) for one in sums])
    return list(torch.fft.irfft2(torch.stack([product.sum(0) for product in products]), size))
