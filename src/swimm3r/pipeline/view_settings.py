"""The views that `swimm3r render` makes; torch-free."""

from dataclasses import dataclass
from pathlib import Path
from typing import Literal

from swimm3r.settings import ClipSecond, CountOrZero, LongSideOrOwn, Settings

PathName = Literal["frames", "dive", "orbit", "spiral"]


@dataclass(frozen=True)
class ViewSettings(Settings):
    """Cameras to render, and the form of the result."""

    path: PathName | Path = "frames"
    """Cameras: those of the training frames (frames), a smooth flight along them (dive), a circle that looks at the
    scene's middle (orbit), a spiral towards it (spiral), or a file: a cameras.json, such as the viewer saves, or a CSV
    of poses."""
    count: CountOrZero = 0
    """Number of cameras along the path. 0 uses those of the frames or the file as they are, and 90 of a made path."""
    long_side: LongSideOrOwn = 0
    """Longer side of the images in pixels, at most the cameras' own; 0 uses the cameras' own."""
    video: Literal["no", "too", "only"] = "no"
    """Write OUT/flythrough.mp4 along the path: beside the images (too), in their place (only), or not (no)."""
    time: ClipSecond | None = None
    """Second of the clip at which a dynamic map is rendered; by default each camera's own, or the clip from its start
    to its end along a made path."""
