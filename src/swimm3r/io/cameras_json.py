"""cameras.json: intrinsics once, a camera-to-world matrix per frame; the plain exchange format of reference poses.

    {"width", "height", "model", "fx", "fy", "cx", "cy", "distortion": [...], "units", "convention",
     "frames": [{"name", "time", "c2w": 4x4 or 3x4}]}

`Cameras.save` writes it. `time` is in seconds since the start of the clip, and absent where it is not known.

Another distortion key is read too: dist_k1_k2_p1_p2_k3, whose k3 is dropped: it is no part of COLMAP's OPENCV model.
"""

from dataclasses import dataclass
from pathlib import Path

import numpy as np

from swimm3r.cameras import Cameras, cameras_of, check_cameras, check_lens
from swimm3r.io.files.damage import Remedy, guard
from swimm3r.io.files.json_file import read_json
from swimm3r.io.files.safe_names import check_names

_REMEDY = Remedy(
    "see docs/conventions.md for the layout; RUN/sfm/cameras.json of any run is an example",
    cause="it is of another format, or a crash or an editor damaged it",
    fault="is not a cameras.json",
)


@dataclass(frozen=True)
class CameraTable:
    """Poses and intrinsics of named frames of one size. Raises ValueError where they are no cameras."""

    names: tuple[str, ...]
    width: int
    height: int
    model: str  # COLMAP's name; cameras.Cameras checks it
    K: np.ndarray  # [c, 3, 3] pixels
    distortion: np.ndarray  # [c, d]
    cam2world: np.ndarray  # [c, 4, 4]
    units: str = "scene units"
    times: tuple[float, ...] | None = None  # seconds since the start of the clip; None where they are not known

    def __post_init__(self) -> None:
        check_names(self.names)
        check_cameras(cameras_of(self))


@dataclass(frozen=True)
class _Lens:
    """Intrinsics of a frame, or of every frame that has none of its own."""

    fx: float | None = None
    fy: float | None = None
    cx: float | None = None
    cy: float | None = None
    model: str | None = None
    distortion: tuple[float, ...] | None = None
    dist_k1_k2_p1_p2_k3: tuple[float, ...] | None = None


@dataclass(frozen=True, kw_only=True)
class _Frame(_Lens):
    name: str
    c2w: tuple[tuple[float, float, float, float], ...]
    time: float | None = None


@dataclass(frozen=True, kw_only=True)
class _Document(_Lens):
    width: int
    height: int
    frames: tuple[_Frame, ...]
    units: str = "scene units"


def load_cameras(path: str | Path) -> Cameras:
    """The cameras that `Cameras.save` wrote, in the file's order; `read_cameras` tells their names and times, too.

    Raises InputError where the file is no cameras.json.
    """
    return cameras_of(read_cameras(Path(path)))


def read_cameras(path: Path, remedy: Remedy = _REMEDY) -> CameraTable:
    """Read a table of any program. Raises InputError where the file is not one, or its lenses are none."""
    table = read_own_cameras(path, remedy)
    with guard(path, remedy):
        check_lens(cameras_of(table))
    return table


def read_own_cameras(path: Path, remedy: Remedy) -> CameraTable:
    """Read a table that Swimm3R wrote, whatever distortion it found. Raises the remedy's error."""
    document = read_json(path, _Document, remedy)
    with guard(path, remedy):
        lenses = [_intrinsics(frame, document) for frame in document.frames]
        if len({model for model, _, _ in lenses}) != 1:
            raise ValueError("its frames have several camera models" if lenses else "it names no frames")
        times = tuple(frame.time for frame in document.frames if frame.time is not None)
        return CameraTable(
            names=tuple(frame.name for frame in document.frames),
            width=document.width,
            height=document.height,
            model=lenses[0][0],
            K=np.stack([K for _, K, _ in lenses]),
            distortion=np.array([distortion for _, _, distortion in lenses], np.float64).reshape(len(lenses), -1),
            cam2world=np.stack([_pose(frame) for frame in document.frames]),
            units=document.units,
            times=times if len(times) == len(lenses) else None,
        )


def _intrinsics(frame: _Frame, document: _Document) -> tuple[str, np.ndarray, tuple[float, ...]]:
    """Model, K and distortion of a frame."""

    def value(name: str) -> float:
        own, shared = getattr(frame, name), getattr(document, name)
        if own is None and shared is None:
            raise ValueError(f"frame {frame.name} has no {name}, and neither has the file")
        return shared if own is None else own

    K = np.array([[value("fx"), 0, value("cx")], [0, value("fy"), value("cy")], [0, 0, 1]])
    given = frame if frame.dist_k1_k2_p1_p2_k3 is not None or frame.distortion is not None else document
    if given.dist_k1_k2_p1_p2_k3 is not None:
        return "OPENCV", K, given.dist_k1_k2_p1_p2_k3[:4]  # poses do not depend on k3
    if not given.distortion:
        return "PINHOLE", K, ()
    model = frame.model or document.model
    if model is None:
        raise ValueError("it has distortion and names no camera model")
    return model, K, given.distortion


def _pose(frame: _Frame) -> np.ndarray:
    if len(frame.c2w) not in (3, 4):
        raise ValueError(f"the pose of {frame.name} has {len(frame.c2w)} rows, and 3 or 4 are expected")
    pose = np.eye(4)
    pose[: len(frame.c2w)] = frame.c2w
    return pose
