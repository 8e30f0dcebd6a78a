"""cameras.json: intrinsics once, a camera-to-world matrix per frame; the plain exchange format of reference poses.

    {"width", "height", "model", "fx", "fy", "cx", "cy", "distortion": [...], "units", "convention",
     "frames": [{"name", "c2w": 4x4 or 3x4}]}

Another distortion key is read too: dist_k1_k2_p1_p2_k3, whose k3 is dropped: it is no part of COLMAP's OPENCV model.
"""

import json
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from swimm3r.errors import InputError
from swimm3r.io.atomic import write_text


@dataclass(frozen=True)
class CameraTable:
    """Poses and intrinsics of named frames of one size."""

    names: tuple[str, ...]
    width: int
    height: int
    model: str  # COLMAP's name; cameras.Cameras checks it
    K: np.ndarray  # [c, 3, 3] pixels
    distortion: np.ndarray  # [c, d]
    cam2world: np.ndarray  # [c, 4, 4]
    units: str = "scene units"


def write_cameras(path: Path, table: CameraTable) -> None:
    """Write a table; intrinsics that differ between frames are repeated inside each frame."""
    shared = bool(np.ptp(table.K, axis=0).max() == 0 and np.all(np.ptp(table.distortion, axis=0) == 0))

    def intrinsics(i: int) -> dict[str, float | list[float]]:
        K = table.K[i]
        return {
            "fx": float(K[0, 0]),
            "fy": float(K[1, 1]),
            "cx": float(K[0, 2]),
            "cy": float(K[1, 2]),
            "distortion": table.distortion[i].tolist(),
        }

    document = {
        "width": table.width,
        "height": table.height,
        "model": table.model,
        **(intrinsics(0) if shared else {}),
        "units": table.units,
        "convention": "OpenCV camera axes, camera-to-world; centre of the first pixel at (0.5, 0.5)",
        "frames": [
            {"name": name, "c2w": pose.tolist(), **({} if shared else intrinsics(i))}
            for i, (name, pose) in enumerate(zip(table.names, table.cam2world, strict=True))
        ],
    }
    write_text(path, json.dumps(document, indent=1) + "\n")


def read_cameras(path: Path) -> CameraTable:
    """Read a table. Raises InputError where the file is not one."""
    try:
        document = json.loads(path.read_text(encoding="utf-8"))
        frames = document["frames"]
        model, first = _model_and_distortion({**document, **frames[0]})
        K, distortion, poses = [], [], []
        for frame in frames:
            merged = {**document, **frame}
            K.append([[merged["fx"], 0, merged["cx"]], [0, merged["fy"], merged["cy"]], [0, 0, 1]])
            distortion.append(_model_and_distortion(merged)[1])
            pose = np.eye(4)
            given = np.asarray(frame["c2w"], np.float64)
            pose[: given.shape[0]] = given
            poses.append(pose)
        return CameraTable(
            names=tuple(frame["name"] for frame in frames),
            width=int(document["width"]),
            height=int(document["height"]),
            model=model,
            K=np.asarray(K, np.float64),
            distortion=np.asarray(distortion, np.float64).reshape(len(frames), len(first)),
            cam2world=np.stack(poses),
            units=document.get("units", "scene units"),
        )
    except (OSError, UnicodeDecodeError, json.JSONDecodeError, KeyError, IndexError, TypeError, ValueError) as error:
        raise InputError(
            f"{path} is not a cameras.json ({type(error).__name__}: {error})",
            cause="the file is missing, damaged or of another format",
            hint="see docs/conventions.md for the layout; RUN/sfm/cameras.json of any run is an example",
        ) from error


def _model_and_distortion(merged: dict) -> tuple[str, list[float]]:
    if "dist_k1_k2_p1_p2_k3" in merged:
        return "OPENCV", merged["dist_k1_k2_p1_p2_k3"][:4]  # poses do not depend on k3
    distortion = list(merged.get("distortion", []))
    return (merged["model"] if distortion else "PINHOLE"), distortion
