"""Images that no lens of COLMAP's models took, drawn anew as a pinhole camera sees them.

Cameras stretch what they film toward the sides (GoPro's SuperView), and a cylindrical window refracts along its axis
and not across it. Such a lens is a polynomial (`cameras`, POLYNOMIAL), which no other program knows. Its images are
rectified once, and everything after works on images of a pinhole:

    I'(u) = I(pi(R K'^-1 u)),    pi the pixels of the lens, R the axes of the pinhole in those of the lens

The pinhole has square pixels, in the middle as many of them to the solid angle as the lens. It looks at the middle of
its image, which is the largest upright one that is filled.
"""

from dataclasses import dataclass
from functools import lru_cache

import numpy as np
import torch
from jaxtyping import Bool, Float, UInt8, UInt16
from torch import Tensor

from swimm3r.cameras import Cameras, directions, resized
from swimm3r.imaging.undistortion import WIDEST, distorted_grid, pinhole_grid, through_lens

_ROUNDS = 4  # in which the middle of the image and the axis of the pinhole come together
_SIDE = 256  # pixels of the small image in which the rectangle is sought
_LEAST = 16  # pixels along a side of the result, below which nothing of the image is left

_SAME_SHAPE = 0.01  # of the ratio of width to height

Image = UInt8[np.ndarray, "h w 3"] | UInt16[np.ndarray, "h w 3"] | Float[np.ndarray, "h w 3"]
Drawn = UInt8[np.ndarray, "rh rw 3"] | UInt16[np.ndarray, "rh rw 3"] | Float[np.ndarray, "rh rw 3"]


@dataclass(frozen=True)
class Rectification:
    """The way from images of one lens to those of a pinhole camera at the same place."""

    lens: Cameras  # one camera, its pose unused
    pinhole: Cameras  # its principal point is the middle of its image
    turn: Float[Tensor, "3 3"]  # the pinhole's axes in those of the lens, as columns

    def image(self, image: Image) -> Drawn:
        """An image of the lens as the pinhole camera has it, by Lanczos interpolation."""
        import cv2

        column, row, _ = _grid(self.key)
        return cv2.remap(image, column, row, cv2.INTER_LANCZOS4, borderMode=cv2.BORDER_REPLICATE)

    def mask(self, usable: Bool[np.ndarray, "h w"]) -> Bool[np.ndarray, "rh rw"]:
        """A mask of the lens's image as the pinhole camera has it."""
        import cv2

        column, row, shown = _grid(self.key)
        return (cv2.remap(usable.astype(np.uint8), column, row, cv2.INTER_NEAREST) > 0) & shown

    def mask_as_filmed(self, usable: Bool[np.ndarray, "rh rw"]) -> Bool[np.ndarray, "h w"]:
        """A mask of the pinhole's image as the lens's image has it, true where the pinhole's shows nothing."""
        import cv2

        size = self.lens.height, self.lens.width
        place = pinhole_grid(self.lens, self.pinhole, self.turn)
        column, row = (part.reshape(size).astype(np.float32) for part in place)
        return cv2.remap(usable.astype(np.uint8), column, row, cv2.INTER_NEAREST, borderValue=1) > 0

    def resized(self, width: int, height: int) -> "Rectification":
        """The same for images of the lens at another size."""
        if (width, height) == self._size(self.lens):
            return self
        scale = width / self.lens.width
        own = (max(1, round(side * scale)) for side in self._size(self.pinhole))
        pinhole = _pinhole(self.pinhole.K[0, 0, 0].item() * scale, *own)
        return Rectification(resized(self.lens, width, height), pinhole, self.turn)

    def is_of(self, width: int, height: int) -> bool:
        """Return whether an image of this size has the shape of the lens's, and not that of the pinhole's."""
        shape, lens, pinhole = (a / b for a, b in ((width, height), self._size(self.lens), self._size(self.pinhole)))
        return abs(shape - lens) < _SAME_SHAPE * lens and abs(shape - lens) < abs(shape - pinhole)

    def any_image(self, image: Image) -> Drawn:
        """An image of any size as the pinhole has it: as it is where it has another shape than the lens's images."""
        import cv2

        height, width = image.shape[:2]
        if not self.is_of(width, height):
            return image
        size = self._size(self.lens)
        return self.image(image if (width, height) == size else cv2.resize(image, size, interpolation=cv2.INTER_AREA))

    @staticmethod
    def _size(camera: Cameras) -> tuple[int, int]:
        return camera.width, camera.height

    @property
    def key(self) -> tuple[tuple[float, ...], int, int, int, int]:
        """All its numbers: those of the lens, the focal length of the pinhole and its axes, and the four sizes."""
        parts = (self.lens.K, self.lens.distortion, self.pinhole.K[:, 0, 0], self.turn)
        numbers = tuple(value for part in parts for value in part.double().flatten().tolist())
        return numbers, self.lens.width, self.lens.height, self.pinhole.width, self.pinhole.height


def from_key(numbers: tuple[float, ...], width: int, height: int, own_width: int, own_height: int) -> Rectification:
    """The rectification whose `key` this is. Raises ValueError where the numbers are too few or too many."""
    values = torch.tensor(numbers, dtype=torch.float64)
    K, distortion, focal, turn = values.split([9, len(numbers) - 19, 1, 9])
    origin = torch.eye(4, dtype=torch.float64)[None]
    lens = Cameras(K.reshape(1, 3, 3), distortion[None], origin, width, height, "POLYNOMIAL")
    return Rectification(lens, _pinhole(focal.item(), own_width, own_height), turn.reshape(3, 3))


