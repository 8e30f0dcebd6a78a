"""Calibrated rigs: the lens of the first camera, and the poses of the others from its axes.

Kalibr's camchain      T_cn_cnm1 of each camera takes points of the camera before it to its own
OpenCV's stereo        R, T take points of the first camera to the second, beside M1, D1, M2, D2 (or other names)
ROS's camera_info      a file per camera: rectification R_k, projection P_k with its last column -f B_k, so that
                       x_k = R_k^T (R_1 x_1 - B_k)

Lengths are metres.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float

from swimm3r.io.calibration.documents import from_yaml, read_document
from swimm3r.io.calibration.record import Calibration
from swimm3r.io.files.damage import Remedy, guard
from swimm3r.io.files.regular_file import require_regular_file

_REMEDY = Remedy(
    "a Kalibr camchain, a YAML with OpenCV's M1, D1, M2, D2, R and T, or a folder with a ROS camera_info per camera"
    " (left.yaml, right.yaml)",
    cause="the file is damaged, of one camera alone, or of another program",
    fault="cannot be read as the calibration of a rig",
)
_ORTHONORMAL = 5e-3  # of R R^T: files print few digits


@dataclass(frozen=True)
class RigCalibration:
    """The cameras of a rig in their order."""

    lenses: tuple[Calibration, ...]
    camera_from_rig: Float[np.ndarray, "s 4 4"]  # metres; the first is the identity


def read_rig(path: Path, cameras: Sequence[str]) -> RigCalibration:
    """The calibration of a rig with these cameras. Raises InputError where it cannot be used or is of others."""
    with guard(path, _REMEDY):
        if path.is_dir():
            found = _rectified(path, cameras)
        else:
            require_regular_file(path, "a calibration")
            document = from_yaml(path.read_text(encoding="utf-8-sig"))
            chain = {name: value for name, value in document.items() if isinstance(value, dict) and _kalibr(value)}
            found = _chained(document, list(chain.values())) if chain else _stereo(document)
        if len(found.lenses) != len(cameras):
            raise ValueError(f"it has {len(found.lenses)} cameras, and the rig {len(cameras)} ({', '.join(cameras)})")
        check_rig_poses(found.camera_from_rig)
        return found


def check_rig_poses(camera_from_rig: Float[np.ndarray, "s 4 4"]) -> None:
    """Raise ValueError for poses that are no rotations and translations, and for a camera where the first one is."""
    for pose in camera_from_rig:
        R = pose[:3, :3]
        if not np.isfinite(pose).all() or np.abs(R @ R.T - np.eye(3)).max() > _ORTHONORMAL or np.linalg.det(R) < 0:
            raise ValueError("a pose in it is no rotation and translation")
    if not np.linalg.norm(camera_from_rig[1:, :3, 3], axis=1).all():
        raise ValueError("two of its cameras are in one place")


def _kalibr(camera: Mapping[str, Any]) -> bool:
    return "intrinsics" in camera and "camera_model" in camera


def _chained(document: Mapping[str, Any], chain: list[dict[str, Any]]) -> RigCalibration:
    poses = [np.eye(4)]
    for number, camera in enumerate(chain[1:], 1):
        if "T_cn_cnm1" not in camera:
            raise ValueError(f"camera {number} has no T_cn_cnm1, its pose from the camera before it")
        poses.append(_numbers(camera["T_cn_cnm1"], (4, 4)) @ poses[-1])
    return RigCalibration(tuple(read_document(document)), np.stack(poses))


def _stereo(document: Mapping[str, Any]) -> RigCalibration:
    values = {str(name).lower(): value for name, value in document.items()}
    if "r" not in values or "t" not in values:
        raise ValueError("it has no R and T of a second camera")
    pose = np.eye(4)
    pose[:3, :3], pose[:3, 3] = _numbers(values["r"], (3, 3)), _numbers(values["t"], (3,))
    lenses = sorted(read_document(document), key=lambda lens: lens.name)  # 1 before 2 and left before right
    return RigCalibration(tuple(lenses), np.stack([np.eye(4), pose]))


def _rectified(folder: Path, cameras: Sequence[str]) -> RigCalibration:
    documents = []
    for name in cameras:
        file = next((folder / f"{name}{end}" for end in (".yaml", ".yml") if (folder / f"{name}{end}").is_file()), None)
        if file is None:
            raise ValueError(f"it has no {name}.yaml")
        documents.append(from_yaml(file.read_text(encoding="utf-8-sig")))
    lenses = tuple(read_document(document)[0] for document in documents)
    return RigCalibration(lenses, rectified_poses(documents))


def rectified_poses(documents: Sequence[Mapping[str, Any]]) -> Float[np.ndarray, "s 4 4"]:
    """camera_from_rig of cameras whose camera_info is given. Raises ValueError where one has no R or P."""
    rectified, offsets = [], []
    for document in documents:
        P = _numbers(_first(document, "projection_matrix", "P", "p"), (3, 4))
        if not P[0, 0] * P[1, 1]:
            raise ValueError("a projection_matrix in it is zero")
        rectified.append(_numbers(_first(document, "rectification_matrix", "R", "r"), (3, 3)))
        offsets.append(np.array([-P[0, 3] / P[0, 0], -P[1, 3] / P[1, 1], 0.0]))
    poses = np.tile(np.eye(4), (len(documents), 1, 1))
    for k in range(1, len(documents)):
        poses[k, :3, :3] = rectified[k].T @ rectified[0]
        poses[k, :3, 3] = -rectified[k].T @ (offsets[k] - offsets[0])
    return poses


def _first(document: Mapping[str, Any], *names: str) -> Any:
    """The value of the first name that there is: of a file, of a message of ROS 1 or of one of ROS 2; else None."""
    return next((document[name] for name in names if name in document), None)


def _numbers(value: Any, shape: tuple[int, ...]) -> np.ndarray:
    """A matrix as rows, as one list, or as OpenCV's and ROS's mapping with `data`."""
    data = value["data"] if isinstance(value, dict) and "data" in value else value
    if data is None:
        raise ValueError("it has no rectification_matrix or projection_matrix")
    numbers = np.array(data, np.float64).reshape(-1)
    if len(numbers) != np.prod(shape):
        raise ValueError(f"a matrix in it has {len(numbers)} numbers, and {np.prod(shape)} are expected")
    return numbers.reshape(shape)
