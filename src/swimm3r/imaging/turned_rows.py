"""Images whose rows were exposed one after another while the camera turned, drawn anew as if exposed at once.

Row y of an image of H rows is exposed (y / H - 1/2) T after half time, T the time between the first and the last row.
A camera that turns by the rotation vector w (radians, in its own axes) within T sees along a pixel's ray d, of row y,
what it sees at half time along

    d' = exp((y / H - 1/2) w) d

at every distance. A move within T looks like a turn, too, but for differences of depth, which stay.
"""

from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Bool, Float, UInt8, UInt16
from scipy.spatial.transform import Rotation
from torch import Tensor

from swimm3r.cameras import Cameras, directions, pixel_grid, project

_TURNS = 4  # in which the row of a pixel as filmed is found: a thousandth of a pixel after the third

Image = UInt8[np.ndarray, "h w 3"] | UInt16[np.ndarray, "h w 3"] | Float[np.ndarray, "h w 3"]


@dataclass(frozen=True)
class RowTurns:
    """The turns of one camera while each of some frames was exposed."""

    lens: Cameras  # one camera, its pose unused
    turns: dict[str, Float[np.ndarray, "3"]]  # rotation vectors, radians in the camera's axes, by frame

    @property
    def typical(self) -> float:
        """Median angle in degrees."""
        return float(np.degrees(np.median([np.linalg.norm(turn) for turn in self.turns.values()])))


def half_time_pixels(camera: Cameras, xy: Float[Tensor, "m 2"], turn: Float[np.ndarray, "3"]) -> Float[Tensor, "m 2"]:
    """Pixels of one camera, as filmed, where the camera has the same directions at half time.

    `turn` is the rotation vector w, radians; NaN where no ray meets a pixel.
    """
    return _turned(camera, xy, xy[:, 1], turn)


def filmed_pixels(camera: Cameras, xy: Float[Tensor, "m 2"], turn: Float[np.ndarray, "3"]) -> Float[Tensor, "m 2"]:
    """The inverse of `half_time_pixels`."""
    filmed = xy.double()
    for _ in range(_TURNS):
        filmed = _turned(camera, xy, filmed[:, 1], -turn)
    return filmed


def at_half_time(image: Image, camera: Cameras, turn: Float[np.ndarray, "3"]) -> Image:
    """An image of one camera as exposed at half time, by Lanczos interpolation; its border goes on beyond it."""
    import cv2

    column, row = _grid(camera, turn)
    return cv2.remap(image, column, row, cv2.INTER_LANCZOS4, borderMode=cv2.BORDER_REPLICATE)


def mask_at_half_time(
    usable: Bool[np.ndarray, "h w"], camera: Cameras, turn: Float[np.ndarray, "3"]
) -> Bool[np.ndarray, "h w"]:
    """A mask of an image as that at half time has it; false where that shows more than was filmed."""
    import cv2

    column, row = _grid(camera, turn)
    return cv2.remap(usable.astype(np.uint8), column, row, cv2.INTER_NEAREST, borderValue=0) > 0


def mask_as_filmed(
    usable: Bool[np.ndarray, "h w"], camera: Cameras, turn: Float[np.ndarray, "3"]
) -> Bool[np.ndarray, "h w"]:
    """A mask of the image at half time as the one that was filmed has it, true where it lies beyond."""
    import cv2

    grid = pixel_grid(camera.height, camera.width).reshape(-1, 2).double()
    column, row = _maps(camera, half_time_pixels(camera, grid, turn))
    return cv2.remap(usable.astype(np.uint8), column, row, cv2.INTER_NEAREST, borderValue=1) > 0


def _turned(
    camera: Cameras, xy: Float[Tensor, "m 2"], row: Float[Tensor, " m"], turn: Float[np.ndarray, "3"]
) -> Float[Tensor, "m 2"]:
    """Pixels moved along with the rays of their camera, as far as it turns between half time and a row's exposure."""
    here = _at_origin(camera)
    rays = directions(here, xy.double()[None])[0]
    share = (row.double() / camera.height - 0.5).numpy()
    turned = Rotation.from_rotvec(share[:, None] * turn).as_matrix() @ rays.numpy()[..., None]
    return project(here, torch.from_numpy(turned[..., 0])[None])[0][0]


def _at_origin(camera: Cameras) -> Cameras:
    if len(camera) != 1:
        raise ValueError(f"one camera turns, got {len(camera)}")
    origin = torch.eye(4, dtype=torch.float64)[None]
    return Cameras(camera.K.double(), camera.distortion.double(), origin, camera.width, camera.height, camera.model)


def _grid(camera: Cameras, turn: Float[np.ndarray, "3"]) -> tuple[np.ndarray, np.ndarray]:
    grid = pixel_grid(camera.height, camera.width).reshape(-1, 2).double()
    return _maps(camera, filmed_pixels(camera, grid, turn))


def _maps(camera: Cameras, xy: Float[Tensor, "p 2"]) -> tuple[np.ndarray, np.ndarray]:
    """Column and row, 0 at the center of the first pixel, as OpenCV takes them; -9 where no ray meets the lens."""
    at = torch.nan_to_num(xy - 0.5, nan=-9.0).float().reshape(camera.height, camera.width, 2).numpy()
    return np.ascontiguousarray(at[..., 0]), np.ascontiguousarray(at[..., 1])
