"""nerfstudio's transforms.json, which Spann3R, Polycam and others write, too.

Poses are camera to world with OpenGL's camera axes (x right, y up, z backwards). `applied_transform` and
`applied_scale` tell what was done to the world on the way; they are undone, so that the original frame and scale come
back. The cloud of `ply_file_path` is in the file's world; it has no observations.
"""

import math
from dataclasses import dataclass, fields, replace
from pathlib import Path, PurePosixPath
from typing import Any

import numpy as np

from swimm3r.errors import InputError
from swimm3r.io.files.json_file import read_json, structure
from swimm3r.io.files.safe_names import check_name
from swimm3r.io.imports.record import REMEDY, ForeignModel, one_size, without_points
from swimm3r.io.ply import read_points

_FLIP = np.diag([1.0, -1.0, -1.0, 1.0])
_MODELS = {
    "PINHOLE": (), "SIMPLE_PINHOLE": (), "OPENCV": ("k1", "k2", "p1", "p2"), "OPENCV_FISHEYE": ("k1", "k2", "k3", "k4"),
}  # fmt: skip


@dataclass(frozen=True)
class _Lens:
    """Intrinsics of one frame, or of the clip."""

    w: float | None = None
    h: float | None = None
    camera_model: str | None = None
    fl_x: float | None = None
    fl_y: float | None = None
    camera_angle_x: float | None = None
    camera_angle_y: float | None = None
    cx: float | None = None
    cy: float | None = None
    k1: float | None = None
    k2: float | None = None
    k3: float | None = None
    k4: float | None = None
    p1: float | None = None
    p2: float | None = None


_Row = tuple[float, float, float, float]


@dataclass(frozen=True, kw_only=True)
class _Frame(_Lens):
    file_path: str
    transform_matrix: tuple[_Row, _Row, _Row, _Row]


@dataclass(frozen=True, kw_only=True)
class _Document(_Lens):
    frames: tuple[_Frame, ...]
    applied_transform: tuple[_Row, ...] | None = None
    applied_scale: float = 1.0
    ply_file_path: str | None = None

    def __post_init__(self) -> None:
        if not self.frames:
            raise ValueError("it names no frames")
        if self.applied_scale <= 0:
            raise ValueError(f"its applied_scale is {self.applied_scale:g}")
        if self.applied_transform is not None and len(self.applied_transform) not in (3, 4):
            raise ValueError(f"its applied_transform has {len(self.applied_transform)} rows")


def read(path: Path, document: dict[str, Any]) -> ForeignModel:
    """Poses, lens and cloud. Raises InputError or ValueError for a file that is not one."""
    file = structure(document, _Document)
    lenses = [_intrinsics(_of_frame(frame, file)) for frame in file.frames]
    kinds = {lens.model for lens in lenses}
    if len(kinds) > 1:
        raise ValueError(f"it mixes camera models: {', '.join(sorted(kinds))}")
    poses = np.array([frame.transform_matrix for frame in file.frames]) @ _FLIP
    back = _original_world(file)
    poses = back @ poses
    poses[:, :3, 3] /= file.applied_scale
    model = without_points(
        _names(file),
        kinds.pop(),
        one_size({lens.size for lens in lenses}),
        np.stack([lens.K for lens in lenses]),
        np.array([lens.distortion for lens in lenses]).reshape(len(lenses), -1),
        poses,
    )
    if file.ply_file_path is not None:
        check_name(file.ply_file_path)
        xyz, rgb = read_points(path.parent / file.ply_file_path)
        xyz = (xyz.astype(np.float64) @ back[:3, :3].T + back[:3, 3]) / file.applied_scale
        model = replace(model, xyz=xyz, rgb=(rgb * 255).round().astype(np.uint8), error=np.zeros(len(xyz)))
    return ForeignModel("nerfstudio", model)


@dataclass(frozen=True)
class FrameLens:
    """The lens of a frame."""

    model: str
    size: tuple[int, int]
    K: np.ndarray
    distortion: tuple[float, ...]


def lenses_of(document: dict[str, Any]) -> dict[str, FrameLens]:
    """The lens of every frame by its name; of a file without frames the one of the clip. Raises ValueError."""
    if "frames" not in document:
        return {"camera": _intrinsics(structure(document, _Lens))}
    file = structure(document, _Document)
    lenses = [_intrinsics(_of_frame(frame, file)) for frame in file.frames]
    return dict(zip(_names(file), lenses, strict=True))


def images_folder(path: Path) -> Path:
    """The folder of the images of a transforms.json. Raises InputError for any other file."""
    file = path / "transforms.json" if path.is_dir() else path
    document = read_json(file, _Document, REMEDY)
    names, first = _names(document), _relative(document.frames[0])
    # names with folders of their own are relative to the file, others to the one folder that all lie in
    folder = file.parent if any("/" in name for name in names) else file.parent / first.parent
    if not (file.parent / first).is_file():
        raise InputError(
            f"{file} names the image {first}, which is not there",
            cause="the images lie elsewhere, or were renamed",
            hint="put the images back beside the file, or name their folder with --images",
        )
    return folder


def _relative(frame: _Frame) -> PurePosixPath:
    return PurePosixPath(frame.file_path.replace("\\", "/"))


def _names(file: _Document) -> tuple[str, ...]:
    paths = [_relative(frame) for frame in file.frames]
    names = tuple(path.name for path in paths)
    return names if len(set(names)) == len(names) else tuple(map(str, paths))  # then the folders tell them apart


def _of_frame(frame: _Frame, file: _Document) -> _Lens:
    """The intrinsics of a frame: its own, and the clip's where it has none."""

    def value(name: str) -> Any:
        own = getattr(frame, name)
        return getattr(file, name) if own is None else own

    return _Lens(**{field.name: value(field.name) for field in fields(_Lens)})


def _given(lens: _Lens, name: str) -> float:
    value = getattr(lens, name)
    if value is None:
        raise ValueError(f"there is no {name}")
    return value


def _intrinsics(lens: _Lens) -> FrameLens:
    kind = _kind(lens)
    if kind == "OPENCV" and (lens.k3 or lens.k4):
        raise ValueError("its OPENCV lens has k3 or k4, which that model does not have")
    size = int(_given(lens, "w")), int(_given(lens, "h"))
    distortion = tuple(getattr(lens, k) or 0.0 for k in _MODELS[kind])
    return FrameLens("PINHOLE" if not _MODELS[kind] else kind, size, _K(lens), distortion)


def _kind(lens: _Lens) -> str:
    name = lens.camera_model or ("OPENCV" if lens.k1 or lens.k2 or lens.p1 or lens.p2 else "PINHOLE")
    if name not in _MODELS:
        raise ValueError(f"its camera model is {name}; supported are {', '.join(_MODELS)}")
    return name


def _K(lens: _Lens) -> np.ndarray:
    width, height = _given(lens, "w"), _given(lens, "h")
    if lens.fl_x is not None:
        fx = lens.fl_x
        fy = fx if lens.fl_y is None else lens.fl_y
    else:
        fx = width / 2 / math.tan(_given(lens, "camera_angle_x") / 2)
        fy = fx if lens.camera_angle_y is None else height / 2 / math.tan(lens.camera_angle_y / 2)
    cx, cy = (half if given is None else given for given, half in ((lens.cx, width / 2), (lens.cy, height / 2)))
    return np.array([[fx, 0, cx], [0, fy, cy], [0, 0, 1]])


def _original_world(file: _Document) -> np.ndarray:
    applied = np.eye(4)
    if file.applied_transform is not None:
        applied[:3] = file.applied_transform[:3]
    return np.linalg.inv(applied)
