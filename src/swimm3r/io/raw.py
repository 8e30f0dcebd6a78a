"""Camera raw files: the sensor's values as linear light, by LibRaw through rawpy (MIT; extra raw).

Pixels are demosaiced, balanced by multipliers of red, green and blue, and brought to the primaries of sRGB by the
camera's matrix; no tone curve, no automatic brightness. 1 is the value at which the sensor saturates.
"""

from dataclasses import dataclass
from importlib import import_module
from pathlib import Path
from typing import Any, Literal

import numpy as np
from jaxtyping import UInt16

from swimm3r.errors import DeviceError, InputError
from swimm3r.io.files.damage import first_line
from swimm3r.io.files.regular_file import require_regular_file
from swimm3r.io.image_header import ImageHeader

RAW_SUFFIXES = (".dng", ".nef", ".nrw", ".cr2", ".cr3", ".arw", ".orf", ".rw2", ".raf", ".pef", ".srw", ".gpr")
"""Suffixes of raw files that are searched for in a folder; LibRaw tells which it can read."""

RawBalance = Literal["daylight", "camera", "none"]

_COPIES = 4  # of 16-bit RGB while LibRaw develops
_TURNED = (5, 6)  # LibRaw's flips that swap width and height


@dataclass(frozen=True)
class Multipliers:
    """The white balance that all raw files of a dive are developed with."""

    source: RawBalance
    red: float  # by green
    blue: float

    def __str__(self) -> str:
        return f"white balance {self.source} ({self.red:.3f}, 1, {self.blue:.3f})"


def is_raw(path: Path) -> bool:
    """Return whether a file is a camera raw file by its suffix."""
    return path.suffix.lower() in RAW_SUFFIXES


def read_raw_header(path: Path) -> ImageHeader:
    """The size of the developed image. Raises InputError where LibRaw cannot read the file, DeviceError without it."""
    with _opened(path) as raw:
        sizes = raw.sizes
        size = (sizes.height, sizes.width) if sizes.flip in _TURNED else (sizes.width, sizes.height)
    return ImageHeader("RAW", size, 1, plain=False, decoding_bytes=sizes.width * sizes.height * 6 * _COPIES)


def multipliers_of(path: Path, source: RawBalance) -> Multipliers:
    """The white balance of a raw file: the camera's own for daylight, that it was taken with, or none.

    Raises InputError where the file does not state it.
    """
    if source == "none":
        return Multipliers(source, 1.0, 1.0)
    with _opened(path) as raw:
        red, green, blue, *_ = raw.camera_whitebalance if source == "camera" else raw.daylight_whitebalance
    if not min(red, green, blue) > 0:
        raise InputError(
            f"{path} does not state the white balance {source}",
            cause="the program that wrote it left it out, or LibRaw does not know the camera",
            hint="--raw-balance with another choice: daylight, camera or none",
        )
    return Multipliers(source, red / green, blue / green)


def read_raw(path: Path, balance: Multipliers) -> UInt16[np.ndarray, "h w 3"]:
    """Linear light of an upright raw image, 65535 at saturation. Raises InputError where it cannot be developed."""
    rawpy = _rawpy()
    with _opened(path) as raw:
        try:
            return raw.postprocess(
                gamma=(1, 1),
                no_auto_bright=True,
                adjust_maximum_thr=0.0,
                output_bps=16,
                output_color=rawpy.ColorSpace.sRGB,
                user_wb=[balance.red, 1.0, balance.blue, 1.0],
            )
        except (rawpy.LibRawError, ValueError, MemoryError) as error:
            raise _unreadable(path, error) from error


def _opened(path: Path) -> Any:
    rawpy = _rawpy()
    require_regular_file(path, "a camera raw file")
    try:
        return rawpy.imread(str(path))
    except (rawpy.LibRawError, OSError) as error:
        raise _unreadable(path, error) from error


def _rawpy() -> Any:
    try:
        return import_module("rawpy")
    except ImportError as error:
        raise DeviceError(
            "camera raw files need rawpy, which is not installed",
            cause="the package that develops them comes with the extra raw",
            hint="pip install 'swimm3r[raw]'; or develop the files linearly to 16-bit TIFF, and --transfer linear",
        ) from error


def _unreadable(path: Path, error: Exception) -> InputError:
    why = error.args[0] if error.args else ""
    told = why.decode(errors="replace") if isinstance(why, bytes) else first_line(error)
    return InputError(
        f"{path} cannot be read as a camera raw file: {told}",
        cause="it is cut off or damaged, or of a camera or compression that LibRaw does not know (GoPro's GPR)",
        hint="copy it again; Adobe DNG Converter makes DNG files of most raw files, which are read",
    )
