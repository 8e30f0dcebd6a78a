"""Moving objects: pixels that hide surfaces which other frames measured there, and are no measured surface themselves.

A point X of frame s, at a depth that other frames confirmed, lies at pixel x of frame t. Unless t has a measured
surface nearer than X, it must show X there, so that

    d = |g I_s(X) - I_t(x)| <= max(0.06, 4 q)

with g the gains between the frames' channels, d that of the worst channel, and q the d that three quarters of the
pair's points keep. I_t(x) is the range of colors in 3 x 3 pixels, as x is known to a pixel. Where most of the frames
that measured a surface disagree, t shows something that was elsewhere when they were taken. These pixels, and those
where frames agree, say by their colors (GrabCut; Rother et al. 2004) where the object ends in between.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float, Int, UInt8

_USUAL = 0.75  # share of a pair's points, fewer than which move, whose differences are usual
_OFF = 4.0  # such differences beyond which colors differ
_LEAST = 0.06  # pixel value, differences that exposure, water and caustics may make
_DARK = 0.02  # pixel value below which ratios of colors are noise
_NEARER = 0.05  # share of a depth by which one surface is before another
_FRAMES = 2  # that must have measured a surface at a pixel
_SAME = 0.34  # share of these frames from which a pixel is what they measured
_STILL = 0.5  # share from which a pixel is surely what they measured
_REACH = 0.15  # of the longer side, how far an object may extend beyond pixels that other frames decide
_ROUNDS = 3  # of GrabCut
_SPECK = 0.001  # of the image; smaller objects are noise
_DECIDED = 0.25  # share of an object's pixels that other frames must decide; else it is only these


@dataclass(frozen=True)
class SmallView:
    """A small image of a frame with what is measured in it."""

    rgb: Float[np.ndarray, "h w 3"]
    z_depth: Float[np.ndarray, "h w"]  # confirmed by other frames; 0 where unknown
    usable: Bool[np.ndarray, "h w"]


@dataclass(frozen=True)
class Layer:
    """The surfaces that another frame measured, in the image of a frame: one row per pixel of it."""

    pixel: Int[np.ndarray, " n"]  # row-major index
    z_depth: Float[np.ndarray, " n"]  # in the frame
    rgb: Float[np.ndarray, "n 3"]  # as the other frame shows them


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
    votes = votes_on(view, layers)
    decided = (votes.same + votes.different >= _FRAMES) & (votes.share_same < _SAME) & view.usable
    decided = _opened(decided)
    if not decided.any():
        return decided
    still = _eroded((votes.share_same >= _STILL) & (votes.same >= _FRAMES))
    return _objects(view.rgb, decided, still) & view.usable


def votes_on(view: SmallView, layers: Sequence[Layer]) -> Votes:
    """Comparison of every pixel of a frame with the surfaces that other frames measured there."""
    import cv2

    around = np.ones((3, 3), np.uint8)
    low, high = (change(view.rgb, around).reshape(-1, 3) for change in (cv2.erode, cv2.dilate))
    mine, own_depth = view.rgb.reshape(-1, 3), view.z_depth.reshape(-1)
    same, different = np.zeros((2, own_depth.size), np.int32)
    for layer in layers:
        at = layer.pixel
        rgb = layer.rgb * _gains(layer.rgb, mine[at])
        off = np.maximum(0, np.maximum(low[at] - rgb, rgb - high[at])).max(1, initial=0)
        limit = max(_LEAST, _OFF * np.quantile(off, _USUAL)) if len(at) else _LEAST
        hidden = (own_depth[at] > 0) & (layer.z_depth > (1 + _NEARER) * own_depth[at])
        same[at[~hidden & (off < limit / 2)]] += 1
        different[at[~hidden & (off > limit)]] += 1
    return Votes(same.reshape(view.z_depth.shape), different.reshape(view.z_depth.shape))


def _gains(rgb: Float[np.ndarray, "n 3"], target: Float[np.ndarray, "n 3"]) -> Float[np.ndarray, "3"]:
    """Factors on the channels between two frames; they differ in exposure and white balance."""
    if not len(rgb):
        return np.ones(3)
    return np.exp(np.median(np.log(np.maximum(target, _DARK) / np.maximum(rgb, _DARK)), axis=0))


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
