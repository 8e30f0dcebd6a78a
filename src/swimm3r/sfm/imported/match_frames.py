"""The frames that an imported model registers, and their cameras at the size of the frames."""

from pathlib import PurePosixPath

from swimm3r.cameras import Cameras, cameras_of, resized
from swimm3r.errors import InputError
from swimm3r.io.colmap.model import ColmapModel
from swimm3r.scene.frames import Frames

_ASPECT = 0.01  # relative difference of aspect ratios beyond which images are not those of the model


def model_cameras(frames: Frames, model: ColmapModel) -> tuple[tuple[str, ...], Cameras]:
    """The frames that the model places, and their cameras at the size of the frames."""
    names, rows = named_frames(frames, model)
    return names, at_frame_size(cameras_of(model)[rows], frames)


def named_frames(frames: Frames, model: ColmapModel) -> tuple[tuple[str, ...], list[int]]:
    """Frames that the model places and their rows in it; preparation may have changed a suffix."""
    by_stem = {str(PurePosixPath(name).with_suffix("")): row for row, name in enumerate(model.names)}
    by_name = {name: row for row, name in enumerate(model.names)}
    rows = {name: by_name.get(name, by_stem.get(str(PurePosixPath(name).with_suffix("")))) for name in frames.names}
    placed = {name: row for name, row in rows.items() if row is not None}
    return tuple(placed), list(placed.values())


def at_frame_size(cameras: Cameras, frames: Frames) -> Cameras:
    """The cameras at the size of the frames. Raises InputError where their shape is another."""
    width, height = frames.width, frames.height
    if abs(width * cameras.height / (height * cameras.width) - 1) > _ASPECT:
        raise InputError(
            f"the frames are {width}x{height}, the COLMAP model's images {cameras.width}x{cameras.height}",
            cause="the images were cropped or turned after the model was made",
            hint="give the images that the model was made of",
        )
    if (width, height) == (cameras.width, cameras.height):
        return cameras
    return resized(cameras, width, height)
