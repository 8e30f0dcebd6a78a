"""A video, a ROS bag or a folder of stills -> the frames a run works on, on disk, with frames.json beside them."""

from pathlib import Path
from typing import TYPE_CHECKING, Any

from swimm3r.progress import Progress, watched
from swimm3r.scene.settings import FrameSettings

if TYPE_CHECKING:
    import swimm3r.prepare.frames_folder
    import swimm3r.scene.frames

__all__ = ["check_source", "load_frames", "read_frames"]


def read_frames(
    source: str | Path,
    settings: FrameSettings | None = None,
    folder: str | Path | None = None,
    progress: Progress | None = None,
    lens: "swimm3r.prepare.frames_folder.LensOf | None" = None,
    **changes: Any,
) -> "swimm3r.scene.frames.Frames":
    """The frames of a video, a ROS bag or a folder of stills, prepared into `folder`.

    Without a folder they go into the user's cache and are found there the next time. `changes` replace single settings:
    `read_frames("dive.mp4", fps=2)`. An earlier preparation in `folder` is replaced. Raises InputError on
    input that cannot be used, and OSError where the disk refuses; then nothing is left behind. A terminal or a notebook
    shows the progress, unless `progress` is given (`swimm3r.silent`: nothing). `lens` gives the lens of frames of a
    width and a height, where it is known: with a gyroscope in the video it decides on keyframes (`prepare.rotation`).
    It takes a folder, and raises ValueError without one.
    """
    from swimm3r.prepare import frames_folder

    folder = None if folder is None else Path(folder).absolute()  # images are read later, from wherever that is
    with watched(progress) as told:
        return frames_folder.read_frames(source, settings, folder, told, lens, **changes)


def load_frames(folder: str | Path) -> "swimm3r.scene.frames.Frames":
    """The frames that `read_frames` or `Frames.save` left in a folder. Raises InputError where they are incomplete."""
    from swimm3r.prepare import frames_folder

    return frames_folder.load_frames(Path(folder).absolute())


def check_source(source: Path) -> Path:
    """The video, bag or folder of images that a source stands for: a folder's only video where it has no images.

    Cheap, and writes nothing. Raises InputError where a source is plainly none of them, or cannot be read.
    """
    from swimm3r.prepare import frames_folder

    return frames_folder.check_source(source)
