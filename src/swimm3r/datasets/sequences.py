"""One shape for every data set: sequences of shots, and what was left out and why.

A shot is a raw image with, where the set has them, the same view restored and its metric depth. Files are named
here and opened by `load`, one shot at a time.
"""

from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Literal

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from swimm3r.cameras import Cameras
from swimm3r.errors import InputError
from swimm3r.io import images
from swimm3r.io.depth import read_depth
from swimm3r.medium import Encoding, srgb_from_linear


@dataclass(frozen=True)
class Shot:
    """One view: at least a raw or a clean image."""

    name: str  # unique in its sequence
    raw: Path | None
    clean: Path | None = None
    depth: Path | None = None
    time: float | None = None  # seconds
    split: Literal["train", "test"] = "train"


@dataclass(frozen=True)
class Lens:
    """Intrinsics all shots of a sequence share."""

    width: int
    height: int
    K: Float[np.ndarray, "3 3"]  # pixels
    model: str = "PINHOLE"
    distortion: tuple[float, ...] = ()


@dataclass(frozen=True)
class Sequence:
    """Shots of one dive in the order they were taken."""

    name: str  # path of the sequence under the root, unique
    kind: str  # the data set it is of, in words
    shots: tuple[Shot, ...]
    encoding: Encoding = "srgb"  # of the images on disk
    depth_range: tuple[float, float] = (1e-3, 30.0)  # m; what lies outside is no depth
    lens: Lens | None = None
    cam2world: Mapping[str, Float[np.ndarray, "4 4"]] = field(default_factory=dict)  # by shot name
    metric: bool = True  # whether poses share the unit of the depth maps, metres
    notes: tuple[str, ...] = ()  # what is odd about it, in plain words

    def __len__(self) -> int:
        return len(self.shots)

    def camera(self, width: int, height: int) -> Cameras | None:
        """The lens at an image's size, at the origin; None where it is not known."""
        if self.lens is None:
            return None
        scale = np.diag([width / self.lens.width, height / self.lens.height, 1.0])
        K = torch.from_numpy(scale @ self.lens.K)[None]
        pose = torch.eye(4, dtype=torch.float64)[None]
        return Cameras(K, torch.tensor([self.lens.distortion]).double(), pose, width, height, self.lens.model)


@dataclass(frozen=True)
class Skipped:
    """Something in the tree that is not used."""

    path: Path
    why: str


@dataclass(frozen=True)
class Survey:
    """The contents of a folder."""

    root: Path
    sequences: tuple[Sequence, ...]
    skipped: tuple[Skipped, ...]


@dataclass(frozen=True)
class DatasetView:
    """A shot in memory; sRGB-encoded images 0..1 of one size, whatever the files hold."""

    raw: Float[Tensor, "h w 3"] | None
    clean: Float[Tensor, "h w 3"] | None
    z_depth: Float[Tensor, "h w"] | None  # m, 0 where nothing is known


def load(sequence: Sequence, index: int) -> DatasetView:
    """Shot `index`. Depth of another size is brought to the image's by its nearest value.

    Raises InputError where a file is damaged or raw and clean differ in size.
    """
    shot = sequence.shots[index]
    raw, clean = (None if path is None else _image(path, sequence.encoding) for path in (shot.raw, shot.clean))
    if raw is not None and clean is not None and raw.shape != clean.shape:
        raise InputError(
            f"{shot.raw} is {raw.shape[1]}x{raw.shape[0]}, {shot.clean} is {clean.shape[1]}x{clean.shape[0]}",
            cause="the two images of a pair must show the same view, pixel by pixel",
            hint="resize one of them, or take the pair out",
        )
    image = raw if raw is not None else clean
    z_depth = None
    if shot.depth is not None and image is not None:
        depth = torch.from_numpy(read_depth(shot.depth))
        low, high = sequence.depth_range
        depth = torch.where((depth >= low) & (depth <= high), depth, 0.0)
        z_depth = _nearest(depth, image.shape[0], image.shape[1])
    return DatasetView(raw, clean, z_depth)


def _image(path: Path, encoding: Encoding) -> Float[Tensor, "h w 3"]:
    stored = images.read_rgb(path)
    values = torch.from_numpy(stored.astype(np.float32)) / (255.0 if stored.dtype == np.uint8 else 65535.0)
    return srgb_from_linear(values) if encoding == "linear" else values


def _nearest(depth: Float[Tensor, "a b"], height: int, width: int) -> Float[Tensor, "h w"]:
    if depth.shape == (height, width):
        return depth
    # nearest-exact samples at pixel centers; nothing is averaged across an edge
    return torch.nn.functional.interpolate(depth[None, None], (height, width), mode="nearest-exact")[0, 0]
