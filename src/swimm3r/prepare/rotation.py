"""Motion of an image by the camera's rotation alone, from the gyroscope: x' = K R^T K^-1 x, whatever the distance.

Neither focal length nor the delay of the sensor is known before structure from motion. Both follow from the median
displacement u_i of corners from frame i to i + 1 and the direction p_i in which the gyroscope says that the middle of
frame i is then seen (in units of the focal length): translation is smooth, hands and thrusters are not, so that

    u_i+1 - u_i = f (p_i+1 - p_i) + ...

by least squares, at the delay at which the two go together best. A camera that sways as it turns moves the image by
both: where that makes a focal length which no lens has, the motion by rotation is not known.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Float

from swimm3r.io.telemetry.gyroscope import Gyroscope
from swimm3r.prepare.keyframes import Gray, Points, median_flow

_DELAYS = np.arange(-8, 9) * 0.025  # seconds
_CORRELATED = 0.7  # between changes of displacement and of rotation, from which a gyroscope is that of the images
_FEWEST = 10  # changes that tell the focal length
_MOST = 200  # pairs of frames that are looked at
_ROUNDS = 3  # of the focal length
_FOCALS = 0.4, 4.0  # by the longer side: fields of view of 103 and 14 degrees


@dataclass(frozen=True)
class RotationMotion:
    """Motion by rotation between the frames of a clip, in pixels of their small copies."""

    gyroscope: Gyroscope
    times: tuple[float, ...]  # of the frames, seconds
    focal: float  # pixels
    delay: float  # seconds by which the gyroscope is late
    center: tuple[float, float]  # pixels

    def moved(self, i: int, j: int, xy: Points) -> Points:
        """Places in frame j of points of frame i, had the camera only turned."""
        rays = np.concatenate([(xy - self.center) / self.focal, np.ones((len(xy), 1))], 1)
        turned = rays @ self.gyroscope.turn(self.times[i] + self.delay, self.times[j] + self.delay)
        return self.focal * turned[:, :2] / np.maximum(turned[:, 2:], 1e-3) + self.center


def rotation_motion(
    gyroscope: Gyroscope, times: Sequence[float], gray_of: Callable[[int], Gray]
) -> RotationMotion | None:
    """The motion by rotation of frames at these times; None where the images do not move as the gyroscope says.

    `gray_of` gives a small gray copy of a frame.
    """
    count = len(times)
    starts = range(max(0, (count - _MOST) // 2), min(count - 1, (count + _MOST) // 2))
    moved = [median_flow(gray_of(i), gray_of(i + 1)) for i in starts]
    flows = np.array([(np.nan, np.nan) if each is None else each for each in moved]).reshape(-1, 2)
    changes = np.diff(flows, axis=0)
    known = np.isfinite(changes).all(1)
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
        return None
    height, width = gray_of(starts[0]).shape
    motion = RotationMotion(gyroscope, tuple(times), focal, delay, (width / 2, height / 2))
    for _ in range(_ROUNDS):  # off its middle an image moves more: the whole of it tells the focal length
        expected = np.diff([_median_flow(motion, i) for i in starts], axis=0)[known].ravel()
        motion = replace(motion, focal=motion.focal * float(u @ expected) / float(expected @ expected))
    low, high = (share * max(height, width) for share in _FOCALS)
    return motion if low <= motion.focal <= high else None


def _ahead(turn: Float[np.ndarray, "3 3"]) -> Float[np.ndarray, "2"]:
    """Place in the second image of the first one's middle, at focal length 1."""
    x, y, z = turn[2]  # R^T (0, 0, 1)
    return np.array([x, y]) / max(z, 1e-3)


def _median_flow(motion: RotationMotion, i: int) -> Float[np.ndarray, "2"]:
    """Median displacement over the image from frame i to the next, pixels."""
    (x, y), steps = motion.center, np.linspace(0.05, 1.95, 8)
    grid = np.stack(np.meshgrid(x * steps, y * steps), -1).reshape(-1, 2)
    return np.median(motion.moved(i, i + 1, grid) - grid, axis=0)
