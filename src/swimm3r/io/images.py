"""Images and masks on disk <-> arrays, without losing bits on the way.

Arrays are [h, w, 3] RGB, upright (the EXIF orientation is applied), in the depth of the file: uint8 or uint16. OpenCV
and tifffile decode, for Pillow turns 16-bit color into 8 bits without a word.
"""

import base64
import io
from pathlib import Path
from typing import Any

import numpy as np
import tifffile
from jaxtyping import Bool, Float, UInt8, UInt16

from swimm3r.io.files.atomic import atomic_path
from swimm3r.io.image_header import (
    DAMAGED,
    TRANSPOSED,
    ImageHeader,
    header_in,
    read_header,
    tiff_orientation,
    too_large_for_memory,
    unreadable,
    verify_checksums,
)

SUFFIXES = (".jpg", ".jpeg", ".png", ".tif", ".tiff", ".bmp", ".webp")  # what a folder is searched for

Rgb = UInt8[np.ndarray, "h w 3"] | UInt16[np.ndarray, "h w 3"]

_OTHER_COLORS = (  # of TIFF: CMYK, YCbCr and L*a*b*, which OpenCV turns into RGB or refuses
    tifffile.PHOTOMETRIC.SEPARATED,
    tifffile.PHOTOMETRIC.YCBCR,
    tifffile.PHOTOMETRIC.CIELAB,
    tifffile.PHOTOMETRIC.ICCLAB,
    tifffile.PHOTOMETRIC.ITULAB,
)
_NEEDS_NO_CODEC = (1, 8, 32773, 32946)  # TIFF compressions that tifffile undoes alone: none, deflate, packbits, deflate


def read_rgb(path: Path) -> Rgb:
    """An image as stored; gray becomes three equal channels, an alpha channel is dropped.

    Float TIFF becomes uint16. Its scale is told from the largest value: up to 2 the image is 0..1, up to 256 it is
    0..255, up to 65536 it is 0..65535; what exceeds the scale is clipped. Raises InputError on a file that is damaged.
    """
    return _three_channels(_upright(*_decode(path)), path)


def decode_rgb(data: bytes, place: Path) -> Rgb:
    """As `read_rgb`, of the bytes of an image file within another file; errors name its `place`."""
    header = header_in(io.BytesIO(data), len(data), place)
    return _three_channels(_upright(*_decode_bytes(data, header, place)), place)


def read_mask(path: Path) -> Bool[np.ndarray, "h w"]:
    """True where the mask is not zero: there the frame may be used. Raises InputError."""
    stored = _upright(*_decode(path))
    if stored.ndim == 2:
        return stored != 0
    colors = stored.shape[2] - (stored.shape[2] in (2, 4))  # alpha says nothing about use
    return (stored[..., :colors] != 0).any(axis=2)


def image_size(path: Path) -> tuple[int, int]:
    """Width and height of the upright image in pixels, from its header alone. Raises InputError."""
    return read_header(path).size


def write_rgb(path: Path, image: Rgb | Float[np.ndarray, "h w 3"]) -> None:
    """Write a PNG, whole or not at all: 8 or 16 bits as given, 8 bits from floats 0..1 (clipped).

    Raises ValueError on another suffix and OSError where the disk refuses.
    """
    if image.dtype.kind == "f":
        image = (np.clip(image, 0, 1) * 255 + 0.5).astype(np.uint8)
    _write_png(path, np.ascontiguousarray(image[..., ::-1]))


def write_rgb_16(path: Path, image: Float[np.ndarray, "h w 3"]) -> None:
    """Write values 0..1 (clipped) as a PNG of 16 bits, whole or not at all."""
    write_rgb(path, (np.clip(image, 0, 1) * 65535 + 0.5).astype(np.uint16))


def write_mask(path: Path, usable: Bool[np.ndarray, "h w"]) -> None:
    """Write a mask as a PNG of 255 where the frame may be used and 0 elsewhere, whole or not at all."""
    _write_png(path, usable.astype(np.uint8) * 255)


def write_levels(path: Path, levels: UInt16[np.ndarray, "h w"]) -> None:
    """Write one number of 16 bits per pixel as a gray PNG, whole or not at all."""
    _write_png(path, levels)


def jpeg_uri(image: UInt8[np.ndarray, "h w 3"], long_side: int = 640, quality: int = 88) -> str:
    """A data URI for a page: a JPEG of the image, scaled down to at most `long_side` pixels."""
    import cv2

    height, width = image.shape[:2]
    scale = min(1.0, long_side / max(height, width))
    size = (max(1, round(width * scale)), max(1, round(height * scale)))
    small = cv2.resize(np.ascontiguousarray(image), size, interpolation=cv2.INTER_AREA)
    encoded = cv2.imencode(".jpg", small[..., ::-1], [cv2.IMWRITE_JPEG_QUALITY, quality])[1]
    return "data:image/jpeg;base64," + base64.b64encode(encoded.tobytes()).decode()


