"""Up in the axes of a reconstruction, by the gravity that the camera measured in each frame.

    up = sum_i w_i R_i u_i / |...|,   u_i in the axes of image i, R_i camera to world

Frames further off than usual count less. Measurements that contradict the poses are no direction: a stabilized video
turns its images, and an accelerometer in a jerking hand measures the hand.
"""

from dataclasses import replace

import numpy as np

from swimm3r.scene.frames import Frames
from swimm3r.scene.reconstruction import Reconstruction

_FEWEST = 3  # frames with a measurement
_APART = 5.0  # degrees from the mean, in the median, beyond which the measurements tell nothing
_ROUNDS = 10


def with_measured_up(rec: Reconstruction, frames: Frames) -> Reconstruction:
    """The reconstruction with `up` where its frames carry measurements that agree with its poses."""
    ups = {frame.name: frame.up for frame in frames if frame.up is not None}
    rows = [i for i, name in enumerate(rec.names) if name in ups]
    if len(rows) < _FEWEST:
        return rec
    rotations = rec.cameras.cam2world[rows, :3, :3].double().numpy()
    directions = np.einsum("nij,nj->ni", rotations, np.array([ups[rec.names[i]] for i in rows]))
    mean = directions.mean(0)
    for _ in range(_ROUNDS):
        mean = mean / max(float(np.linalg.norm(mean)), 1e-12)
        away = np.degrees(np.arccos(np.clip(directions @ mean, -1, 1)))
        weight = 1 / (1 + (away / (1.5 * np.median(away) + 1e-9)) ** 2)
        mean = weight @ directions
    mean = mean / max(float(np.linalg.norm(mean)), 1e-12)
    if np.median(np.degrees(np.arccos(np.clip(directions @ mean, -1, 1)))) > _APART:
        return rec
    x, y, z = mean.tolist()
    return replace(rec, up=(x, y, z))
