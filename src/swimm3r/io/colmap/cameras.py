"""COLMAP's cameras <-> a camera model of `cameras`, K and distortion.

A pinhole or radial lens that `cameras` does not name is the same lens written as OPENCV with zeros:

    SIMPLE_PINHOLE f cx cy -> PINHOLE        RADIAL k1 k2 -> OPENCV k1 k2 0 0
"""

from typing import TYPE_CHECKING

import numpy as np
import torch

from swimm3r.cameras import DISTORTION_PARAMETERS, CameraArrays, Cameras
from swimm3r.errors import InputError

if TYPE_CHECKING:
    import pycolmap

_FOCALS = {"SIMPLE_PINHOLE": 1, "SIMPLE_RADIAL": 1, "RADIAL": 1, "PINHOLE": 2, "OPENCV": 2, "OPENCV_FISHEYE": 2}


def to_pycolmap_camera(cameras: Cameras | CameraArrays, i: int = 0) -> "pycolmap.Camera":
    """The lens of camera i, with the id i + 1."""
    import pycolmap

    K, distortion = (np.asarray(values[i], np.float64) for values in (cameras.K, cameras.distortion))
    model = cameras.model
    if model == "SIMPLE_RADIAL" and K[0, 0] != K[1, 1]:  # after an uneven resize; COLMAP's has one focal length
        model, distortion = "OPENCV", np.concatenate([distortion, np.zeros(3)])
    focal = [K[0, 0]] if model == "SIMPLE_RADIAL" else [K[0, 0], K[1, 1]]
    params = np.array([*focal, K[0, 2], K[1, 2], *distortion])
    return pycolmap.Camera(model=model, width=cameras.width, height=cameras.height, params=params, camera_id=i + 1)


def from_pycolmap_camera(camera: "pycolmap.Camera", model: str) -> tuple[np.ndarray, np.ndarray]:
    """K [3, 3] and distortion [d] of a camera under `model`, its own or one that has it as a special case."""
    focals = _FOCALS[camera.model.name]
    f, c, k = camera.params[:focals], camera.params[focals : focals + 2], camera.params[focals + 2 :]
    K = np.array([[f[0], 0, c[0]], [0, f[-1], c[1]], [0, 0, 1]])
    return K, np.concatenate([k, np.zeros(len(DISTORTION_PARAMETERS[model]) - len(k))])


def under_model(camera: "pycolmap.Camera", model: str) -> "pycolmap.Camera":
    """The same lens written as another model that has it as a special case, with the id 1."""
    K, distortion = (torch.from_numpy(values)[None] for values in from_pycolmap_camera(camera, model))
    origin = torch.eye(4, dtype=torch.float64)[None]
    return to_pycolmap_camera(Cameras(K, distortion, origin, camera.width, camera.height, model))


def common_model(models: set[str]) -> str:
    """The one camera model that can express all of COLMAP's `models`; InputError where there is none."""
    unknown = models - set(_FOCALS)
    if unknown or ("OPENCV_FISHEYE" in models and len(models) > 1):
        raise InputError(
            f"the COLMAP model has lenses that cannot be read together: {', '.join(sorted(models))}",
            cause=f"readable are {', '.join(sorted(_FOCALS))}, fisheye not mixed with others",
            hint="undistort the images first (colmap image_undistorter), which leaves PINHOLE cameras",
        )
    if models <= {"SIMPLE_PINHOLE", "PINHOLE"}:
        return "PINHOLE"
    return models.pop() if len(models) == 1 and "RADIAL" not in models else "OPENCV"
