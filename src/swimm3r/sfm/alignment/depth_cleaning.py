"""Dense depth of aligned frames: block depths with the canonical view's shape, cleaned by what other frames see.

A pixel's point that would stand before the surface of another frame, which is surer of what it sees there, is a
floater: its depth becomes unknown. Only frames that were compared with each other are asked, so the cost grows with the
number of pairs, not with the square of the number of frames.
"""

from collections.abc import Callable, Sequence

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from swimm3r.cameras import Cameras, pixel_grid, project_visible, unproject
from swimm3r.io.files.cache import ArrayCache
from swimm3r.progress import Progress, silent

_IN_FRONT = 1e-3  # relative depth by which a point must be nearer to be in the way


def confidence_share(confidence: Float[Tensor, "h w"]) -> Float[Tensor, "h w"]:
    """The network's confidence c >= 1 as a number in 0..1: 1 - 1/c."""
    return 1 - 1 / confidence.clamp(min=1)


def clean_confidence(
    i: int,
    neighbors: Sequence[int],
    cameras: Cameras,
    view: Callable[[int], tuple[Float[Tensor, "h w"], Float[Tensor, "h w"]]],
) -> Float[Tensor, "h w"]:
    """The confidence of frame i, 0 where its points are in a neighbor's way; `view` gives z depth and confidence."""
    z_depth, confidence = view(i)
    height, width = z_depth.shape
    grid = pixel_grid(height, width).reshape(1, -1, 2).double()
    points = unproject(cameras[i], grid, z_depth.reshape(1, -1).double())[0]
    mine = confidence.reshape(-1).clone()
    for j in neighbors:
        uv, z, visible = project_visible(cameras[j], points[None])
        seen = visible[0]
        column, row = uv[0, seen].long().unbind(-1)
        at = row * width + column
        other_z, other_confidence = (value.reshape(-1) for value in view(j))
        in_front = z[0][seen] < (1 - _IN_FRONT) * other_z[at]
        hit = torch.nonzero(seen)[:, 0][in_front & (mine[seen] < other_confidence[at])]
        mine[hit] = 0
    return mine.reshape(height, width)


def cleaned(
    frames: Sequence[int],
    neighbors: Sequence[Sequence[int]],
    cameras: Cameras,
    load: Callable[[int], tuple[Float[Tensor, "h w"], Float[Tensor, "h w"]]],
    max_bytes: int,
    finish: Callable[[int, Float[Tensor, "h w"], Float[Tensor, "h w"]], None],
    progress: Progress = silent,
) -> None:
    """Calls `finish(i, z_depth, confidence)` for every frame, with no more than `max_bytes` of maps held."""
    held = ArrayCache(max_bytes)

    def view(i: int) -> tuple[Tensor, Tensor]:
        def read() -> tuple[np.ndarray, ...]:
            z_depth, confidence = load(i)
            return z_depth.numpy(), confidence.numpy()

        z_depth, confidence = (torch.from_numpy(array.copy()) for array in held.get(i, read))
        return z_depth, confidence

    for done, i in enumerate(frames):
        progress("depth", done, len(frames))
        finish(i, view(i)[0], clean_confidence(i, neighbors[i], cameras, view))
    progress("depth", len(frames), len(frames))
