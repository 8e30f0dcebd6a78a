"""Cameras of every frame that an imported model places, test frames among them, kept beside the reconstruction.

Test frames take no part in the reconstruction, and their poses in the model are where they are scored from; the model
need not be there any more by then.
"""

from pathlib import Path

from swimm3r.cameras import Cameras, cameras_of
from swimm3r.errors import InputError
from swimm3r.io.cameras_json import read_own_cameras
from swimm3r.io.files.damage import remake
from swimm3r.io.imports.read import read_foreign
from swimm3r.scene.frames import Frames
from swimm3r.sfm.imported.match_frames import model_cameras

IMPORTED = "cameras_imported.json"


def keep_model_poses(frames: Frames, model: Path, folder: Path) -> None:
    """Write the cameras of the frames that the model places to `folder`/cameras_imported.json."""
    foreign = read_foreign(model)
    names, cameras = model_cameras(frames, foreign.model)
    units = "metres" if foreign.metric else "scene units"
    cameras.save(folder / IMPORTED, names, frames.times_of(names), units)


def check_model_poses(model: Path, folder: Path) -> None:
    """Raise InputError where `folder` has no such file, as in runs of earlier versions, and the model is not there."""
    if not (folder / IMPORTED).is_file() and not model.exists():
        raise InputError(
            f"{model}, by which test frames are placed, is not on this computer",
            cause=f"{folder} was made by an earlier version, which did not keep the model's poses of test frames, and"
            " the model was removed, or the run copied without it",
            hint="put the model there again; or give the poses with --reference cameras.json",
        )


def model_poses(frames: Frames, model: Path, folder: Path) -> tuple[tuple[str, ...], Cameras]:
    """The frames that the model places, and their cameras, as `keep_model_poses` wrote them.

    Of a folder without the file they are read from the model. Raises InputError where that is not there either.
    """
    check_model_poses(model, folder)
    if not (folder / IMPORTED).is_file():
        return model_cameras(frames, read_foreign(model).model)
    table = read_own_cameras(folder / IMPORTED, remake(folder))
    return table.names, cameras_of(table)
