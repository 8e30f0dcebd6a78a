"""Motion of an image by the camera's rotation alone, from the gyroscope: x' = K R^T K^-1 x, whatever the distance.

The delay of the sensor is not known before structure from motion, and the focal length only where the lens was
calibrated. Both follow from the median displacement u_i of corners from frame i to i + 1 and the direction p_i in which
the gyroscope says that the middle of frame i is then seen (in units of the focal length): translation is smooth, hands
and thrusters are not, so that

    u_i+1 - u_i = f (p_i+1 - p_i) + ...

by least squares, at the delay at which the two go together best. A camera that sways as it turns moves the image by
both: where that makes a focal length which no lens has, the motion by rotation is known for a calibrated lens alone,
whose distortion then counts, too.
"""

import logging
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np
import torch
from jaxtyping import Bool, Float

from swimm3r.cameras import Cameras, directions, project, resized
from swimm3r.io.telemetry.gyroscope import Gyroscope
from swimm3r.prepare.keyframes import Gray, Points, median_flow

_DELAYS = np.arange(-8, 9) * 0.025  # seconds
_CORRELATED = 0.7  # between changes of displacement and of rotation, from which a gyroscope is that of the images
_FEWEST = 10  # changes that tell the focal length
_MOST = 200  # pairs of frames that are looked at
_ROUNDS = 3  # of the focal length
_FOCALS = 0.4, 4.0  # by the longer side: fields of view of 103 and 14 degrees

log = logging.getLogger(__name__)


@dataclass(frozen=True)
class RotationMotion:
    """Motion by rotation between the frames of a clip, in pixels of their small copies."""

    gyroscope: Gyroscope
    times: tuple[float, ...]  # of the frames, seconds
    lens: Cameras  # one at the origin
    delay: float  # seconds by which the gyroscope is late

    def moved(self, i: int, j: int, xy: Points) -> Points:
        """Places in frame j of points of frame i, had the camera only turned; NaN where the lens has no ray.

        The center of the first pixel is (0, 0), as corners are found.
        """
        rays = directions(self.lens, torch.from_numpy(xy + 0.5)[None].double())[0].numpy()
        turned = rays @ self.gyroscope.turn(self.times[i] + self.delay, self.times[j] + self.delay)
        turned[:, 2] = np.maximum(turned[:, 2], 1e-3)
        return project(self.lens, torch.from_numpy(turned)[None])[0][0].numpy() - 0.5


def rotation_motion(
    gyroscope: Gyroscope, times: Sequence[float], gray_of: Callable[[int], Gray], lens: Cameras | None = None
) -> RotationMotion | None:
    """The motion by rotation of frames at these times; None where the images do not move as the gyroscope says.

    `gray_of` gives a small gray copy of a frame; `lens` is that of the frames in any size, where it is known.
    """
    count = len(times)
    starts = range(max(0, (count - _MOST) // 2), min(count - 1, (count + _MOST) // 2))
    moved = [median_flow(gray_of(i), gray_of(i + 1)) for i in starts]
    flows = np.array([(np.nan, np.nan) if each is None else each for each in moved]).reshape(-1, 2)
    changes = np.diff(flows, axis=0)
    known = np.isfinite(changes).all(axis=1).reshape(-1)
    if known.sum() < _FEWEST:
        return None
    u, best = changes[known].ravel(), (0.0, 0.0, 0.0)
    for delay in _DELAYS.tolist():
        ahead = np.array([_ahead(gyroscope.turn(times[i] + delay, times[i + 1] + delay)) for i in starts])
        p = np.diff(ahead, axis=0)[known].ravel()
        together = float(u @ p) / max(float(np.linalg.norm(u) * np.linalg.norm(p)), 1e-12)
        if together > best[0]:
            best = together, float(u @ p) / float(p @ p), delay
    together, focal, delay = best
    if together < _CORRELATED:
        log.info("keyframes without the gyroscope: the images move otherwise (correlation %.2f)", together)
        return None
    height, width = gray_of(starts[0]).shape
    if lens is not None:
        motion = RotationMotion(gyroscope, tuple(times), resized(lens, width, height), delay)
    else:
        motion = RotationMotion(gyroscope, tuple(times), _pinhole(focal, width, height), delay)
        motion = _with_fitted_focal(motion, starts, u, known)
    focal = float(motion.lens.K[0, 0, 0])
    log.info(
        "gyroscope: %.3f s late, correlation %.2f with the images; focal length %.0f px, %s, in images %d px wide",
        *(delay, together, focal, "fitted" if lens is None else "that of the lens", width),
    )
    low, high = (share * max(height, width) for share in _FOCALS)
    if lens is None and not low <= focal <= high:
        log.info("keyframes without the gyroscope: no lens has that focal length; a calibrated one takes its place")
        return None
    return motion


def _pinhole(focal: float, width: int, height: int) -> Cameras:
    K = torch.tensor([[[focal, 0, width / 2], [0, focal, height / 2], [0, 0, 1]]], dtype=torch.float64)
    return Cameras(K, K.new_zeros(1, 0), torch.eye(4, dtype=K.dtype)[None], width, height)


def _with_fitted_focal(
    motion: RotationMotion, starts: range, u: Float[np.ndarray, " changes"], known: Bool[np.ndarray, " pairs"]
) -> RotationMotion:
    """The motion with the focal length of the whole image: off its middle an image moves more."""
    for _ in range(_ROUNDS):
        expected = np.diff([_median_flow(motion, i) for i in starts], axis=0)[known].ravel()
        by = float(u @ expected) / float(expected @ expected)
        focal, lens = by * float(motion.lens.K[0, 0, 0]), motion.lens
        motion = replace(motion, lens=_pinhole(focal, lens.width, lens.height))
    return motion


def _ahead(turn: Float[np.ndarray, "3 3"]) -> Float[np.ndarray, "2"]:
    """Place in the second image of the first one's middle, at focal length 1."""
    x, y, z = turn[2]  # R^T (0, 0, 1)
    return np.array([x, y]) / max(z, 1e-3)


def _median_flow(motion: RotationMotion, i: int) -> Float[np.ndarray, "2"]:
    """Median displacement over the image from frame i to the next, pixels."""
    steps = np.linspace(0.025, 0.975, 8)
    grid = np.stack(np.meshgrid(motion.lens.width * steps, motion.lens.height * steps), -1).reshape(-1, 2)
    return np.median(motion.moved(i, i + 1, grid) - grid, axis=0)
