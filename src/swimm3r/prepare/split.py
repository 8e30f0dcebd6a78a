"""The part of every frame: training, testing, or between keyframes.

Every 8th keyframe is held back for testing, as the paper and 3DGS count. Stills of a survey that overlap by half are a
chain: without one of them its neighbors have no ground in common that a third frame sees, and the chain breaks. Such a
frame is not held back. The shift between neighbors is that of their phase correlation, and counts where its peak is
clear.
"""

from collections.abc import Callable, Sequence

import numpy as np
from jaxtyping import Float

from swimm3r.prepare.keyframes import Gray, choose_keyframes
from swimm3r.prepare.rotation import RotationMotion
from swimm3r.progress import Progress
from swimm3r.scene.frames import Part
from swimm3r.scene.settings import FrameSettings

TEST_EVERY = 8  # index % 8 == 0 is held back
_LEAST_OVERLAP = 0.5  # of the neighbors of a frame that is held back
_CLEAR_PEAK = 0.15  # response of the phase correlation; frames that share nothing have 0.06 at most
_DETAIL = 12.0  # pixels of the small copy: light that varies more slowly is taken out


def split_frames(
    gray_of: Callable[[int], Gray],
    sharpness: Sequence[float],
    settings: FrameSettings,
    progress: Progress,
    *,
    ordered: bool,
    rotation: Callable[[Callable[[int], Gray]], RotationMotion | None] | None = None,
) -> list[Part]:
    """The part of each of the frames that have these sharpnesses; `gray_of` gives a small gray copy of one.

    `rotation` finds the motion of these copies by the camera's rotation, where it was measured.
    """
    count = len(sharpness)
    keyframes = list(range(count))
    if ordered and settings.keyframe_motion and count > settings.every_frame_to:
        turning = None if rotation is None else rotation(gray_of)
        rotated = None if turning is None else turning.moved
        keyframes = choose_keyframes(count, gray_of, sharpness, settings.keyframe_motion, progress, rotated)
    parts: list[Part] = ["between"] * count
    for k, i in enumerate(keyframes):
        if k % TEST_EVERY:
            parts[i] = "train"
            continue
        near = [keyframes[n] for n in (k - 1, k + 1) if 0 <= n < len(keyframes)]
        tested = k % TEST_EVERY == 0 and not (
            ordered and len(near) == 2 and _holds_a_chain(gray_of, near[0], i, near[1])
        )
        parts[i] = "test" if tested else "train"
    return parts


def _holds_a_chain(gray_of: Callable[[int], Gray], before: int, this: int, after: int) -> bool:
    """Return whether the frames before and after are known to overlap too little to do without the one between.

    Where one of the two shifts is not clear, it is taken to be like the other.
    """
    gray = gray_of(this)
    steps = [step for step in (shift(gray_of(before), gray), shift(gray, gray_of(after))) if step is not None]
    if not steps:
        return False
    height, width = gray.shape
    moved = 2 * np.abs(np.mean(steps, axis=0)) / (width, height)
    return float(np.prod(np.clip(1 - moved, 0, 1))) < _LEAST_OVERLAP


def shift(before: Gray, after: Gray) -> Float[np.ndarray, "2"] | None:
    """Translation between two images in pixels (x, y), None without a clear one."""
    import cv2

    window = cv2.createHanningWindow((before.shape[1], before.shape[0]), cv2.CV_32F)
    found, response = cv2.phaseCorrelate(_detail(before), _detail(after), window)
    return np.array(found) if response >= _CLEAR_PEAK else None


def _detail(gray: Gray) -> Float[np.ndarray, "h w"]:
    """Local contrast, evenly strong: neither a lamp's cone nor the shade at the border moves with the ground."""
    import cv2

    image = gray.astype(np.float32)
    image -= cv2.GaussianBlur(image, (0, 0), _DETAIL)
    return image / (np.sqrt(cv2.GaussianBlur(image * image, (0, 0), _DETAIL)) + 4)
