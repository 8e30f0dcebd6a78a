"""nerfstudio's transforms.json, which Spann3R, Polycam and others write, too.

Poses are camera to world with OpenGL's camera axes (x right, y up, z backwards). `applied_transform` and
`applied_scale` tell what was done to the world on the way; they are undone, so that the original frame and scale come
back. The cloud of `ply_file_path` is in the file's world; it has no sightings.
"""

import json
import math
from pathlib import Path, PurePosixPath
from typing import Any

import numpy as np

from swimm3r.io.foreign.model import ForeignModel, one_size, read_foreign, without_points
from swimm3r.io.ply import read_points

_FLIP = np.diag([1.0, -1.0, -1.0, 1.0])
_MODELS = {
    "PINHOLE": (), "SIMPLE_PINHOLE": (), "OPENCV": ("k1", "k2", "p1", "p2"), "OPENCV_FISHEYE": ("k1", "k2", "k3", "k4"),
}  # fmt: skip


def read(path: Path, document: dict[str, Any]) -> ForeignModel:
    """Poses, lens and cloud. Raises InputError, ValueError or KeyError for a file that is not one."""
    frames = [{**document, **frame} for frame in document["frames"]]  # intrinsics may be the clip's or the frame's
    if not frames:
        raise ValueError("it names no frames")
    kinds = {_kind(frame) for frame in frames}
    if len(kinds) > 1:
        raise ValueError(f"it mixes camera models: {', '.join(sorted(kinds))}")
    kind = kinds.pop()
    if any(frame.get("k3") or frame.get("k4") for frame in frames) and kind == "OPENCV":
        raise ValueError("its OPENCV lens has k3 or k4, which that model does not have")
    names = tuple(PurePosixPath(str(frame["file_path"]).replace("\\", "/")).name for frame in frames)
    if len(set(names)) < len(names):  # then the folders tell them apart
        names = tuple(str(PurePosixPath(str(frame["file_path"]).removeprefix("./"))) for frame in frames)
    K = np.stack([_K(frame) for frame in frames])
    distortion = np.array([[float(frame.get(k) or 0) for k in _MODELS[kind]] for frame in frames]).reshape(
        len(frames), -1
    )
    poses = np.array([frame["transform_matrix"] for frame in frames], np.float64).reshape(-1, 4, 4) @ _FLIP
    back, scale = _original_world(document)
    poses = back @ poses
    poses[:, :3, 3] /= scale
    size = one_size({(int(frame["w"]), int(frame["h"])) for frame in frames})
    model = without_points(names, "PINHOLE" if not _MODELS[kind] else kind, size, K, distortion, poses)
    cloud = document.get("ply_file_path")
    if cloud is not None:
        if PurePosixPath(cloud).is_absolute() or ".." in PurePosixPath(cloud).parts:
            raise ValueError(f"its cloud lies outside its folder: {cloud}")
        xyz, rgb = read_points(path.parent / cloud)
        xyz = (xyz.astype(np.float64) @ back[:3, :3].T + back[:3, 3]) / scale
        colours = (rgb * 255).round().astype(np.uint8)
        model = type(model)(**{**vars(model), "xyz": xyz, "rgb": colours, "error": np.zeros(len(xyz))})
    return ForeignModel("nerfstudio", model)


def pictures_folder(path: Path) -> Path:
    """Where the pictures of a transforms.json lie. Raises InputError for a file that is not one."""
    names = read_foreign(path).model.names
    file = path / "transforms.json" if path.is_dir() else path
    first = PurePosixPath(json.loads(file.read_text(encoding="utf-8"))["frames"][0]["file_path"].replace("\\", "/"))
    # names with folders of their own are relative to the file, others to the one folder that all lie in
    return file.parent if any("/" in name for name in names) else file.parent / first.parent


def _kind(frame: dict[str, Any]) -> str:
    name = str(
        frame.get("camera_model", "OPENCV" if any(frame.get(k) for k in ("k1", "k2", "p1", "p2")) else "PINHOLE")
    )
    if name not in _MODELS:
        raise ValueError(f"its camera model is {name}; supported are {', '.join(_MODELS)}")
    return name


def _K(frame: dict[str, Any]) -> np.ndarray:
    width, height = float(frame["w"]), float(frame["h"])
    if "fl_x" in frame:
        fx = float(frame["fl_x"])
        fy = float(frame.get("fl_y", fx))
    else:
        fx = width / 2 / math.tan(float(frame["camera_angle_x"]) / 2)
        fy = height / 2 / math.tan(float(frame["camera_angle_y"]) / 2) if "camera_angle_y" in frame else fx
    cx, cy = float(frame.get("cx", width / 2)), float(frame.get("cy", height / 2))
    return np.array([[fx, 0, cx], [0, fy, cy], [0, 0, 1]])


def _original_world(document: dict[str, Any]) -> tuple[np.ndarray, float]:
    applied = np.eye(4)
    if "applied_transform" in document:
        applied[:3] = np.array(document["applied_transform"], np.float64)[:3]
    return np.linalg.inv(applied), float(document.get("applied_scale", 1.0))
