"""OpenMVG's sfm_data.json: x_camera = R (X - C); pixels as the file has them, as in OpenMVG's own export to COLMAP.

cereal writes the name of an intrinsic's class at its first use only; later entries repeat its number without the top
bit. Its wrappers of keys, values and pointers are the records below.
"""

from dataclasses import dataclass, replace
from pathlib import PurePosixPath
from typing import Any

import numpy as np

from swimm3r.io.colmap.model import ColmapModel
from swimm3r.io.files.json_file import structure
from swimm3r.io.imports.opencv_fit import nearest_opencv, radial
from swimm3r.io.imports.record import ForeignModel, one_size, without_points

_TOP_BIT = 1 << 31
_Triple = tuple[float, float, float]


@dataclass(frozen=True)
class _Pose:
    rotation: tuple[_Triple, _Triple, _Triple]
    center: _Triple


@dataclass(frozen=True)
class _PoseEntry:
    key: int
    value: _Pose


@dataclass(frozen=True)
class _View:
    id_view: int
    id_intrinsic: int
    id_pose: int
    filename: str
    local_path: str = ""


@dataclass(frozen=True)
class _ViewPointer:
    data: _View


@dataclass(frozen=True)
class _ViewWrapper:
    ptr_wrapper: _ViewPointer


@dataclass(frozen=True)
class _ViewEntry:
    value: _ViewWrapper


@dataclass(frozen=True)
class _Common:
    """Numbers that all lenses have; some versions nest them."""

    width: int | None = None
    height: int | None = None
    focal_length: float | None = None
    principal_point: tuple[float, float] | None = None


@dataclass(frozen=True)
class _Lens(_Common):
    value0: _Common | None = None
    disto_k1: tuple[float] | None = None
    disto_k3: _Triple | None = None
    disto_t2: tuple[float, float, float, float, float] | None = None
    fisheye: tuple[float, float, float, float] | None = None


@dataclass(frozen=True)
class _LensPointer:
    data: _Lens


@dataclass(frozen=True)
class _LensWrapper:
    ptr_wrapper: _LensPointer
    polymorphic_id: int | None = None
    polymorphic_name: str | None = None


@dataclass(frozen=True)
class _LensEntry:
    key: int
    value: _LensWrapper


@dataclass(frozen=True)
class _Pixel:
    x: tuple[float, float]


@dataclass(frozen=True)
class _Observation:
    key: int
    value: _Pixel


@dataclass(frozen=True)
class _Point:
    X: _Triple
    observations: tuple[_Observation, ...]


@dataclass(frozen=True)
class _PointEntry:
    value: _Point


@dataclass(frozen=True)
class _Document:
    views: tuple[_ViewEntry, ...]
    intrinsics: tuple[_LensEntry, ...]
    extrinsics: tuple[_PoseEntry, ...]
    structure: tuple[_PointEntry, ...] = ()


def read(document: dict[str, Any]) -> ForeignModel:
    """Poses, lenses, points and observations of the placed views. Raises ValueError for a damaged file."""
    file = structure(document, _Document)
    poses = {entry.key: entry.value for entry in file.extrinsics}
    lenses = _lenses(file.intrinsics)
    views = sorted((entry.value.ptr_wrapper.data for entry in file.views), key=lambda view: view.id_view)
    placed = [view for view in views if view.id_pose in poses and view.id_intrinsic in lenses]
    if not placed:
        raise ValueError("no view in it has a pose and an intrinsic")
    used = [lenses[view.id_intrinsic] for view in placed]
    kinds = {kind for kind, *_ in used}
    if len(kinds) > 1:
        raise ValueError(f"it mixes lenses: {', '.join(sorted(kinds))}")
    model = without_points(
        tuple(str(PurePosixPath(view.local_path.strip("/")) / view.filename) for view in placed),
        kinds.pop(),
        one_size({size for _, size, _, _ in used}),
        np.stack([K for _, _, K, _ in used]),
        np.stack([distortion for *_, distortion in used]),
        np.stack([_cam2world(poses[view.id_pose]) for view in placed]),
    )
    return ForeignModel("OpenMVG", _with_points(model, file, placed), colored=False)


def _cam2world(pose: _Pose) -> np.ndarray:
    known = np.eye(4)
    known[:3, :3] = np.array(pose.rotation).T
    known[:3, 3] = pose.center
    return known


def _with_points(model: ColmapModel, file: _Document, placed: list[_View]) -> ColmapModel:
    """The model with the file's structure, as the placed views observe it."""
    row = {view.id_view: i for i, view in enumerate(placed)}
    points = [entry.value for entry in file.structure]
    observations = [
        (p, row[seen.key], seen.value.x)
        for p, point in enumerate(points)
        for seen in point.observations
        if seen.key in row
    ]
    return replace(
        model,
        xyz=np.array([point.X for point in points], np.float64).reshape(-1, 3),
        rgb=np.zeros((len(points), 3), np.uint8),
        error=np.zeros(len(points)),
        track_point=np.array([p for p, _, _ in observations], np.int64),
        track_frame=np.array([frame for _, frame, _ in observations], np.int64),
        track_xy=np.array([xy for _, _, xy in observations], np.float64).reshape(-1, 2),
    )


def _lenses(entries: tuple[_LensEntry, ...]) -> dict[int, tuple[str, tuple[int, int], np.ndarray, np.ndarray]]:
    names: dict[int, str] = {}
    found = {}
    for entry in entries:
        wrapper = entry.value
        number = -1 if wrapper.polymorphic_id is None else wrapper.polymorphic_id & ~_TOP_BIT
        if wrapper.polymorphic_name is not None:
            names[number] = wrapper.polymorphic_name
        if number not in names:
            raise ValueError(f"the kind of intrinsic {entry.key} is not named")
        found[entry.key] = _lens(names[number], wrapper.ptr_wrapper.data)
    return found


def _lens(name: str, data: _Lens) -> tuple[str, tuple[int, int], np.ndarray, np.ndarray]:
    width, height = _given(data, "width"), _given(data, "height")
    f, (cx, cy) = _given(data, "focal_length"), _given(data, "principal_point")
    K = np.array([[f, 0, cx], [0, f, cy], [0, 0, 1]])
    p1 = p2 = 0.0
    match name:
        case "pinhole":
            return "PINHOLE", (width, height), K, np.zeros(0)
        case "fisheye":
            return "OPENCV_FISHEYE", (width, height), K, np.array(_given(data, "fisheye"))
        case "pinhole_radial_k1":
            k = _given(data, "disto_k1")
        case "pinhole_radial_k3":
            k = _given(data, "disto_k3")
        case "pinhole_brown_t2":
            *radials, p1, p2 = _given(data, "disto_t2")
            k = tuple(radials)
        case _:
            raise ValueError(f"its lens is of the kind {name}, which is not supported")

    def distort(x: np.ndarray, y: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        r2 = x * x + y * y
        dx = x * radial(k, r2) + 2 * p1 * x * y + p2 * (r2 + 2 * x * x)
        return dx, y * radial(k, r2) + p1 * (r2 + 2 * y * y) + 2 * p2 * x * y

    return "OPENCV", (width, height), K, nearest_opencv(distort, K, width, height).distortion


def _given(data: _Lens, name: str) -> Any:
    """A number of a lens, in either of its places."""
    nested = getattr(data.value0, name, None)
    value = nested if getattr(data, name) is None else getattr(data, name)
    if value is None:
        raise ValueError(f"an intrinsic has no {name}")
    return value
