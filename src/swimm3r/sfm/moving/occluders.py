"""Pixels that surely move: they hide surfaces that other frames measured there, and are no measured surface themselves.

A point X of frame s, at a depth that other frames confirmed, lies at pixel x of frame t. Unless t has a measured
surface nearer than X, it must show X there, in the color that it has in s (`comparison`). Where most of the frames that
measured a surface disagree, t shows something else: an object that was elsewhere when they were taken, or one at rest
of another depth, which was not measured. The latter is seen along epipolar lines (`parallax`) and left out. How far
the objects reach between these pixels is found by their colors (`objects`).
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float, Int, UInt8

from swimm3r.sfm.moving.comparison import Pair, SmallView, color_range, compared, exactly
from swimm3r.sfm.moving.parallax import MeasuredRange, explained

_NEARER = 0.05  # share of a depth by which one surface is before another
_FRAMES = 2  # that must have measured a surface at a pixel
_SAME = 0.34  # share of these frames from which a pixel is what they measured
_STILL = 0.5  # share from which a pixel is surely what they measured


@dataclass(frozen=True)
class Layer:
    """The surfaces that another frame measured, in the image of a frame: one row per pixel of it."""

    view: SmallView  # the other frame
    at: Int[np.ndarray, " n"]  # row-major index of the pixel that shows the surface there
    pixel: Int[np.ndarray, " n"]  # row-major index in the frame
    z_depth: Float[np.ndarray, " n"]  # in the frame

    @property
    def rgb(self) -> Float[np.ndarray, "n 3"]:
        """Colors of the surfaces as the other frame shows them."""
        return self.view.rgb.reshape(-1, 3)[self.at]


@dataclass(frozen=True)
class Votes:
    """Numbers of other frames that measured a surface at each pixel, by whether the pixel shows it."""

    same: Int[np.ndarray, "h w"]
    different: Int[np.ndarray, "h w"]

    @property
    def share_same(self) -> Float[np.ndarray, "h w"]:
        """Share of the frames whose surface the pixel shows; 0 without any."""
        return self.same / np.maximum(self.same + self.different, 1)


@dataclass(frozen=True)
class Evidence:
    """Pixels of a frame on which other frames decide."""

    moving: Bool[np.ndarray, "h w"]  # surely moving
    still: Bool[np.ndarray, "h w"]  # surely what the others measured

    def packed(self) -> "PackedEvidence":
        """The same in an eighth of the memory."""
        return PackedEvidence(self.moving.shape, np.packbits(self.moving), np.packbits(self.still))


@dataclass(frozen=True)
class PackedEvidence:
    """Evidence with eight pixels per byte, to be kept of many frames."""

    shape: tuple[int, ...]
    moving: UInt8[np.ndarray, " n"]
    still: UInt8[np.ndarray, " n"]

    def unpacked(self) -> Evidence:
        """The pixels."""
        count = math.prod(self.shape)
        pixels = (np.unpackbits(bits, count=count).reshape(self.shape) > 0 for bits in (self.moving, self.still))
        return Evidence(*pixels)


def evidence_on(view: SmallView, layers: Sequence[Layer]) -> Evidence:
    """The pixels of a frame on which the layers of other frames decide."""
    rgb, colors = view.rgb.reshape(-1, 3), color_range(view.rgb)
    pairs = [compared(rgb[layer.pixel], colors.at(layer.pixel), layer.rgb) for layer in layers]
    votes = votes_on(view, layers, pairs)
    still = _eroded((votes.share_same >= _STILL) & (votes.same >= _FRAMES))
    moving = _opened((votes.same + votes.different >= _FRAMES) & (votes.share_same < _SAME) & view.usable)
    if moving.any():
        others = [layer.view for layer in layers]
        at_rest = explained(view, others, pairs, moving, measured_range(moving.shape, layers))
        moving = _opened(moving & ~at_rest)
    return Evidence(moving, still)


def votes_on(view: SmallView, layers: Sequence[Layer], pairs: Sequence[Pair]) -> Votes:
    """Comparison of every pixel of a frame with the surfaces that other frames measured there."""
    colors, own_depth = color_range(view.rgb), view.z_depth.reshape(-1)
    same, different = np.zeros((2, own_depth.size), np.int32)
    for layer, pair in zip(layers, pairs, strict=True):
        at = layer.pixel
        mine, around = colors.at(at), color_range(layer.view.rgb).at(layer.at).times(pair.gains)
        hidden = (own_depth[at] > 0) & (layer.z_depth > (1 + _NEARER) * own_depth[at])
        same[at[~hidden & (mine.distance(exactly(layer.rgb * pair.gains)) < pair.limit / 2)]] += 1
        different[at[~hidden & (mine.distance(around) > pair.limit)]] += 1
    return Votes(same.reshape(view.z_depth.shape), different.reshape(view.z_depth.shape))


def measured_range(shape: tuple[int, ...], layers: Sequence[Layer]) -> MeasuredRange:
    """The depths of the surfaces that the layers hold at each pixel."""
    nearest, farthest = np.full(shape, np.inf, np.float32), np.zeros(shape, np.float32)
    for layer in layers:
        at = np.unravel_index(layer.pixel, shape)
        nearest[at] = np.minimum(nearest[at], layer.z_depth)
        farthest[at] = np.maximum(farthest[at], layer.z_depth)
    return MeasuredRange(np.where(np.isfinite(nearest), nearest, 0), farthest)


def _opened(mask: Bool[np.ndarray, "h w"]) -> Bool[np.ndarray, "h w"]:
    import cv2

    return cv2.morphologyEx(mask.astype(np.uint8), cv2.MORPH_OPEN, np.ones((3, 3), np.uint8)) > 0


def _eroded(mask: Bool[np.ndarray, "h w"]) -> Bool[np.ndarray, "h w"]:
    import cv2

    return cv2.erode(mask.astype(np.uint8), np.ones((3, 3), np.uint8)) > 0
