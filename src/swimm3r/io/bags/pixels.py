"""Pixels of image messages: sensor_msgs/Image in its encodings, and CompressedImage.

Values stay as they are stored, 8 or 16 bits; Bayer patterns are interpolated along edges. Gray becomes three equal
channels.
"""

from pathlib import Path
from typing import Any, Literal

import numpy as np

from swimm3r.io.images import Rgb, decode_rgb

_PLAIN = {  # type of a value, and the places of red, green and blue among the values of a pixel
    "mono8": ("u1", 1, (0, 0, 0)),
    "8UC1": ("u1", 1, (0, 0, 0)),
    "mono16": ("u2", 1, (0, 0, 0)),
    "rgb8": ("u1", 3, (0, 1, 2)),
    "rgba8": ("u1", 4, (0, 1, 2)),
    "bgr8": ("u1", 3, (2, 1, 0)),
    "bgra8": ("u1", 4, (2, 1, 0)),
    "8UC3": ("u1", 3, (2, 1, 0)),  # without a name for its order, OpenCV's
    "8UC4": ("u1", 4, (2, 1, 0)),
    "rgb16": ("u2", 3, (0, 1, 2)),
    "rgba16": ("u2", 4, (0, 1, 2)),
    "bgr16": ("u2", 3, (2, 1, 0)),
    "bgra16": ("u2", 4, (2, 1, 0)),
    "16UC3": ("u2", 3, (2, 1, 0)),
}
_BAYER = ("rggb", "bggr", "gbrg", "grbg")
_YUV = {"yuv422": "UYVY", "uyvy": "UYVY", "yuv422_yuy2": "YUY2", "yuyv": "YUY2"}


def is_camera_encoding(encoding: str) -> bool:
    """Return whether images of an encoding are those of a camera, and can be read: depth maps are not."""
    return encoding in _PLAIN or encoding in _YUV or _bayer(encoding) is not None


def is_camera_format(format: str) -> bool:
    """Return whether a CompressedImage of this format is a camera's image: depth maps and video streams are not."""
    words = format.lower()
    return not any(word in words for word in ("depth", "rvl", "h264", "h.264", "hevc", "av1", "16uc1", "32fc1"))


def image_of(message: Any) -> Rgb:
    """The pixels of an Image. Raises ValueError where its encoding, its size and its data do not go together."""
    width, height, step = int(message.width), int(message.height), int(message.step)
    encoding, data = str(message.encoding), np.asarray(message.data, np.uint8)
    kind, channels, _ = _PLAIN.get(encoding, ("u1", 2, ()) if encoding in _YUV else ("u1", 1, ()))
    pattern = _bayer(encoding)
    if pattern is not None:
        kind = "u2" if pattern[1] == 16 else "u1"
    elif not is_camera_encoding(encoding):
        raise ValueError(f"images of the encoding {encoding!r} are not read")
    row = width * channels * int(kind[1])
    if min(width, height) < 1 or step < row or len(data) < step * (height - 1) + row:
        raise ValueError(f"{width}x{height} pixels of {encoding} in rows of {step} bytes do not fit {len(data)} bytes")
    padded = np.zeros(step * height, np.uint8)
    padded[: min(len(data), step * height)] = data[: step * height]
    values = padded.reshape(height, step)[:, :row].copy().view(f"{'>' if message.is_bigendian else '<'}{kind}")
    pixels = values.astype(kind[0] + kind[1], copy=False).reshape(height, width, channels)
    if pattern is not None:
        return _demosaiced(pixels[..., 0], pattern[0])
    if encoding in _YUV:
        import cv2

        return cv2.cvtColor(pixels, getattr(cv2, f"COLOR_YUV2RGB_{_YUV[encoding]}"))
    return np.ascontiguousarray(pixels[..., _PLAIN[encoding][2]])


def compressed_image_of(message: Any, source: Path) -> Rgb:
    """The pixels of a CompressedImage: JPEG, PNG and what else files of images are. Raises InputError."""
    image = decode_rgb(bytes(message.data), source)
    pattern = _bayer(str(message.format).split(";")[0].strip())
    if pattern is not None and (image == image[..., :1]).all():  # of drivers that compress the sensor's values
        return _demosaiced(np.ascontiguousarray(image[..., 0]), pattern[0])
    return image


def _bayer(encoding: str) -> tuple[str, Literal[8, 16]] | None:
    """The pattern and the bits of bayer_rggb8 and its kin; None of other encodings."""
    for pattern in _BAYER:
        if encoding == f"bayer_{pattern}8":
            return pattern, 8
        if encoding == f"bayer_{pattern}16":
            return pattern, 16
    return None


def _demosaiced(values: np.ndarray, pattern: str) -> Rgb:
    import cv2

    return cv2.cvtColor(values, getattr(cv2, f"COLOR_Bayer{pattern.upper()}2RGB_EA"))
