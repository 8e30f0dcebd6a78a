"""Keyframes of a long, dense clip: frames that the camera's motion sets apart, the sharpest of those that would do.

Motion is the median displacement of corners tracked from the last keyframe (Lucas-Kanade), as a share of the longer
side. So the number of keyframes follows the ground that a dive covers, not the rate of its frames. Rotation adds no
parallax: where it is known (`prepare.rotation`), displacement is that from where rotation alone takes a corner, and a
camera that only turns makes a new keyframe when the view of the last one is lost.
"""

from collections.abc import Callable, Sequence
from functools import partial

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

Gray = UInt8[np.ndarray, "h w"]
Points = Float[np.ndarray, "n 2"]


def choose_keyframes(
    count: int,
    gray_of: Callable[[int], Gray],
    sharpness: Sequence[float],
    motion: float,
    progress: Progress = silent,
    rotated: Callable[[int, int, Points], Points] | None = None,
) -> list[int]:
    """Indices of the keyframes among frames 0..count-1, the first and the last among them.

    `gray_of` gives a small gray copy; `motion` is the share of its longer side that a camera moves the image between
    keyframes, at most where a single step is not larger. `rotated` gives places in the second of two frames of points
    in the first, had the camera only turned.
    """
    chosen = [0]
    last = gray_of(0)
    candidates: list[int] = []
    i = 1
    while i < count:
        progress(_STEP, i, count)
        moved = displacement(last, gray_of(i), None if rotated is None else partial(rotated, chosen[-1], i))
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


def displacement(before: Gray, after: Gray, rotated: Callable[[Points], Points] | None = None) -> float | None:
    """Median displacement of tracked corners, as a share of the longer side; None where too few are found again.

    It is that from their places in the first image, or from where rotation alone takes them.
    """
    corners = _tracked_corners(before, after)
    if corners is None:
        return None
    here, there = corners
    expected = here if rotated is None else rotated(here)
    moved = np.linalg.norm(there - expected, axis=1)
    moved = moved[np.isfinite(moved)]
    return float(np.median(moved) / max(before.shape)) if len(moved) >= _FEW else None


def median_flow(before: Gray, after: Gray) -> Float[np.ndarray, "2"] | None:
    """Median displacement of tracked corners in x and y, pixels; None where too few are found again."""
    corners = _tracked_corners(before, after)
    return None if corners is None else np.median(corners[1] - corners[0], axis=0)


def _tracked_corners(before: Gray, after: Gray) -> tuple[Points, Points] | None:
    """Corners in two images; None where too few are found again."""
    import cv2

    corners = cv2.goodFeaturesToTrack(before, _CORNERS, 0.005, 5)
    if corners is None or len(corners) < _FEW:
        return None
    there, found = tracked(before, after, corners[:, 0])
    if found.sum() < max(_FEW, _LOST * len(corners)):
        return None
    return corners[found, 0], there[found]


def tracked(before: Gray, after: Gray, xy: Points) -> tuple[Points, Bool[np.ndarray, " n"]]:
    """Positions of points in another image, and whether each is found: tracked back, it returns to where it was."""
    import cv2

    start = np.ascontiguousarray(xy, np.float32)[:, None]
    there, found, _ = cv2.calcOpticalFlowPyrLK(before, after, start, start.copy(), winSize=_WINDOW, maxLevel=_LEVELS)
    back, returned, _ = cv2.calcOpticalFlowPyrLK(after, before, there, there.copy(), winSize=_WINDOW, maxLevel=_LEVELS)
    returns = np.linalg.norm(back[:, 0] - xy, axis=1) < _CONSISTENT
    return there[:, 0], (found[:, 0] > 0) & (returned[:, 0] > 0) & returns