def _write_png(path: Path, stored: np.ndarray) -> None:
    import cv2

    if path.suffix.lower() != ".png":
        raise ValueError(f"images are written as PNG, so a name ending in .png was expected, got {path.name}")
    encoded = cv2.imencode(".png", stored)[1]
    with atomic_path(path) as draft:
        draft.write_bytes(encoded.tobytes())  # cv2.imwrite would hide a full disk


def _decode(path: Path) -> tuple[np.ndarray, int]:
    """[h, w] or [h, w, channels] in RGB(A) order, not yet upright, and the orientation still to be applied."""
    header = read_header(path)
    try:
        data = path.read_bytes()
    except OSError as error:
        raise unreadable(path, error) from error
    except MemoryError as error:
        raise too_large_for_memory(path, header.size, header.decoding_bytes) from error
    return _decode_bytes(data, header, path)


def _decode_bytes(data: bytes, header: ImageHeader, path: Path) -> tuple[np.ndarray, int]:
    try:
        if header.kind == "TIFF":
            return _decode_tiff(data)
        if header.kind == "PNG":
            verify_checksums(data)  # libpng hands out what it has of a damaged file
        if header.kind == "JPEG" and data.rfind(b"\xff\xd9") < data.rfind(b"\xff\xda"):
            raise ValueError("the file ends inside its image")  # libjpeg paints the rest gray
        return _opencv(data), header.orientation
    except DAMAGED as error:
        raise unreadable(path, error) from error
    except MemoryError as error:
        raise too_large_for_memory(path, header.size, header.decoding_bytes) from error


def _decode_tiff(data: bytes) -> tuple[np.ndarray, int]:
    with tifffile.TiffFile(io.BytesIO(data)) as tiff:
        page: Any = tiff.pages[0]
        orientation = tiff_orientation(page)
        if page.compression not in _NEEDS_NO_CODEC or page.photometric in _OTHER_COLORS:
            return _opencv(data), 1  # LZW, JPEG, CMYK ...; OpenCV turns TIFF upright itself, whatever the flags
        stored = page.asarray()
        if page.axes.startswith("S"):  # one plane per channel
            stored = np.moveaxis(stored, 0, -1)
        if page.photometric == tifffile.PHOTOMETRIC.PALETTE:
            stored = page.colormap[:, stored].transpose(1, 2, 0)
        if page.photometric == tifffile.PHOTOMETRIC.MINISWHITE:
            stored = ~stored
        return stored, orientation


def _opencv(data: bytes) -> np.ndarray:
    import cv2

    try:
        stored = cv2.imdecode(np.frombuffer(data, np.uint8), cv2.IMREAD_UNCHANGED)
    except cv2.error as error:  # its own limit of 2^30 pixels, or memory
        raise ValueError(f"its contents do not decode ({error.err})") from error
    if stored is None:
        raise ValueError("its contents do not decode")
    if stored.ndim == 3 and stored.shape[2] >= 3:
        stored = stored[..., [2, 1, 0, 3][: stored.shape[2]]]
    return stored


def _upright(stored: np.ndarray, orientation: int) -> np.ndarray:
    """Undo the camera's rotation: EXIF 2.3, tag 274."""
    if orientation in TRANSPOSED:
        stored = stored.swapaxes(0, 1)
    if orientation in (3, 4, 7, 8):
        stored = stored[::-1]
    if orientation in (2, 3, 6, 7):
        stored = stored[:, ::-1]
    return stored


def _three_channels(stored: np.ndarray, path: Path) -> np.ndarray:
    if stored.dtype == bool:
        stored = stored.astype(np.uint8) * 255
    if stored.dtype.kind == "f":
        stored = _quantized(stored, path)
    if stored.dtype not in (np.uint8, np.uint16):
        raise unreadable(path, f"its values are {stored.dtype}; 8 or 16 bits without sign, or floats, were expected")
    if stored.ndim == 2:
        stored = stored[..., None]
    if stored.ndim != 3 or not 1 <= stored.shape[2] <= 4:
        raise unreadable(path, f"its array is {stored.shape}; one to four channels were expected")
    colors = stored[..., :3] if stored.shape[2] >= 3 else stored[..., [0, 0, 0]]
    return np.ascontiguousarray(colors)


def _quantized(stored: np.ndarray, path: Path) -> np.ndarray:
    if not np.isfinite(stored).all():
        raise unreadable(path, "it holds values that are not finite")
    scale = next((full for limit, full in ((2, 1), (256, 255), (65536, 65535)) if stored.max() <= limit), None)
    if scale is None:
        raise unreadable(path, f"its largest value is {stored.max():g}; a scale of 1, 255 or 65535 was expected")
    return (np.clip(stored.astype(np.float64) / scale, 0, 1) * 65535 + 0.5).astype(np.uint16)
