"""Which frames of a dive are used, and at what size; torch-free, so that --help is instant."""

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Literal

from swimm3r.errors import UsageError
from swimm3r.settings import ClipSecond, CountOrZero, LongSideOrOwn, Range, Settings


@dataclass(frozen=True)
class FrameSettings(Settings):
    """Sampling of a video, and checks of a folder of images, by `swimm3r.read_frames`."""

    fps: Annotated[float, Range(0, 1000)] = 5.0
    """Frames per second taken from a video; 0 takes every frame. Of stills every one is taken."""
    pick: Literal["sharpest", "uniform"] = "sharpest"
    """The frame taken of each 1/fps: the sharpest, or the first (at 30 fps the paper's every 6th)."""
    start: ClipSecond = 0.0
    """Second of the video to begin at: leaves out the descent."""
    end: ClipSecond | None = None
    """Second of the video to stop at; its end where none is given."""
    max_frames: CountOrZero = 0
    """Most frames, spread evenly over the dive; 0 is no limit."""
    long_side: LongSideOrOwn = 1600
    """Larger images are scaled down to this many pixels along their longer side; 0 keeps them as they are."""
    masks: Path | None = None
    """Folder of masks NAME.png, NAME.jpg.png or NAME_mask.png (0 = leave out); else masks/ in the input, if any."""
    odd_sizes: Literal["refuse", "skip"] = "refuse"
    """What is done about stills of another size than most."""

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.end is not None and not self.end > self.start:
            raise UsageError(
                f"end ({self.end} s) is not after start ({self.start} s)",
                cause="the two are swapped, or given in other units than seconds",
                hint="an end beyond the start, in seconds of the video",
            )
