"""From an image to what the network sees, and every pixel's way there and back.

resize to a long side of 512 (Lanczos down, bicubic up) -> center crop to whole patches -> -1..1

Resize and crop act on pixel coordinates with centers at +0.5, so that an image's edge stays an edge:

    u' = s_x u - x_0,   v' = s_y v - y_0,   K' = [[s_x, 0, -x_0], [0, s_y, -y_0], [0, 0, 1]] K
"""

from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Bool, Float
from PIL import Image
from torch import Tensor
from torch.nn import functional as F


@dataclass(frozen=True)
class Framing:
    """Resize and crop from an image of one size to the network's."""

    width: int  # of the image, pixels
    height: int
    resized_width: int
    resized_height: int
    left: int  # of the crop in the resized image
    top: int
    network_width: int
    network_height: int

    @property
    def matrix(self) -> Float[Tensor, "3 3"]:
        """Image pixels to network pixels, float64."""
        sx, sy = self.resized_width / self.width, self.resized_height / self.height
        return torch.tensor([[sx, 0, -self.left], [0, sy, -self.top], [0, 0, 1]], dtype=torch.float64)


def framing(width: int, height: int, size: int = 512, square_ok: bool = False, patch: int = 16) -> Framing:
    """The framing of the published network: long side `size`; 224 means a square crop of the short side.

    A square image loses a quarter of its height unless `square_ok`: the network was trained on 4:3 at the squarest.
    Raises ValueError for an image so narrow that not one patch is left.
    """
    long = size if size != 224 else round(224 * max(width / height, height / width))
    longest = max(width, height)
    resized_width, resized_height = round(width * long / longest), round(height * long / longest)
    cx, cy = resized_width // 2, resized_height // 2
    if size == 224:
        half_width = half_height = min(cx, cy)
    else:
        half_width, half_height = (2 * c // patch * patch // 2 for c in (cx, cy))
        if resized_width == resized_height and not square_ok:
            half_height = 3 * half_width // 4
    if half_width == 0 or half_height == 0:
        raise ValueError(f"an image of {width} x {height} pixels is too narrow for the network")
    left, top = cx - half_width, cy - half_height
    return Framing(width, height, resized_width, resized_height, left, top, 2 * half_width, 2 * half_height)


def to_network(source: Float[Tensor, "h w 3"], frame: Framing) -> Float[Tensor, "3 H W"]:
    """An image (0..1, undistorted) resized and cropped, in -1..1; through 8 bits, as the network was trained."""
    _check_size(source, frame)
    pixels = (source.clamp(0, 1) * 255).round().to(torch.uint8).cpu().numpy()
    shrinks = max(frame.width, frame.height) > max(frame.resized_width, frame.resized_height)
    image = Image.fromarray(pixels).resize(
        (frame.resized_width, frame.resized_height),
        Image.Resampling.LANCZOS if shrinks else Image.Resampling.BICUBIC,
    )
    cropped = torch.from_numpy(np.asarray(image).copy())[_crop(frame)]
    return (cropped.float() / 255 - 0.5).permute(2, 0, 1) / 0.5


def mask_to_network(mask: Bool[Tensor, "h w"], frame: Framing) -> Bool[Tensor, "H W"]:
    """True where every image pixel under a network pixel may be used."""
    _check_size(mask, frame)
    unusable = (~mask).float()[None, None]
    # area averaging sees every pixel, so a thin masked line cannot slip through
    share = F.interpolate(unusable, (frame.resized_height, frame.resized_width), mode="area")[0, 0]
    return (share == 0)[_crop(frame)]


def K_to_network(K: Float[Tensor, "*c 3 3"], frame: Framing) -> Float[Tensor, "*c 3 3"]:
    """Intrinsics of the image -> of the network's image."""
    return frame.matrix.to(K) @ K


def K_to_image(K: Float[Tensor, "*c 3 3"], frame: Framing) -> Float[Tensor, "*c 3 3"]:
    """Intrinsics of the network's image -> of the image."""
    return torch.linalg.inv(frame.matrix).to(K) @ K


def pixels_to_network(xy: Float[Tensor, "*m 2"], frame: Framing) -> Float[Tensor, "*m 2"]:
    """Pixels of the image -> of the network's image; centers at +0.5 in both."""
    matrix = frame.matrix.to(xy)
    return xy * matrix.diagonal()[:2] + matrix[:2, 2]


def pixels_to_image(xy: Float[Tensor, "*m 2"], frame: Framing) -> Float[Tensor, "*m 2"]:
    """Pixels of the network's image -> of the image; add 0.5 to whole pixel numbers first."""
    matrix = frame.matrix.to(xy)
    return (xy - matrix[:2, 2]) / matrix.diagonal()[:2]


def _crop(frame: Framing) -> tuple[slice, slice]:
    return slice(frame.top, frame.top + frame.network_height), slice(frame.left, frame.left + frame.network_width)


def _check_size(image: Tensor, frame: Framing) -> None:
    if image.shape[:2] != (frame.height, frame.width):
        h, w = image.shape[:2]
        raise ValueError(f"the framing is for images of {frame.width} x {frame.height} pixels, got {w} x {h}")
