"""Keyframes of a long, dense clip: frames that the camera's motion sets apart, the sharpest of those that would do.

Motion is the median displacement of corners tracked from the last keyframe (Lucas-Kanade), as a share of the longer
side. So the number of keyframes follows the ground that a dive covers, not the rate of its frames.
"""

from collections.abc import Callable, Sequence

import numpy as np
from jaxtyping import Bool, Float, UInt8

from swimm3r.progress import Progress, silent

_STEP = "choosing keyframes"
SIDE = 320  # pixels, the longer side of the copies on which motion is measured
_CORNERS = 300
_FEW = 12  # tracked corners below which two frames have too little in common to measure it
_LOST = 0.5  # share of the corners that may be lost before the view counts as another
_CONSISTENT = 1.0  # pixels between a corner and where it returns to when tracked there and back
_WINDOW, _LEVELS = (15, 15), 4  # pixels of Lucas-Kanade's window, and halvings
_FROM = 0.7  # share of the wanted motion from which a sharper frame is taken instead


def choose_keyframes(
    count: int,
    gray_of: Callable[[int], UInt8[np.ndarray, "h w"]],
    sharpness: Sequence[float],
    motion: float,
    progress: Progress = silent,
) -> list[int]:
    """Indices of the keyframes among frames 0..count-1, the first and the last among them.

    `gray_of` gives a small gray copy; `motion` is the share of its longer side that a camera moves the image between
    keyframes, at most where a single step is not larger.
    """
    chosen = [0]
    last = gray_of(0)
    candidates: list[int] = []
    i = 1
    while i < count:
        progress(_STEP, i, count)
        moved = displacement(last, gray_of(i))
        if moved is not None and moved < motion:
            if moved >= _FROM * motion:
                candidates.append(i)
            i += 1
            continue
        # this one is too far: the sharpest of those that would do, else the one before it, else itself
        before = [i - 1] if i - 1 > chosen[-1] else [i]
        following = max(candidates or before, key=lambda k: (sharpness[k], k))
        chosen.append(following)
        last, candidates, i = gray_of(following), [], following + 1
    if count > 1 and chosen[-1] != count - 1:
        chosen.append(count - 1)
    progress(_STEP, count, count)
    return chosen


def displacement(before: UInt8[np.ndarray, "h w"], after: UInt8[np.ndarray, "h w"]) -> float | None:
    """Median displacement of tracked corners, as a share of the longer side; None where too few are found again."""
    import cv2

    corners = cv2.goodFeaturesToTrack(before, _CORNERS, 0.005, 5)
    if corners is None or len(corners) < _FEW:
        return None
    there, found = tracked(before, after, corners[:, 0])
    if found.sum() < max(_FEW, _LOST * len(corners)):
        return None
    return float(np.median(np.linalg.norm((there - corners[:, 0])[found], axis=1)) / max(before.shape))


def tracked(
    before: UInt8[np.ndarray, "h w"], after: UInt8[np.ndarray, "h w"], xy: Float[np.ndarray, "n 2"]
) -> tuple[Float[np.ndarray, "n 2"], Bool[np.ndarray, " n"]]:
    """Positions of points in another image, and whether each is found: tracked back, it returns to where it was."""
    import cv2

    start = np.ascontiguousarray(xy, np.float32)[:, None]
    there, found, _ = cv2.calcOpticalFlowPyrLK(before, after, start, start.copy(), winSize=_WINDOW, maxLevel=_LEVELS)
    back, returned, _ = cv2.calcOpticalFlowPyrLK(after, before, there, there.copy(), winSize=_WINDOW, maxLevel=_LEVELS)
    returns = np.linalg.norm(back[:, 0] - xy, axis=1) < _CONSISTENT
    return there[:, 0], (found[:, 0] > 0) & (returned[:, 0] > 0) & returns
