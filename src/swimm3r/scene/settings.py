"""Selection and size of a dive's frames; torch-free, so that --help is instant."""

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Literal

from swimm3r.errors import UsageError
from swimm3r.settings import ClipSecond, CountOrZero, LongSideOrOwn, Range, Settings, Share

Transfer = Literal["srgb", "linear", "gopro-log", "s-log3", "v-log"]


@dataclass(frozen=True)
class FrameSettings(Settings):
    """Sampling of a video or a bag, and checks of a folder of images (`prepare.read_frames`)."""

    fps: Annotated[float, Range(0, 1000)] = 5.0
    """Frames per second taken from a video or a bag; 0 takes every frame. Folders of images are used completely."""
    pick: Literal["sharpest", "uniform"] = "sharpest"
    """Frame taken from each interval of 1/fps seconds: the sharpest, or the first."""
    start: ClipSecond = 0.0
    """Second of the video to start at, for example after the descent."""
    end: ClipSecond | None = None
    """Second of the video to stop at; by default its end."""
    max_frames: CountOrZero = 0
    """Largest number of frames, spread evenly over the dive; 0 sets no limit."""
    long_side: LongSideOrOwn = 1600
    """Longer side in pixels to which larger images are reduced; 0 keeps the original size."""
    keyframe_motion: Annotated[float, Range(0, 0.5)] = 0.04
    """Motion of the image between keyframes, as a share of its longer side. The frames between get poses only; 0 makes
    every frame a keyframe."""
    every_frame_to: CountOrZero = 100
    """Number of frames up to which every frame is a keyframe."""
    masks: Path | None = None
    """Folder of masks NAME.png, NAME.jpg.png or NAME_mask.png whose black pixels are ignored; by default masks/ in the
    input, if it exists."""
    topic: str | None = None
    """Topic of images of a ROS bag that holds several cameras; `swimm3r topics BAG` lists them."""
    stamps: Literal["header", "received"] = "header"
    """Times of a bag's images: those of their headers, or those at which they were recorded."""
    camera_info: bool = True
    """Start from the lens that a bag's camera_info states, where neither --calibration nor --focal gives another."""
    rig: tuple[str, ...] = ()
    """Cameras of a rig: names of sub-folders of SOURCE, topics of images of a ROS bag, `side-by-side` for a video that
    shows two views, or `none`. By default sub-folders left and right are a stereo pair."""
    rig_calibration: Path | None = None
    """Calibration of the rig, its cameras in their order: Kalibr camchain, stereo calibration of OpenCV (YAML), or a
    folder with a ROS camera_info per camera. It gives the scale, too."""
    rig_pairs: Literal["auto", "name", "time", "order"] = "auto"
    """Images of one instant: those of the same name, of the same time (in names, EXIF, or headers of a bag), or of the
    same place in their lists; auto takes names, and where they differ times."""
    rig_tolerance: Annotated[float, Range(above=0, most=10)] = 0.01
    """Largest difference of the times of one instant in seconds."""
    rig_missing: Share = 0.1
    """Largest share of instants at which a camera of the rig may have no image."""
    transfer: Transfer = "srgb"
    """Curve of the values in images and videos; those of linear light or a log curve are developed to sRGB's."""
    raw_balance: Literal["daylight", "camera", "none"] = "daylight"
    """White balance of camera raw files: that of the camera for daylight, that the first file was taken with, or none.
    """
    stops: Annotated[float, Range(-10, 10)] = 0.0
    """Exposure added to raw files and to linear or log images, in stops; light above 1 is clipped."""
    odd_sizes: Literal["refuse", "skip"] = "refuse"
    """Handling of images whose size differs from most others: refuse the input, or skip them."""

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.end is not None and not self.end > self.start:
            raise UsageError(
                f"end ({self.end} s) is not after start ({self.start} s)",
                cause="the two are swapped, or given in other units than seconds",
                hint="an end beyond the start, in seconds of the video",
            )
