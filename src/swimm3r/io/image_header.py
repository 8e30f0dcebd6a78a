"""Headers of image files: format, size, orientation, capture time, and whether the promised pixels can be decoded.

Pillow refuses more than 179 million pixels as a decompression bomb, yet mosaics of a sea floor are larger. Here an
image is refused where its file is too small for the pixels that its header promises, or the free memory is.
"""

import io
import struct
import zlib
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from datetime import datetime
from pathlib import Path
from typing import Any

import tifffile
from PIL import BmpImagePlugin, Image, ImageFile, JpegImagePlugin, PngImagePlugin, TiffImagePlugin, WebPImagePlugin

from swimm3r import memory
from swimm3r.errors import InputError
from swimm3r.io.files.regular_file import require_regular_file

DAMAGED = (OSError, ValueError, IndexError, KeyError, SyntaxError, struct.error, zlib.error, tifffile.TiffFileError)
TRANSPOSED = (5, 6, 7, 8)  # orientations that swap width and height
TIFF_MAGIC = (b"II*\x00", b"MM\x00*", b"II+\x00", b"MM\x00+")

_ORIENTATION = 274  # the tag's number in EXIF and in TIFF
_TAKEN, _FRACTION, _EXIF = 36867, 37521, 0x8769  # DateTimeOriginal, SubSecTimeOriginal and the IFD they stand in
_PIXELS_PER_BYTE = 8 * 1032  # Deflate packs at most 1032 bytes into one, and a pixel takes at least a bit
_COPIES = 3  # as decoded, in RGB order, upright


class ImageSizeError(InputError):
    """An image whose file cannot hold its pixels, or whose pixels the memory cannot hold."""


@dataclass(frozen=True)
class ImageHeader:
    """The header of one image file."""

    kind: str  # JPEG, PNG, WEBP, BMP or TIFF
    size: tuple[int, int]  # width and height of the upright image
    orientation: int  # still to be applied, EXIF 2.3, tag 274
    plain: bool  # every reader sees the same in it: JPEG or PNG, upright, RGB or gray, nothing transparent
    decoding_bytes: int  # memory that decoding takes


def read_header(path: Path) -> ImageHeader:
    """The header of an image file. Raises InputError where it is damaged, ImageSizeError where it cannot be decoded."""
    try:
        require_regular_file(path, "an image")
        with path.open("rb") as file:
            return header_in(file, path.stat().st_size, path)
    except DAMAGED as error:
        raise unreadable(path, error) from error


def header_in(file: io.BufferedReader | io.BytesIO, byte_count: int, path: Path) -> ImageHeader:
    """As `read_header`, of an open file or of bytes; `path` is the place that errors name."""
    try:
        header = _tiff_header(file) if file.read(4) in TIFF_MAGIC else _pillow_header(file)
    except DAMAGED as error:
        raise unreadable(path, error) from error
    _check_size(header, path, byte_count)
    return header


def capture_time(path: Path) -> float | None:
    """Seconds on the camera's clock (EXIF DateTimeOriginal with its fraction); None where the file does not tell."""
    exif = exif_ifd(path, _EXIF)
    try:
        taken = datetime.strptime(str(exif[_TAKEN]).strip("\x00 "), "%Y:%m:%d %H:%M:%S")
    except (KeyError, ValueError):
        return None
    digits = str(exif.get(_FRACTION, "")).strip("\x00 ")
    return (taken - datetime(1970, 1, 1)).total_seconds() + (float(f"0.{digits}") if digits.isdigit() else 0.0)


def exif_ifd(path: Path, number: int) -> dict[int, Any]:
    """The tags of a part of an image's EXIF block, by their numbers; none where the file has none, or is damaged."""
    try:
        with path.open("rb") as file, _opened(file) as image:
            return dict(Image.Image.getexif(image).get_ifd(number))  # PngImageFile's own decodes the image
    except (*DAMAGED, Image.DecompressionBombError):
        return {}


def verify_checksums(png: bytes) -> None:
    """Raise what damaged files cause where a PNG's checksums do not hold."""
    PngImagePlugin.PngImageFile(io.BytesIO(png)).verify()


