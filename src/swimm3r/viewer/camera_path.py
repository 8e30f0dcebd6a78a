"""Views and camera paths that the user keeps: cameras.json with times, pictures, and the video along a path.

They go to RUN/renders/views/NAME, which `swimm3r render --path` reads; nothing that lies there is overwritten.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import torch

from swimm3r.errors import UsageError
from swimm3r.io import images
from swimm3r.io.cameras_json import read_cameras
from swimm3r.io.files.safe_names import check_name
from swimm3r.pipeline.renders import write_flythrough
from swimm3r.progress import Progress, silent
from swimm3r.viewer.layers import LayerChoice, Painter, ViewCamera
from swimm3r.viewer.viewed_run import ViewedRun

_RATE = 15  # images per second of the video
_SAVED_SIDE = 1920  # pixels of saved pictures


@dataclass(frozen=True)
class KeyFrame:
    """One view of a path, at a second of the clip."""

    view: ViewCamera
    time: float


def new_folder(run: ViewedRun, name: str, stem: str) -> Path:
    """A folder of RUN/renders/views that does not exist yet: `name`, or without one STEM-1, STEM-2 ...

    Raises UsageError where the name is taken, or is none.
    """
    parent = run.folder / "renders" / "views"
    if not name:
        return next(path for number in range(1, 10_000) if not (path := parent / f"{stem}-{number}").exists())
    try:
        check_name(name)
    except ValueError as error:
        raise UsageError(str(error), cause="a slip in the name", hint="a name of letters and digits") from error
    if "/" in name or "\\" in name:
        raise UsageError(f"{name} names a folder in a folder", cause="a slash in the name", hint="one word")
    if (parent / name).exists():
        raise UsageError(f"{parent / name} exists", cause="the name was used before", hint="another name")
    return parent / name


def save_view(painter: Painter, view: ViewCamera, choice: LayerChoice, name: str = "") -> Path:
    """Write a picture as it is shown, and its camera. Raises UsageError where the name is taken."""
    folder = new_folder(painter.run, name, "view")
    picture = painter.draw(view, _SAVED_SIDE, choice)
    images.write_rgb(folder / "view.png", picture.rgb)
    _write_cameras(folder / "cameras.json", painter.run, [KeyFrame(view, choice.time)], _SAVED_SIDE)
    return folder


def save_path(run: ViewedRun, frames: Sequence[KeyFrame], name: str = "") -> Path:
    """Write the cameras of a path. Raises UsageError where the name is taken or the path is empty."""
    _check_path(frames, 1)
    folder = new_folder(run, name, "path")
    _write_cameras(folder / "cameras.json", run, frames, _SAVED_SIDE)
    return folder


def load_path(run: ViewedRun, path: Path) -> list[KeyFrame]:
    """The cameras that `save_path` wrote. Raises InputError where the file is no cameras.json."""
    table = read_cameras(path)
    poses = torch.from_numpy(table.cam2world)
    poses = poses if run.to_map is None else run.to_map.poses(poses)
    times = table.times or [0.0] * len(table.names)
    aspect = table.width / table.height
    fov = [2 * float(torch.atan(torch.tensor(table.height / (2 * K[1, 1])))) for K in table.K]
    return [KeyFrame(ViewCamera(pose, f, aspect), t) for pose, f, t in zip(poses, fov, times, strict=True)]


def film(
    run: ViewedRun,
    frames: Sequence[KeyFrame],
    seconds: float,
    name: str = "",
    long_side: int = 1280,
    progress: Progress = silent,
) -> Path:
    """A video along a smooth path through the key frames: with the water, and beside it without.

    Raises UsageError for fewer than two key frames, or where the name is taken.
    """
    _check_path(frames, 2)
    assert run.scene is not None
    assert run.style is not None
    folder = save_path(run, frames, name)
    write_flythrough(
        folder / "flythrough.mp4",
        run.scene,
        frames[0].view.at(long_side),
        torch.stack([frame.view.cam2world for frame in frames]),
        [frame.time for frame in frames],
        max(2, round(seconds * _RATE)),
        run.style,
        progress,
    )
    return folder


def _check_path(frames: Sequence[KeyFrame], least: int) -> None:
    if len(frames) < least:
        raise UsageError(
            f"a path has at least {least} key frames, and this one has {len(frames)}",
            cause="no views were added to it",
            hint="Add this view, from two places at least",
        )


def _write_cameras(path: Path, run: ViewedRun, frames: Sequence[KeyFrame], long_side: int) -> None:
    cameras = [frame.view.at(long_side) for frame in frames]
    first = cameras[0]
    K = torch.cat([camera.K for camera in cameras])
    poses = run.in_axes_of_sfm(torch.cat([camera.cam2world for camera in cameras]))
    units = "metres" if run.rec.metric else "scene units"
    joined = replace(first, K=K, distortion=K.new_zeros(len(K), 0), cam2world=poses)
    names = [f"view_{number:03d}" for number in range(1, len(frames) + 1)]
    joined.save(path, names, [frame.time for frame in frames], units)
