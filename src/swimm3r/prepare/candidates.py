"""Candidate images of a video or of a folder: their records, sharpness and size."""

from collections.abc import Sequence
from dataclasses import dataclass
from datetime import UTC, datetime
from pathlib import Path
from typing import TypeVar

import numpy as np
from jaxtyping import UInt8, UInt16

from swimm3r.io.files.safe_names import shown_name
from swimm3r.io.images import Rgb
from swimm3r.io.telemetry.gyroscope import Gyroscope
from swimm3r.scene.rig import Rig

STEP = "preparing frames"  # what progress calls it
GRAY_SIDE = 960  # pixels; sharpness is judged on a copy of this size, so that it compares across cameras
BLANK = 1.0  # standard deviation of an 8-bit gray copy below which a frame shows nothing: lens cap, fade, slate

Item = TypeVar("Item")


@dataclass(frozen=True)
class Taken:
    """An image of the input that is used."""

    path: Path
    time: float  # seconds since the first one; its number where images carry no time
    camera: str | None = None  # of a rig
    instant: int | None = None  # of a rig: its images of one instant were taken together


@dataclass(frozen=True)
class SourceImage:
    """An image already written into the draft folder."""

    name: str
    original: Path  # relative name by which its mask is looked up
    size: tuple[int, int]  # of the original, upright
    time: float
    sharpness: float
    gray: bool  # three equal channels
    camera: str | None = None  # of a rig
    instant: int | None = None  # of a rig
    up: tuple[float, float, float] | None = None  # away from the earth, x right, y down, z forward
    gains: tuple[float, float, float] | None = None  # of linear light, by the camera's record


@dataclass(frozen=True)
class SelectedImages:
    """The images in the draft folder, and the warnings about them."""

    images: list[SourceImage]
    ordered: bool
    warnings: list[str]
    mask_folders: list[Path]
    originals: list[Path]  # what a mask may belong to, frames left out included
    files: frozenset[Path] = frozenset()  # the originals of stills where they lie: no masks, whatever their names
    recorded: str | None = None  # begin of the recording, ISO 8601
    start_ns: int | None = None  # nanoseconds since 1970 at second 0, where the source stamps its images
    calibration: Path | None = None  # a calibration file in the draft folder
    rig: Rig | None = None
    development: str | None = None  # how values were brought to sRGB's curve; None where they are as stored
    gyroscope: Gyroscope | None = None
    timed: bool = True  # false where times are places in the order


def sharpness(gray: UInt8[np.ndarray, "h w"]) -> float:
    """Variance of the Laplacian (Pech-Pacheco et al. 2000); larger is sharper, comparable within one scene."""
    import cv2

    return float(cv2.Laplacian(gray, cv2.CV_16S).var(dtype=np.float64))


def small_gray(image: Rgb, side: int = GRAY_SIDE) -> UInt8[np.ndarray, "rows columns"]:
    """A gray copy of at most so many pixels along its longer side; by default the one on which sharpness is judged."""
    import cv2

    small = scaled_down(image, side)
    if small.dtype == np.uint16:
        small = (small >> 8).astype(np.uint8)
    return cv2.cvtColor(small, cv2.COLOR_RGB2GRAY)


def is_gray(image: Rgb) -> bool:
    """Return whether the three channels are equal, but for the rounding of JPEG and video in one pixel of a
    thousand."""
    small = scaled_down(image, GRAY_SIDE).astype(np.int32)
    spread = small.max(axis=2) - small.min(axis=2)
    rounding = 2 if image.dtype == np.uint8 else 2 * 257
    return float((spread <= rounding).mean()) >= 0.999


def scaled_down(
    image: Rgb, long_side: int
) -> UInt8[np.ndarray, "rows columns 3"] | UInt16[np.ndarray, "rows columns 3"]:
    """An image of at most `long_side` pixels along its longer side; 0 keeps it."""
    import cv2

    target = target_size((image.shape[1], image.shape[0]), long_side)
    if image.shape[1::-1] == target:
        return image
    return cv2.resize(image, target, interpolation=cv2.INTER_AREA)


def target_size(size: tuple[int, int], long_side: int) -> tuple[int, int]:
    """Width and height after scaling down; 0 keeps them."""
    scale = min(1.0, long_side / max(size)) if long_side else 1.0
    return max(1, round(size[0] * scale)), max(1, round(size[1] * scale))


def thinned(items: Sequence[Item], most: int) -> list[Item]:
    """At most so many, spread evenly, the first and the last among them."""
    if not most or len(items) <= most:
        return list(items)
    return [items[i] for i in np.linspace(0, len(items) - 1, most).round().astype(int)]


def recorded_on(seconds: float) -> str:
    """The date of a moment of the camera's clock, ISO 8601; its fraction counts, as times are counted from it."""
    return datetime.fromtimestamp(seconds, UTC).replace(tzinfo=None).isoformat()


def blank_warning(count: int, of: str) -> str:
    """The warning about frames without content."""
    return f"{count} {of} show nothing (black, or one even color) and were left out."


def some_names(paths: Sequence[Path], root: Path, most: int = 3) -> str:
    """The first names, and how many more."""
    names = [path.relative_to(root).as_posix() if path.is_relative_to(root) else path.name for path in paths[:most]]
    return ", ".join(map(shown_name, names)) + (f" and {len(paths) - most} more" if len(paths) > most else "")
