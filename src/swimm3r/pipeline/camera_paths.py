"""Paths of a virtual camera through a finished map: along the dive, around the scene, or from a file.

A path around the scene turns about the line from the scene's middle to where the nearest quarter of the frames were
taken on average, at their distance d. Its radius is their median distance from that line, between 0.2 d and 0.5 d: a
map shows what was filmed from there, and little else.

A CSV of poses has the columns time, x, y, z, qw, qx, qy, qz: seconds of the clip, and camera to world in the axes and
unit of RUN/sfm/cameras.json. A line of names may stand first, and lines that begin with # are left out.
"""

import csv
import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import torch
from jaxtyping import Float
from scipy.ndimage import gaussian_filter1d
from torch import Tensor

from swimm3r.cameras import Cameras, cameras_of, check_cameras
from swimm3r.errors import InputError
from swimm3r.geometry import Similarity, pose_from, quaternion_from_rotation, rotation_from_quaternion
from swimm3r.io import cameras_json
from swimm3r.io.files.damage import Remedy, guard
from swimm3r.pipeline.view_settings import PathName, ViewSettings
from swimm3r.scene.frames import Frames, rows_of_one_camera

_SMOOTH = 1.5  # frames of the dive over which the flight's hand steadies
_MADE = 90  # cameras of a made path
_NEAREST = 0.25  # of the frames, by distance from the middle of the scene, around which a path turns
_NARROW, _WIDE = 0.2, 0.5  # radius of an orbit as a share of its distance
_UPRIGHT = 0.3  # length of the frames' mean upward direction below which they turn too much to have one
_TURNS = 2  # of a spiral
_INNER = 0.15  # where it ends, as a share of its radius
_COLUMNS = ("time", "x", "y", "z", "qw", "qx", "qy", "qz")
_CSV = Remedy(
    "lines like 0.0,1.2,0.3,-0.5,1,0,0,0; see docs/guides/rendering.md",
    cause="it is of another format, or a column is missing",
    fault="is no path of a camera",
)


@dataclass(frozen=True)
class CameraPath:
    """Cameras in the axes of the map, in the order they are rendered."""

    names: tuple[str, ...]
    cameras: Cameras
    times: tuple[float, ...] | None  # seconds of the clip, where they are known


@dataclass(frozen=True)
class Dive:
    """The facts of a run that paths are made from, in the axes of the map."""

    frames: CameraPath  # the training frames
    clip: Frames  # all frames, which tell the cameras of a rig apart
    ground: Float[Tensor, "p 3"]  # points of the scene
    span: tuple[float, float]  # of the clip, seconds
    own_file: Path  # the cameras.json of the training frames in these axes
    to_map: Similarity | None  # from the axes of RUN/sfm; None where they are the map's


def camera_path(dive: Dive, settings: ViewSettings) -> CameraPath:
    """The cameras that the settings ask for. Raises InputError for a file that holds no path."""
    count = settings.count
    match settings.path:
        case Path() as file:
            given = _from_file(file, dive)
            return _through(given, dive, count) if count else given
        case "frames":
            return _through(dive.frames, dive, count) if count else dive.frames
        case "dive":
            return _through(dive.frames, dive, count or _MADE)
        case "orbit" | "spiral":
            return _around(dive, settings.path, count or _MADE)


def smooth_path(cam2world: Float[Tensor, "c 4 4"], count: int) -> Float[Tensor, "f 4 4"]:
    """`count` poses along a path of cameras, without the shaking of the hand that held them."""
    q = quaternion_from_rotation(cam2world[:, :3, :3].double()).numpy().copy()
    for i in range(1, len(q)):  # q and -q are one rotation, but not on the way in between
        if q[i] @ q[i - 1] < 0:
            q[i] *= -1
    stations = np.concatenate([cam2world[:, :3, 3].double().numpy(), q], 1)
    at = np.linspace(0, len(stations) - 1, count)
    dense = np.stack([np.interp(at, np.arange(len(stations)), column) for column in stations.T], 1)
    per_frame = (count - 1) / max(1, len(stations) - 1)
    width = _SMOOTH * per_frame
    steady = torch.from_numpy(gaussian_filter1d(dense, width, axis=0, mode="nearest") if width else dense)
    return pose_from(rotation_from_quaternion(steady[:, 3:]), steady[:, :3])


def times_along(times: Sequence[float], count: int) -> tuple[float, ...]:
    """`count` times on the way through these."""
    return tuple(np.interp(np.linspace(0, len(times) - 1, count), np.arange(len(times)), times).tolist())


def _through(given: CameraPath, dive: Dive, count: int) -> CameraPath:
    """A smooth path of `count` cameras through others, with the lens of the first; through those of one of a rig."""
    rows = rows_of_one_camera(given.names, dive.clip)
    cameras = given.cameras[rows]
    poses = smooth_path(cameras.cam2world, count)
    times = None if given.times is None else times_along([given.times[row] for row in rows], count)
    return CameraPath(_numbered(count), _posed(cameras, poses), times)


