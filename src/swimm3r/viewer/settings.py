"""Settings of the viewer: the address it serves, and the sizes and pace of its pictures."""

from dataclasses import dataclass
from typing import Annotated

from swimm3r.settings import LongSide, Range, Settings

Port = Annotated[int, Range(1, 65_535)]
Quality = Annotated[int, Range(1, 100)]  # of JPEG
PicturesPerSecond = Annotated[float, Range(0.5, 60)]


@dataclass(frozen=True)
class ViewerSettings(Settings):
    """Address, and size and pace of the pictures."""

    host: str = "127.0.0.1"
    """Network address to serve on: 127.0.0.1 for this computer alone, 0.0.0.0 for everyone who can reach it."""
    port: Port = 8080
    """Port to serve on; the next free one where it is taken."""
    moving_side: LongSide = 640
    """Longer side, in pixels, of the pictures while the camera moves; smaller where the computer is too slow."""
    full_side: LongSide = 1280
    """Longer side, in pixels, of the picture once the camera rests; at most that of the browser's window."""
    pictures_per_second: PicturesPerSecond = 8.0
    """Pictures per second to aim at while the camera moves; their size follows from it."""
    jpeg_quality: Quality = 80
    """Quality of the pictures sent while the camera moves; at rest it is 10 higher."""
