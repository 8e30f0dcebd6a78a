"""Images of linear light or of a camera's log curve -> values as all stages expect them: sRGB's curve of linear light.

    stored = srgb(min(1, 2^stops light)),   light = curve^-1(value)

A fit in linear light (`MediumFit.encoding` "linear") undoes sRGB's curve exactly, so that it sees the sensor's light.
The curves are those that the makers publish, from values 0..1 to light, of which 1 is a white surface:

    gopro-log   (113^v - 1) / 112
    s-log3      10^((1023 v - 420) / 261.5) 0.19 - 0.01 from v = 171.2103 / 1023 on, below a line through v = 95 / 1023
    v-log       10^((v - 0.598206) / 0.241514) - 0.00873 from v = 0.181 on, below (v - 0.125) / 5.6
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import lru_cache
from pathlib import Path

import numpy as np
import torch
from jaxtyping import Float, UInt8, UInt16

from swimm3r.errors import InputError, UsageError
from swimm3r.io import images
from swimm3r.io.image_header import ImageHeader, read_header
from swimm3r.io.images import Rgb
from swimm3r.io.raw import Multipliers, is_raw, multipliers_of, read_raw, read_raw_header
from swimm3r.medium import srgb_from_linear
from swimm3r.scene.settings import FrameSettings, Transfer

_SATURATED = 65535


@dataclass(frozen=True)
class Development:
    """The way in which the images of a dive are brought to sRGB's curve."""

    transfer: Transfer  # of images and videos
    stops: float
    balance: Multipliers | None = None  # of raw files

    @property
    def changes(self) -> bool:
        """Return whether images and videos are changed at all; raw files always are."""
        return self.transfer != "srgb"

    def __str__(self) -> str:
        source = f"raw, linear, {self.balance}" if self.balance is not None else self.transfer
        return f"{source}, {self.stops:+g} stops, stored by sRGB's curve"


def development_of(settings: FrameSettings, files: Sequence[Path] = ()) -> Development:
    """The development that settings ask for; the first of a dive's raw `files` that can be read states its balance.

    Raises InputError where none of them can, UsageError where settings and files do not go together.
    """
    raw = bool(files) and is_raw(files[0])
    if raw and settings.transfer not in ("srgb", "linear"):
        raise UsageError(
            f"--transfer {settings.transfer} is given for camera raw files, whose values are linear",
            cause="the option is for images and videos that a camera stored by a log curve",
            hint="leave out --transfer",
        )
    if settings.stops and not raw and settings.transfer == "srgb":
        raise UsageError(
            f"--stops {settings.stops:g} is given, and the values are not linear",
            cause="exposure is added where raw files, linear or log images are developed; others stay as stored",
            hint="--transfer linear, or the curve of the camera; or leave out --stops",
        )
    return Development(settings.transfer, settings.stops, _balance(files, settings) if raw else None)


def _balance(files: Sequence[Path], settings: FrameSettings) -> Multipliers:
    """The white balance of the first file that can be read; the error of the last one where none can."""
    for number, path in enumerate(files, 1):
        try:
            return multipliers_of(path, settings.raw_balance)
        except InputError:
            if number == len(files):
                raise
    raise ValueError("raw files were expected, got none")


def header_of(path: Path, development: Development) -> ImageHeader:
    """The header of an image or a raw file; `plain` only where its values are used as they are."""
    header = read_raw_header(path) if is_raw(path) else read_header(path)
    return header if not development.changes else replace(header, plain=False)


def read_developed(path: Path, development: Development) -> Rgb:
    """An image as all stages expect it. Raises InputError where it cannot be read."""
    if development.balance is not None:
        return _curve("linear", development.stops, 16)[read_raw(path, development.balance)]
    return developed(images.read_rgb(path), development)


def developed(image: Rgb, development: Development) -> Rgb:
    """The values of an image or a frame of a video by sRGB's curve, 16 bits where they change."""
    if not development.changes:
        return image
    return _curve(development.transfer, development.stops, 8 * image.itemsize)[image]


def developed_gray(gray: UInt8[np.ndarray, "h w"], development: Development) -> UInt8[np.ndarray, "h w"]:
    """Gray values of a frame by sRGB's curve, 8 bits as they came."""
    return (_curve(development.transfer, development.stops, 8)[gray] >> 8).astype(np.uint8)


def light_of(values: Float[np.ndarray, "*n"], transfer: Transfer) -> Float[np.ndarray, "*n"]:
    """Light of values 0..1 by a camera's curve; below black it is 0."""
    match transfer:
        case "linear":
            light = values
        case "gopro-log":
            light = (113.0**values - 1) / 112
        case "s-log3":
            code, knee = 1023 * values, 171.2102946929
            line = (code - 95) * 0.01125 / (knee - 95)
            light = np.where(code < knee, line, 10 ** ((code - 420) / 261.5) * 0.19 - 0.01)
        case "v-log":
            line = (values - 0.125) / 5.6
            light = np.where(values < 0.181, line, 10 ** ((values - 0.598206) / 0.241514) - 0.00873)
        case "srgb":
            raise ValueError("values by sRGB's curve are not developed")
    return np.maximum(light, 0.0)


@lru_cache(maxsize=4)
def _curve(transfer: Transfer, stops: float, bits: int) -> UInt16[np.ndarray, " n"]:
    """The stored value of every value that an image can have."""
    light = light_of(np.arange(1 << bits) / ((1 << bits) - 1), transfer) * 2.0**stops
    gray = torch.from_numpy(np.minimum(light, 1.0))[:, None].expand(-1, 3)
    return (srgb_from_linear(gray)[:, 0].numpy() * _SATURATED + 0.5).astype(np.uint16)
