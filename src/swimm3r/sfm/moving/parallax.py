"""Depths that explain displaced pixels: an object at rest is seen along epipolar lines, where its depth puts it.

A point at depth z on the ray of pixel x in frame t lies at pixel x_s(z) in frame s. If it is at rest, then at its true
depth the frames that see it show there, with the gains g and the limit of their comparison with t (`comparison`),

    d(g I_s(x_s(z)), I_t(x)) <= limit / 2

Dense depth may have missed this depth: it is wrong or absent on thin near objects and beside depth edges. All depths
are therefore tried, from an eighth of that of the nearest surface measured on the ray to that of the farthest, in equal
steps of 1 / z. The votes of the frames are summed over the asked pixels around x, of every second row and column. A
depth explains x if most votes are for it and three frames show it at a place that differs visibly from that of the
measured surface, at which x is known not to lie. An object is at rest if this explains most of its pixels: of a plain
object that moves, some parts look like others in a few frames.

No depth on the ray explains motion across epipolar lines, nor motion with the camera: it would need a depth at
infinity, behind ground.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Bool, Float, Int

from swimm3r.cameras import pixel_grid, project_visible, unproject
from swimm3r.sfm.moving.comparison import ColorRange, Pair, SmallView, color_range, exactly

_NEAREST = 8.0  # times as near as the nearest measured surface: nearer objects fill the image
_DEPTHS = 64
_STRIDE = 2  # pixels between those that are tried, in rows and columns
_WINDOW = 7  # pixels, side of the square over which votes are summed
_APART = 2.0  # pixels between the places of a depth and of the measured surface, from which they differ
_FRAMES = 3  # that must show the pixel at a depth
_MOST = 0.7  # share of the votes
_WHOLE = 0.5  # share of the pixels of a connected region, from which it is at rest
_NEARER = 0.05  # share of a depth by which one surface is before another


@dataclass(frozen=True)
class MeasuredRange:
    """The depths of the surfaces that other frames measured on the rays of a frame's pixels; 0 without any."""

    nearest: Float[np.ndarray, "h w"]
    farthest: Float[np.ndarray, "h w"]


@dataclass(frozen=True)
class _Rays:
    """The tried pixels of a frame with the depths to try on each one's ray."""

    pixels: Float[torch.Tensor, "n 2"]
    row: Int[np.ndarray, " n"]
    column: Int[np.ndarray, " n"]
    z_depth: Float[np.ndarray, "d n"]
    measured: Float[np.ndarray, " n"]  # of the nearest measured surface


def explained(
    view: SmallView,
    others: Sequence[SmallView],
    pairs: Sequence[Pair],
    asked: Bool[np.ndarray, "h w"],
    measured: MeasuredRange,
) -> Bool[np.ndarray, "h w"]:
    """The connected regions of the asked pixels that show something at rest, by other frames of the scene.

    `pairs` compare the frame's colors with those of each of the others.
    """
    asked = asked & (measured.nearest > 0)
    if not asked.any() or not others:
        return np.zeros_like(asked)
    tried = np.zeros_like(asked)
    tried[::_STRIDE, ::_STRIDE] = asked[::_STRIDE, ::_STRIDE]
    rays, colors = _rays(view, tried, measured), color_range(view.rgb)
    same, distinct, different = (np.zeros(rays.z_depth.shape, np.float32) for _ in range(3))
    for other, pair in zip(others, pairs, strict=True):
        shown, refuted, apart = _votes(view, colors, other, pair, rays)
        same += shown
        distinct += shown & apart
        different += refuted
    found = np.zeros_like(asked)
    count = _summed(np.ones(len(rays.row), np.float32), rays, asked.shape)
    for depth in range(len(rays.z_depth)):
        yes, clearly, no = (_summed(votes[depth], rays, asked.shape) for votes in (same, distinct, different))
        found |= (yes >= _MOST * (yes + no)) & (clearly >= _FRAMES * count)
    return _whole(asked, tried, found & tried)


def _whole(
    asked: Bool[np.ndarray, "h w"], tried: Bool[np.ndarray, "h w"], found: Bool[np.ndarray, "h w"]
) -> Bool[np.ndarray, "h w"]:
    """The connected regions of the asked pixels, of whose tried pixels most are found."""
    import cv2

    count, labels = cv2.connectedComponents(asked.astype(np.uint8))
    part_of = labels.astype(np.int64)
    sizes, explained = (np.bincount(part_of[mask], minlength=count) for mask in (tried, found))
    return asked & ((sizes > 0) & (explained >= _WHOLE * sizes))[part_of]


def _rays(view: SmallView, asked: Bool[np.ndarray, "h w"], measured: MeasuredRange) -> _Rays:
    row, column = np.nonzero(asked)
    near, far = measured.nearest[asked], measured.farthest[asked]
    share = np.linspace(0, 1, _DEPTHS)[:, None]
    inverse = (1 - share) / far + share * _NEAREST / near
    return _Rays(pixel_grid(*asked.shape)[row, column], row, column, 1 / inverse, near)


def _votes(
    view: SmallView, colors: ColorRange, other: SmallView, pair: Pair, rays: _Rays
) -> tuple[Bool[np.ndarray, "d n"], Bool[np.ndarray, "d n"], Bool[np.ndarray, "d n"]]:
    """Votes of another frame on each depth of the pixels: for it, against it, and apart from the measured surface.

    A frame has no vote on places outside its image and behind what it measured.
    """
    depths = np.concatenate([rays.z_depth, rays.measured[None]])
    count, n = depths.shape
    pixels = rays.pixels.double().expand(count, -1, -1).reshape(1, -1, 2)
    points = unproject(view.camera, pixels, torch.from_numpy(depths.reshape(1, -1)))
    uv, z, visible = (part[0].numpy() for part in project_visible(other.camera, points))
    apart = np.linalg.norm(uv.reshape(count, n, 2) - uv.reshape(count, n, 2)[-1], axis=-1) >= _APART
    column, row = np.where(visible[:, None], uv, 0).astype(int).T
    there = other.z_depth[row, column]
    asked = visible & other.usable[row, column] & ~((there > 0) & (z > (1 + _NEARER) * there))
    mine = colors.at(np.tile(rays.row * view.camera.width + rays.column, count))
    off = mine.distance(exactly(other.rgb[row, column] * pair.gains))
    same, different = ((asked & part).reshape(count, n)[:-1] for part in (off < pair.limit / 2, off > pair.limit))
    return same, different, apart[:-1]


def _summed(values: Float[np.ndarray, " n"], rays: _Rays, shape: tuple[int, ...]) -> Float[np.ndarray, "h w"]:
    """The sum of the tried pixels' values in the window around every pixel."""
    import cv2

    image = np.zeros(shape, np.float32)
    image[rays.row, rays.column] = values
    return cv2.boxFilter(image, -1, (_WINDOW, _WINDOW), normalize=False, borderType=cv2.BORDER_CONSTANT)
