"""Relative poses of a rig's cameras from poses that were found one by one, robustly, and the time between them.

Where the second camera is dt later, its center lies off the rig's by the way of the rig in that time. In the axes of
the first camera, with its velocity v and turn R at an instant,

    R^T (c_2 - c_1) = b + dt R^T v

so that b and dt follow from all instants by least squares, as long as the velocity changes its direction or its size.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
import torch
from jaxtyping import Float, Int
from torch import Tensor

from swimm3r.geometry import mean_rotation, pose_from, relative_poses, rotation_angle
from swimm3r.scene.frames import Frames
from swimm3r.scene.reconstruction import QualityWarning, Reconstruction

LEAST = 3  # instants that tell the pose of one camera from another
_ROUNDS = 10
_TUNING = 2.0  # of the weights, in median residuals


@dataclass(frozen=True)
class RigRows:
    """The placed frames of a clip by camera and instant."""

    camera: Int[np.ndarray, " c"]  # of the rig, by the position of its name
    instant: Int[np.ndarray, " c"]  # from 0 without gaps, in time order
    time: Float[np.ndarray, " i"]  # of each instant, seconds

    def at(self, camera: int) -> dict[int, int]:
        """Row of each instant at which a camera has a pose."""
        rows = np.flatnonzero(self.camera == camera)
        return {int(self.instant[row]): int(row) for row in rows}


@dataclass(frozen=True)
class Delay:
    """Time by which a camera is later than the first, with its standard deviation, in the unit of the frames' times."""

    seconds: float
    std: float


def rig_rows(names: Sequence[str], frames: Frames) -> RigRows:
    """Camera and instant of the frames of these names."""
    assert frames.rig is not None
    own = [frames.frames[frames.index(name)] for name in names]
    numbers = sorted({frame.instant for frame in own if frame.instant is not None})
    times = {frame.instant: frame.time for frame in reversed(own)}
    return RigRows(
        np.array([frames.rig.names.index(frame.camera or "") for frame in own]),
        np.array([numbers.index(frame.instant or 0) for frame in own]),
        np.array([times[number] for number in numbers]),
    )


def with_loose_rig(rec: Reconstruction) -> Reconstruction:
    """The reconstruction, with a warning that its cameras are those of a rig and were placed one by one."""
    warning = QualityWarning(
        "The images are of a rig, whose cameras were placed one by one: they are not adjusted with one pose per"
        " instant, and no baseline gives their scale.",
        "Only COLMAP's mapping adjusts a rig, and not behind a port: --backend colmap, without --housing. --rig none"
        " takes the images of one camera after the other.",
    )
    return replace(rec, warnings=(*rec.warnings, warning))


def relative_to_first(cam2world: Float[Tensor, "c 4 4"], rows: RigRows, camera: int) -> Float[Tensor, "n 4 4"]:
    """Pose of a camera in the axes of the first (from its points to the first's), at every instant with both."""
    first, other = rows.at(0), rows.at(camera)
    both = sorted(first.keys() & other.keys())
    return relative_poses(cam2world[[first[i] for i in both]], cam2world[[other[i] for i in both]])


def robust_mean(poses: Float[Tensor, "n 4 4"]) -> Float[Tensor, "4 4"]:
    """The pose that most of some poses agree on: mean rotation and translation with Cauchy's weights, reweighted."""
    R, t = poses[:, :3, :3], poses[:, :3, 3]
    middle, center = R[_medoid(R)], t.median(0).values
    for _ in range(_ROUNDS):
        turn = rotation_angle(middle.mT @ R)
        away = torch.linalg.vector_norm(t - center, dim=1)
        middle = mean_rotation(R * _weights(turn)[:, None, None])
        w = _weights(away)
        center = (w[:, None] * t).sum(0) / w.sum()
    return pose_from(middle, center)


def relative_scatter(lengths: Float[np.ndarray, " n"]) -> float:
    """Relative standard deviation of the mean of lengths along a clip whose neighbors err alike.

    Of n values with a correlation r between neighbors, n (1 - r) / (1 + r) are independent.
    """
    logs = np.log(lengths / np.median(lengths))
    spread = 1.4826 * float(np.median(np.abs(logs - np.median(logs))))
    kept = np.clip(logs - np.median(logs), -3 * spread, 3 * spread)
    r = float((kept[1:] @ kept[:-1]) / max(kept @ kept, 1e-30)) if len(kept) > 2 else 0.0
    independent = max(2.0, len(kept) * (1 - max(r, 0.0)) / (1 + max(r, 0.0)))
    return max(spread / np.sqrt(independent), 1e-6)


def delay_of(cam2world: Float[Tensor, "c 4 4"], rows: RigRows, camera: int) -> Delay | None:
    """Time by which a camera is later than the first; None where the path does not tell."""
    first, other = rows.at(0), rows.at(camera)
    poses, blocks, values = cam2world.double().numpy(), [], []
    for i in sorted(first.keys() & other.keys()):
        if i - 1 not in first or i + 1 not in first:
            continue
        before, here, after = (poses[first[k]] for k in (i - 1, i, i + 1))
        velocity = (after[:3, 3] - before[:3, 3]) / max(rows.time[i + 1] - rows.time[i - 1], 1e-9)
        blocks.append(np.column_stack([np.eye(3), here[:3, :3].T @ velocity]))
        values.append(here[:3, :3].T @ (poses[other[i]][:3, 3] - here[:3, 3]))
    if len(blocks) < LEAST:
        return None
    A, y = np.concatenate(blocks), np.concatenate(values)
    found, *_ = np.linalg.lstsq(A, y, rcond=None)
    noise = float(((A @ found - y) ** 2).sum()) / max(1, len(y) - 4)
    covariance = noise * np.linalg.pinv(A.T @ A)
    return Delay(float(found[3]), float(np.sqrt(covariance[3, 3])))


def _medoid(R: Float[Tensor, "n 3 3"]) -> int:
    """The rotation with the least sum of angles to the others."""
    return int(rotation_angle(R[:, None].mT @ R[None]).sum(1).argmin())


def _weights(away: Float[Tensor, " n"]) -> Float[Tensor, " n"]:
    width = _TUNING * away.median().clamp(min=1e-12)
    return 1 / (1 + (away / width) ** 2)