def tiff_orientation(page: Any) -> int:
    """The orientation that a page of a TIFF states."""
    return int(page.tags[_ORIENTATION].value) if _ORIENTATION in page.tags else 1


def unreadable(path: Path, why: object) -> InputError:
    """The error of a file that is no image."""
    return InputError(
        f"{path} cannot be read as an image: {why}",
        cause="the file is missing, damaged, cut off or of another format",
        hint="open it in an image viewer; copy it again, or save it as PNG, JPEG or TIFF",
    )


def too_large_for_memory(path: Path, size: tuple[int, int], needed: int) -> ImageSizeError:
    """The error of an image that does not fit the memory."""
    free = memory.available_mb()
    return ImageSizeError(
        f"{path} has {size[0]}x{size[1]} pixels, and decoding them takes {needed / 1e9:.1f} GB of memory"
        + ("" if free is None else f", of which {free / 1e3:.1f} GB are free"),
        cause="a mosaic larger than this computer's memory, or a file made to exhaust it",
        hint="scale the image down first, close other programs, or take it out of the folder",
    )


def _check_size(header: ImageHeader, path: Path, file_bytes: int) -> None:
    width, height = header.size
    if width * height > _PIXELS_PER_BYTE * file_bytes:
        raise ImageSizeError(
            f"{path} has {width}x{height} pixels by its header, more than its {file_bytes:,} bytes can hold",
            cause="the file is damaged, or made to exhaust the memory (a decompression bomb)",
            hint="copy it again if the original is whole, else take it out of the folder",
        )
    free = memory.available_mb()
    if free is not None and header.decoding_bytes > free * memory.MB:
        raise too_large_for_memory(path, header.size, header.decoding_bytes)


def _tiff_header(file: io.BufferedReader | io.BytesIO) -> ImageHeader:
    file.seek(0)
    with tifffile.TiffFile(file) as tiff:
        page: Any = tiff.pages[0]
        size, orientation = (page.imagewidth, page.imagelength), tiff_orientation(page)
        sample_bytes = max(1, page.bitspersample // 8)
    return _header("TIFF", size, orientation, False, sample_bytes)


def _pillow_header(file: io.BufferedReader | io.BytesIO) -> ImageHeader:
    try:
        with _opened(file) as image:
            orientation = Image.Image.getexif(image).get(_ORIENTATION, 1)  # PngImageFile's own decodes the image first
            same = image.mode in ("RGB", "L", "I;16") and "transparency" not in image.info
            kind = str(image.format)
            plain = same and kind in ("JPEG", "PNG") and orientation == 1
            sample_bytes = 2 if any("16" in str(tile) for tile in image.tile) else 1
            return _header(kind, image.size, orientation, plain, sample_bytes)
    except Image.DecompressionBombError as error:  # of WebP, whose plug-in has its own limit
        raise ValueError(f"WebP of that size is not supported ({error})") from error


def _header(kind: str, size: tuple[int, int], orientation: int, plain: bool, sample_bytes: int) -> ImageHeader:
    needed = size[0] * size[1] * 3 * sample_bytes * _COPIES
    upright = size[::-1] if orientation in TRANSPOSED else size
    return ImageHeader(kind, (upright[0], upright[1]), orientation, plain, needed)


@contextmanager
def _opened(file: io.BufferedReader | io.BytesIO) -> Iterator[ImageFile.ImageFile]:
    """An image of which only the header is read, by Pillow's plug-ins, which `Image.open` alone would limit in size."""
    file.seek(0)
    start = file.read(16)
    file.seek(0)
    if start.startswith(b"\x89PNG\r\n\x1a\n"):
        plugin = PngImagePlugin.PngImageFile
    elif start.startswith(b"\xff\xd8\xff"):
        plugin = JpegImagePlugin.JpegImageFile
    elif start.startswith(b"BM"):
        plugin = BmpImagePlugin.BmpImageFile
    elif start.startswith(b"RIFF") and start[8:12] == b"WEBP":
        plugin = WebPImagePlugin.WebPImageFile
    elif start[:4] in TIFF_MAGIC:
        plugin = TiffImagePlugin.TiffImageFile
    else:
        raise ValueError("it is of no known image format")
    with plugin(file) as image:
        yield image