def rectification_of(lens: Cameras) -> Rectification:
    """The rectification of one lens. Raises ValueError where it folds, or no upright image of a pinhole is filled."""
    turn = _axes(lens, torch.tensor([lens.width / 2, lens.height / 2], dtype=torch.float64))
    across = down = pixel = 0.0
    for _ in range(_ROUNDS):
        focal = _focal(lens, turn)
        reach = min(WIDEST * focal, 2.0 * max(lens.width, lens.height))
        pixel = 2 * reach / _SIDE
        left, top, right, bottom = _largest(lens, turn, focal, (reach, reach), pixel)
        across, down = (right - left) / 2, (bottom - top) / 2
        middle = torch.tensor([(left + right) / 2 / focal, (top + bottom) / 2 / focal, 1.0], dtype=torch.float64)
        ahead = turn @ middle
        turn = _axes(lens, through_lens(lens, ahead[:2] / ahead[2]))
    focal = _focal(lens, turn)
    left, top, right, bottom = _largest(lens, turn, focal, (across + pixel, down + pixel), 1.0)
    width, height = (2 * int(min(-before, after)) for before, after in ((left, right), (top, bottom)))
    if min(width, height) < _LEAST:
        raise ValueError("no upright image of a pinhole camera is filled by this lens")
    found = Rectification(lens, _pinhole(focal, width, height), turn)
    column, row, _ = _grid(found.key)
    if np.diff(column, axis=1).min() <= 0 or np.diff(row, axis=0).min() <= 0:
        raise ValueError("the image of this lens folds")
    return found


def _pinhole(focal: float, width: int, height: int) -> Cameras:
    K = torch.tensor([[[focal, 0, width / 2], [0, focal, height / 2], [0, 0, 1]]], dtype=torch.float64)
    return Cameras(K, torch.zeros(1, 0, dtype=torch.float64), torch.eye(4, dtype=torch.float64)[None], width, height)


def _axes(lens: Cameras, pixel: Float[Tensor, "2"]) -> Float[Tensor, "3 3"]:
    """Axes that look where a pixel does, their x along its row."""
    aside = torch.tensor([[0.0, 0.0], [-1.0, 0.0], [1.0, 0.0]], dtype=torch.float64)
    ahead, before, after = torch.nn.functional.normalize(directions(lens, (pixel + aside)[None])[0], dim=-1)
    across = after - before
    z = ahead
    x = torch.nn.functional.normalize(across - (across @ z) * z, dim=0)
    return torch.stack([x, torch.linalg.cross(z, x), z], -1)


def _focal(lens: Cameras, turn: Float[Tensor, "3 3"]) -> float:
    """Focal length at which the pinhole has as many pixels to the solid angle in its middle as the lens."""
    step = 1e-4
    plane = torch.tensor([[step, 0.0, 1.0], [-step, 0.0, 1.0], [0.0, step, 1.0], [0.0, -step, 1.0]]).double()
    rays = plane @ turn.mT
    right, left, down, up = through_lens(lens, rays[:, :2] / rays[:, 2:])
    columns = torch.stack([right - left, down - up], -1) / (2 * step)
    return torch.linalg.det(columns).abs().sqrt().item()


def _largest(
    lens: Cameras, turn: Float[Tensor, "3 3"], focal: float, reach: tuple[float, float], pixel: float
) -> tuple[float, float, float, float]:
    """Left, top, right and bottom, in pixels from the axis, of an upright rectangle that the lens fills.

    From the rectangle about all that it shows within `reach` of the axis, sides move in by `pixel`, always the one with
    the largest share of empty pixels.
    """
    size = [2 * int(np.ceil(far / pixel)) for far in reach]
    filled = distorted_grid(lens, _pinhole(focal / pixel, *size), turn)[1]
    rows, columns = (filled.any(axis).nonzero()[:, 0] for axis in (1, 0))
    if not len(rows):
        raise ValueError("the lens shows nothing about its axis")
    top, bottom, left, right = int(rows[0]), int(rows[-1]) + 1, int(columns[0]), int(columns[-1]) + 1
    while min(right - left, bottom - top) > 1:
        across, down = slice(left, right), slice(top, bottom)
        edges = filled[top, across], filled[bottom - 1, across], filled[down, left], filled[down, right - 1]
        empty = [1 - edge.double().mean().item() for edge in edges]
        worst = int(np.argmax(empty))
        if not empty[worst]:
            break
        top, bottom, left, right = (
            top + (worst == 0), bottom - (worst == 1), left + (worst == 2), right - (worst == 3)
        )  # fmt: skip
    x, y = (side / 2 for side in size)
    return (left - x) * pixel, (top - y) * pixel, (right - x) * pixel, (bottom - y) * pixel


@lru_cache(maxsize=2)
def _grid(
    key: tuple[tuple[float, ...], int, int, int, int],
) -> tuple[Float[np.ndarray, "rh rw"], Float[np.ndarray, "rh rw"], Bool[np.ndarray, "rh rw"]]:
    """Columns and rows (index coordinates) of the pinhole's pixels in the lens's image, and which ones it shows."""
    way = from_key(*key)
    pixels, shown = distorted_grid(way.lens, way.pinhole, way.turn)
    column, row = (pixels - 0.5).float().unbind(-1)
    return column.contiguous().numpy(), row.contiguous().numpy(), shown.numpy()