def _around(dive: Dive, name: PathName, count: int) -> CameraPath:
    stand = _standpoint(dive)
    share = torch.arange(count, dtype=torch.float64) / count
    turns, reach = (1, torch.ones(count)) if name == "orbit" else (_TURNS, 1 - (1 - _INNER) * share)
    angle = 2 * math.pi * turns * share
    flat = torch.cos(angle)[:, None] * stand.across + torch.sin(angle)[:, None] * stand.up
    # a spiral comes nearer as it narrows, down to two thirds of its distance
    near = 1 - (1 - reach) / (1 - _INNER) / 3
    centers = stand.middle + stand.radius * reach[:, None] * flat + stand.distance * near[:, None] * stand.axis
    poses = torch.stack([looking_at(center, stand.middle, stand.up) for center in centers])
    times = tuple(np.linspace(*dive.span, count).tolist())
    return CameraPath(_numbered(count), _posed(_one_camera(dive), poses), times)


def looking_at(center: Float[Tensor, "3"], target: Float[Tensor, "3"], up: Float[Tensor, "3"]) -> Float[Tensor, "4 4"]:
    """The pose of a camera that looks at a target, with `up` towards the upper edge of its image."""
    z = torch.nn.functional.normalize(target - center, dim=0)
    x = torch.nn.functional.normalize(torch.linalg.cross(z, up), dim=0)
    return pose_from(torch.stack([x, torch.linalg.cross(z, x), z], -1), center)


@dataclass(frozen=True)
class _Standpoint:
    """A circle from which the dive looked at the middle of the scene."""

    middle: Float[Tensor, "3"]
    axis: Float[Tensor, "3"]  # from the middle to the circle's center
    up: Float[Tensor, "3"]  # of the images, at a right angle to the axis
    distance: float
    radius: float

    @property
    def across(self) -> Float[Tensor, "3"]:
        return torch.linalg.cross(self.up, self.axis)


def _standpoint(dive: Dive) -> _Standpoint:
    middle = dive.ground.double().median(0).values
    cameras = dive.frames.cameras
    apart = (cameras.centers.double() - middle).norm(dim=-1)
    near = apart.argsort()[: max(1, round(_NEAREST * len(cameras)))]
    offset = cameras.centers[near].double() - middle
    distance = max(float(offset.mean(0).norm()), 1e-6)
    axis = torch.nn.functional.normalize(offset.mean(0), dim=0)
    beside = (offset - (offset @ axis)[:, None] * axis).norm(dim=-1).median()
    above = -cameras.cam2world[near, :3, 1].double()
    up = above.mean(0) if float(above.mean(0).norm()) > _UPRIGHT else above[0]
    up = torch.nn.functional.normalize(up - (up @ axis) * axis, dim=0)
    return _Standpoint(middle, axis, up, distance, min(max(float(beside), _NARROW * distance), _WIDE * distance))


def _from_file(file: Path, dive: Dive) -> CameraPath:
    """A path in the axes of RUN/sfm, moved to the map's."""
    if not file.is_file():
        raise InputError(
            f"there is no file {file}, and no path of that name",
            cause="a slip in --path",
            hint="--path frames, dive, orbit or spiral, or the name of a cameras.json or .csv file",
        )
    if file.resolve() == dive.own_file.resolve():
        return dive.frames
    if file.suffix.lower() == ".csv":
        given = _from_csv(file, _one_camera(dive))
    else:
        table = cameras_json.read_cameras(file)
        given = CameraPath(table.names, cameras_of(table), table.times)
    if dive.to_map is None:
        return given
    return replace(given, cameras=_posed(given.cameras, dive.to_map.poses(given.cameras.cam2world.double())))


def _from_csv(file: Path, like: Cameras) -> CameraPath:
    rows: list[list[float]] = []
    with guard(file, _CSV):
        lines = file.read_text(encoding="utf-8-sig").splitlines()
        for number, words in enumerate(csv.reader(lines, skipinitialspace=True), 1):
            if not words or words[0].startswith("#"):
                continue
            if not rows and tuple(word.strip().lower() for word in words) == _COLUMNS:
                continue
            rows.append(_numbers(number, words))
        if not rows:
            raise ValueError("it has no poses")
        values = torch.tensor(rows, dtype=torch.float64)
        cameras = _posed(like, pose_from(rotation_from_quaternion(values[:, 4:]), values[:, 1:4]))
        check_cameras(cameras)
    return CameraPath(_numbered(len(rows)), cameras, tuple(values[:, 0].tolist()))


def _numbers(number: int, words: list[str]) -> list[float]:
    if len(words) != len(_COLUMNS):
        raise ValueError(f"line {number} has {len(words)} values, and {len(_COLUMNS)} are expected")
    try:
        values = [float(word) for word in words]
    except ValueError:
        raise ValueError(f"line {number} has a value that is no number") from None
    if not all(map(math.isfinite, values)) or not math.hypot(*values[4:]) > 0.5:
        raise ValueError(f"line {number} has a number that is not finite, or a quaternion of zeros")
    return values


def _one_camera(dive: Dive) -> Cameras:
    """The training frames of one camera of a rig; all without one."""
    return dive.frames.cameras[rows_of_one_camera(dive.frames.names, dive.clip)]


def _posed(lens: Cameras, poses: Float[Tensor, "c 4 4"]) -> Cameras:
    """Cameras at these poses: with their own lenses where there are as many, else all with the first one's."""
    if len(lens) != len(poses):
        lens = lens[torch.zeros(len(poses), dtype=torch.long)]
    return replace(lens, cam2world=poses.to(lens.cam2world))


def _numbered(count: int) -> tuple[str, ...]:
    return tuple(f"view_{number:04d}" for number in range(1, count + 1))
