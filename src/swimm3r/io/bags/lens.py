"""camera_info messages -> the text of a ROS camera_info file, which `--calibration` reads, and changes among them."""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import yaml

from swimm3r.io.calibration.documents import from_yaml, read_document


@dataclass(frozen=True)
class LensChange:
    """A camera_info that states another lens than the one before it."""

    time: float  # seconds of the clip
    before: str  # `lens_numbers`
    after: str


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


def lens_numbers(text: str) -> str:
    """The numbers of a lens in words, from the text of its file; equal lenses have equal words."""
    lens = read_document(from_yaml(text))[0]
    (fx, _, cx), (_, fy, cy), _ = lens.K
    bent = "".join(f" {value:.4g}" for value in (*lens.k, *lens.p, *lens.divisor) if value)
    return f"fx {fx:.6g} fy {fy:.6g} cx {cx:.6g} cy {cy:.6g} px" + (f" distortion{bent}" if bent else "")


def change_warning(topic: str, changes: Sequence[LensChange]) -> str:
    """The warning about a lens that changes at least once."""
    first = changes[0]
    at = math.floor(first.time * 1e3) / 1e3  # not later than the change, for --end
    times = f"changes {len(changes)} times, first" if len(changes) > 1 else "changes"
    return (
        f"The lens in {topic} {times} after {at:.10g} s, from {first.before} to {first.after}: the lens before that is"
        f" used for all images. Use --end {at:.10g} to stop before the change, or --no-camera-info."
    )
