"""camera_info messages -> the text of a ROS camera_info file, which `--calibration` reads."""

from typing import Any

import numpy as np
import yaml


def lens_text(info: Any, name: str, *, rectified: bool = False) -> str:
    """The YAML of a message under this name, in the size it was made at.

    Images of a part of the sensor (roi) have a lens and a size of their own. `rectified` images are those of the
    projection matrix, without distortion. Raises ValueError where the camera is not calibrated.
    """
    K, D, R, P = (np.asarray(_either(info, letter), np.float64) for letter in ("k", "d", "r", "p"))
    model = str(info.distortion_model)
    if rectified:
        K, D, model, R = P.reshape(3, 4)[:, :3].ravel(), np.zeros(0), "", np.eye(3).ravel()
    if not K[0]:
        raise ValueError("it is not calibrated (its matrix is zero)")
    width, height, roi = int(info.width), int(info.height), info.roi
    if roi.width and roi.height and (roi.width, roi.height) != (width, height):
        K = K - [0, 0, roi.x_offset, 0, 0, roi.y_offset, 0, 0, 0]
        width, height = int(roi.width), int(roi.height)
    return yaml.safe_dump(
        {
            "image_width": width,
            "image_height": height,
            "camera_name": name.strip("/").replace("/", "_"),
            "camera_matrix": {"rows": 3, "cols": 3, "data": K.tolist()},
            "distortion_model": model,
            "distortion_coefficients": {"rows": 1, "cols": len(D), "data": D.tolist()},
            "rectification_matrix": {"rows": 3, "cols": 3, "data": R.tolist()},
            "projection_matrix": {"rows": 3, "cols": 4, "data": P.tolist()},
        },
        sort_keys=False,
    )


def _either(info: Any, letter: str) -> Any:
    """A field that version 1 writes in capitals and version 2 does not."""
    return getattr(info, letter) if hasattr(info, letter) else getattr(info, letter.upper())
