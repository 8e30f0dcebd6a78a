"""Several cameras that are fixed to each other: the cameras of a rig, and where a reconstruction found them.

The axes of a rig are those of its first camera. `camera_from_rig` takes points of the rig to those of a camera, so the
center of camera k lies at -R_k^T t_k in the rig, and the baseline of k is the length of t_k.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import groupby

import numpy as np
import torch

from swimm3r.cameras import check_poses
from swimm3r.io.calibration.colmap_text import read

Row = tuple[float, float, float, float]
Pose = tuple[Row, Row, Row, Row]


@dataclass(frozen=True)
class RigCamera:
    """A camera of a rig as its source has it."""

    name: str
    camera_from_rig: Pose | None = None  # calibrated, metres; None where it is not known
    lens: str | None = None  # calibrated, a line of COLMAP's cameras.txt in pixels of the source; None where not known

    def __post_init__(self) -> None:
        if self.lens is not None and len(read(self.lens)) != 1:
            raise ValueError(f"a camera of a rig has one lens, got {self.lens!r}")
        if self.camera_from_rig is not None:
            check_poses(torch.tensor([self.camera_from_rig], dtype=torch.float64))

    @property
    def baseline(self) -> float | None:
        """Calibrated distance from the first camera, in metres; None where it is not known."""
        return None if self.camera_from_rig is None else float(np.linalg.norm(np.array(self.camera_from_rig)[:3, 3]))


@dataclass(frozen=True)
class Rig:
    """The cameras of a clip; the first one's axes are those of the rig."""

    cameras: tuple[RigCamera, ...]

    def __post_init__(self) -> None:
        if len(self.cameras) < 2 or len(set(self.names)) < len(self.cameras):
            raise ValueError(f"a rig has two and more cameras of different names, got {', '.join(self.names)}")

    @property
    def names(self) -> tuple[str, ...]:
        """Names of the cameras."""
        return tuple(camera.name for camera in self.cameras)


@dataclass(frozen=True)
class PlacedCamera:
    """A camera of a rig as a reconstruction found it."""

    name: str
    camera_from_rig: Pose  # lengths in the unit of the reconstruction
    instants: int  # at which it and the first camera both have a pose
    baseline: float  # distance from the first camera, in the unit of the reconstruction; 0 of the first
    baseline_std: float  # relative
    known_baseline: float | None = None  # calibrated, metres
    delay: float | None = None  # by which its images are later than the first's, by the path before; None where untold
    delay_std: float | None = None  # in the unit of the frames' times, as the delay


@dataclass(frozen=True)
class RigFit:
    """The rig of a reconstruction."""

    cameras: tuple[PlacedCamera, ...]
    rigid: bool  # poses are those of a rigid rig; False where the images contradict one, and poses are as without it
    free_px: float  # median reprojection error with poses of their own
    rig_px: float  # the same with those of a rig

    @property
    def names(self) -> tuple[str, ...]:
        """Names of the cameras."""
        return tuple(camera.name for camera in self.cameras)


def pose_of(matrix: np.ndarray) -> Pose:
    """A 4 x 4 matrix as a record holds it."""
    a, b, c, d = ((float(w), float(x), float(y), float(z)) for w, x, y, z in np.asarray(matrix, np.float64))
    return a, b, c, d


def first_of_instants(instants: Sequence[int | None]) -> list[int]:
    """Positions at which a new instant begins, in a list where images of one instant are neighbors.

    Images without an instant are one each.
    """
    keys = [(i, None) if instant is None else (None, instant) for i, instant in enumerate(instants)]
    starts, at = [], 0
    for _, group in groupby(keys):
        starts.append(at)
        at += sum(1 for _ in group)
    return starts
