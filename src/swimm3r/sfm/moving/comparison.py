"""Colors of small images of two frames, as far as they show the same.

A surface of color I_s in frame s has the color of pixel x in frame t if

    d(g I_s, I_t(x)) <= limit / 2,    and another one if d(g I_s', I_t(x)) > limit,    limit = max(0.06, 4 q)

with g the gains between the frames' channels, d the distance of the worst channel, and q the d that three quarters of
the surfaces keep that both frames should show. I_t(x) and I_s' are the ranges of colors in 3 x 3 pixels of either
frame, as places are known to a pixel.
"""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float, Int

from swimm3r.cameras import Cameras

_USUAL = 0.75  # share of a pair's points, fewer than which move, whose differences are usual
_OFF = 4.0  # such differences beyond which colors differ
_LEAST = 0.06  # pixel value, differences that exposure, water and caustics may make
_DARK = 0.02  # pixel value below which ratios of colors are noise


@dataclass(frozen=True)
class SmallView:
    """A small image of a frame with what is measured in it."""

    camera: Cameras  # one, of this image
    rgb: Float[np.ndarray, "h w 3"]
    z_depth: Float[np.ndarray, "h w"]  # confirmed by other frames; 0 where unknown
    usable: Bool[np.ndarray, "h w"]


@dataclass(frozen=True)
class ColorRange:
    """The least and the greatest value of each channel, one row per pixel."""

    low: Float[np.ndarray, "n 3"]
    high: Float[np.ndarray, "n 3"]

    def at(self, rows: Int[np.ndarray, " m"]) -> "ColorRange":
        """The ranges of some pixels."""
        return ColorRange(self.low[rows], self.high[rows])

    def times(self, gains: Float[np.ndarray, "3"]) -> "ColorRange":
        """The ranges under other gains of the channels."""
        return ColorRange(self.low * gains, self.high * gains)

    def distance(self, other: "ColorRange") -> Float[np.ndarray, " n"]:
        """Distance of these ranges from others, row by row, that of the worst channel; 0 where they overlap."""
        return np.maximum(0, np.maximum(self.low - other.high, other.low - self.high)).max(1, initial=0)


@dataclass(frozen=True)
class Pair:
    """Gains that bring the colors of another frame to those of a frame, and how far they may be off then."""

    gains: Float[np.ndarray, "3"]
    limit: float


def color_range(rgb: Float[np.ndarray, "h w 3"]) -> ColorRange:
    """The range of colors in 3 x 3 pixels around every pixel, in row-major order."""
    import cv2

    around = np.ones((3, 3), np.uint8)
    return ColorRange(*(change(rgb, around).reshape(-1, 3) for change in (cv2.erode, cv2.dilate)))


def exactly(rgb: Float[np.ndarray, "n 3"]) -> ColorRange:
    """The ranges that hold one color each."""
    return ColorRange(rgb, rgb)


def compared(rgb: Float[np.ndarray, "n 3"], colors: ColorRange, other: Float[np.ndarray, "n 3"]) -> Pair:
    """The comparison of a frame with another one by the colors of surfaces, with their ranges, in both."""
    if not len(rgb):
        return Pair(np.ones(3), _LEAST)
    gains = np.exp(np.median(np.log(np.maximum(rgb, _DARK) / np.maximum(other, _DARK)), axis=0))
    usual = float(np.quantile(colors.distance(exactly(other * gains)), _USUAL))
    return Pair(gains, max(_LEAST, _OFF * usual))
