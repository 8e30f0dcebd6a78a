"""The diver's path: one smooth loop over the terrace, looking ahead and down, coming back to where it began."""

import numpy as np
from scipy import ndimage

from swimm3r.synthetic.seafloor import Seafloor, height_at

CLEARANCE = 0.65  # m above what is below, after smoothing


def camera_path(floor: Seafloor, frames: int, seed: int) -> np.ndarray:
    """cam2world [frames, 4, 4] (OpenCV axes) along the loop."""
    rng = np.random.default_rng([seed, 1])
    phase = rng.uniform(-0.3, 0.3, 6)
    fine = np.arange(512) / 512
    turn = 2 * np.pi * fine
    x = 1.35 * np.sin(turn + phase[0]) + 0.15 * np.sin(3 * turn + phase[1])
    y = 0.25 - 0.75 * np.cos(turn) + 0.18 * np.sin(2 * turn + phase[2])
    ring = np.linspace(0, 2 * np.pi, 12, endpoint=False)
    around = [height_at(floor, x + r * np.cos(a), y + r * np.sin(a)) for r in (0.0, 0.25, 0.5) for a in ring]
    below = ndimage.gaussian_filter1d(np.max(around, axis=0), 40, mode="wrap")
    z = below + CLEARANCE + 0.16 * np.sin(2 * turn + phase[3]) + 0.1
    at = np.arange(frames) * len(fine) // max(frames, 1)
    yaw = 0.30 * np.sin(turn + np.pi + phase[4]) + 0.10 * np.sin(2 * turn + phase[5])
    pitch = np.radians(20) + np.radians(4) * np.sin(2 * turn + phase[1])
    roll = np.radians(5) * np.sin(turn + phase[2]) + np.radians(2.5) * np.sin(3 * turn + phase[0])
    poses = np.tile(np.eye(4), (frames, 1, 1))
    for pose, k in zip(poses, at, strict=True):
        forward = np.array([np.sin(yaw[k]) * np.cos(pitch[k]), np.cos(yaw[k]) * np.cos(pitch[k]), -np.sin(pitch[k])])
        right = np.cross(forward, [0.0, 0.0, 1.0])
        right /= np.linalg.norm(right)
        down = np.cross(forward, right)
        c, s = np.cos(roll[k]), np.sin(roll[k])
        pose[:3, :3] = np.stack([c * right + s * down, c * down - s * right, forward], 1)
        pose[:3, 3] = x[k], y[k], z[k]
    return poses
