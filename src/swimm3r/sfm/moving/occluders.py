"""Moving objects: pixels that hide surfaces which other frames measured there, and are no measured surface themselves.

A point X of frame s, at a depth that other frames confirmed, lies at pixel x of frame t. Unless t has a measured
surface nearer than X, it must show X there, in the color that it has in s (`comparison`). Where most of the frames that
measured a surface disagree, t shows something else: an object that was elsewhere when they were taken, or one at rest
of another depth, which was not measured. The latter is seen along epipolar lines (`parallax`) and left out. The rest,
and the pixels where frames agree, say by their colors (GrabCut; Rother et al. 2004) where the object ends in between.
"""

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
_REACH = 0.15  # of the longer side, how far an object may extend beyond pixels that other frames decide
_ROUNDS = 3  # of GrabCut
_SPECK = 0.001  # of the image; smaller objects are noise
_DECIDED = 0.25  # share of an object's pixels that other frames must decide; else it is only these


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


def moving_pixels(view: SmallView, layers: Sequence[Layer]) -> Bool[np.ndarray, "h w"]:
    """The pixels of a frame that show moving objects, by the layers of other frames."""
    rgb, colors = view.rgb.reshape(-1, 3), color_range(view.rgb)
    pairs = [compared(rgb[layer.pixel], colors.at(layer.pixel), layer.rgb) for layer in layers]
    votes = votes_on(view, layers, pairs)
    decided = (votes.same + votes.different >= _FRAMES) & (votes.share_same < _SAME) & view.usable
    decided = _opened(decided)
    if decided.any():
        others = [layer.view for layer in layers]
        at_rest = explained(view, others, pairs, decided, measured_range(decided.shape, layers))
        decided = _opened(decided & ~at_rest)
    if not decided.any():
        return decided
    still = _eroded((votes.share_same >= _STILL) & (votes.same >= _FRAMES))
    return _objects(view.rgb, decided, still) & view.usable


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


def _objects(
    rgb: Float[np.ndarray, "h w 3"], decided: Bool[np.ndarray, "h w"], still: Bool[np.ndarray, "h w"]
) -> Bool[np.ndarray, "h w"]:
    """The objects that the decided pixels belong to, up to their edges."""
    import cv2

    reach = round(_REACH * max(decided.shape))
    near = cv2.distanceTransform((~decided).astype(np.uint8), cv2.DIST_L2, 3) <= reach
    label = np.where(near & ~still, cv2.GC_PR_FGD, cv2.GC_BGD).astype(np.uint8)
    label[decided] = cv2.GC_FGD
    rows, columns = _box(near)
    cut = np.ascontiguousarray(label[rows, columns])
    if (cut == cv2.GC_BGD).any():  # else there is nothing that the object could end at
        ground, moving = np.zeros((1, 65)), np.zeros((1, 65))  # GrabCut's models of their colors
        cv2.setRNGSeed(0)
        cv2.grabCut(_eight_bits(rgb[rows, columns]), cut, (0, 0, 0, 0), ground, moving, _ROUNDS, cv2.GC_INIT_WITH_MASK)
    region = np.zeros(decided.shape, np.uint8)
    region[rows, columns] = (cut == cv2.GC_FGD) | (cut == cv2.GC_PR_FGD)
    region = cv2.morphologyEx(region, cv2.MORPH_CLOSE, np.ones((5, 5), np.uint8))
    count, labels = cv2.connectedComponents(region)
    part_of = labels.astype(np.int64)
    sizes = np.bincount(part_of.reshape(-1), minlength=count)
    by_votes = np.bincount(part_of[decided], minlength=count)
    whole = by_votes >= _DECIDED * sizes
    kept = np.where(whole, sizes, by_votes) >= _SPECK * decided.size
    kept[0] = False
    return kept[part_of] & (whole[part_of] | decided)


def _box(mask: Bool[np.ndarray, "h w"]) -> tuple[slice, slice]:
    """Rows and columns that hold every true pixel, and one more on each side."""
    spans = (np.flatnonzero(mask.any(axis)) for axis in (1, 0))
    rows, columns = (slice(max(0, int(at[0]) - 1), int(at[-1]) + 2) for at in spans)
    return rows, columns


def _eight_bits(rgb: Float[np.ndarray, "h w 3"]) -> UInt8[np.ndarray, "h w 3"]:
    return np.ascontiguousarray((rgb.clip(0, 1) * 255).round().astype(np.uint8))


def _opened(mask: Bool[np.ndarray, "h w"]) -> Bool[np.ndarray, "h w"]:
    import cv2

    return cv2.morphologyEx(mask.astype(np.uint8), cv2.MORPH_OPEN, np.ones((3, 3), np.uint8)) > 0


def _eroded(mask: Bool[np.ndarray, "h w"]) -> Bool[np.ndarray, "h w"]:
    import cv2

    return cv2.erode(mask.astype(np.uint8), np.ones((3, 3), np.uint8)) > 0
