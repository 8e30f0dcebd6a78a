"""The frames of one dive: which images, when they were taken, how sharp they are, which are held back for testing.

Images stay on disk as prepared (`read_frames` makes them) and are loaded one at a time through a bounded cache. Every
eighth frame (index % 8 == 0) is a test frame, as the paper and 3DGS count; SfM and training see `train` only.
"""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Literal

import numpy as np
import torch
from jaxtyping import Bool, Float
from torch import Tensor

from swimm3r.errors import InputError
from swimm3r.io import images
from swimm3r.io.files.cache import ArrayCache

_CACHE = ArrayCache(max_bytes=1 << 30)  # 1 GiB of 8-bit images: 170 frames of 1080p


@dataclass(frozen=True)
class Frame:
    """One prepared image."""

    name: str  # unique relative path, the key of everything a run writes
    path: Path
    time: float  # seconds since the start of the clip; the index where stills carry no time
    sharpness: float  # variance of the Laplacian of a gray copy of at most 960 px, 8-bit units
    split: Literal["train", "test"]
    mask: Path | None = None  # image of the same size, 0 where the frame is not to be used


@dataclass(frozen=True)
class Frames:
    """The images of a dive in time order, all of one size."""

    frames: tuple[Frame, ...]
    width: int
    height: int
    ordered: bool  # neighbors in the list are neighbors in time: true of video, a guess for stills
    warnings: tuple[str, ...] = ()  # what was left out or looks odd, in plain words
    gray: bool = False  # the three channels of every image are equal
    unused_masks: int = 0  # masks given that belong to no frame

    def __len__(self) -> int:
        return len(self.frames)

    def __iter__(self) -> Iterator[Frame]:
        return iter(self.frames)

    def select(self, indices: Sequence[int]) -> "Frames":
        """Some of the frames, in the order given."""
        return replace(self, frames=tuple(self.frames[i] for i in indices))

    @property
    def names(self) -> tuple[str, ...]:
        return tuple(frame.name for frame in self.frames)

    @property
    def train(self) -> "Frames":
        """The frames SfM and training may see."""
        return replace(self, frames=tuple(f for f in self.frames if f.split == "train"))

    @property
    def test(self) -> "Frames":
        """The frames held back for scoring."""
        return replace(self, frames=tuple(f for f in self.frames if f.split == "test"))

    @property
    def span(self) -> tuple[float, float]:
        """When the first and the last frame were taken."""
        times = [frame.time for frame in self.frames]
        return min(times), max(times)

    def index(self, name: str) -> int:
        """The position of a frame by its name."""
        return self.names.index(name)

    def times_of(self, names: Sequence[str]) -> tuple[float, ...]:
        """When the frames of these names were taken, seconds since the start of the clip."""
        times = {frame.name: frame.time for frame in self.frames}
        return tuple(times[name] for name in names)

    def image(self, i: int) -> Float[Tensor, "h w 3"]:
        """Image i as stored (sRGB-encoded unless the input was linear), 0..1. Raises InputError on a damaged one."""
        path = self.frames[i].path
        (stored,) = _CACHE.get(_version(path), lambda: (images.read_rgb(path),))
        self._check_size(stored, path)
        scale = 255.0 if stored.dtype == np.uint8 else 65535.0
        return torch.from_numpy(stored.astype(np.float32)) / scale

    def mask(self, i: int) -> Bool[Tensor, "h w"]:
        """True where image i may be used; true everywhere without a mask. Raises InputError where it is damaged."""
        path = self.frames[i].mask
        if path is None:
            return torch.ones(self.height, self.width, dtype=torch.bool)
        (usable,) = _CACHE.get(_version(path), lambda: (images.read_mask(path),))
        self._check_size(usable, path)
        return torch.from_numpy(usable.copy())

    def _check_size(self, stored: np.ndarray, path: Path) -> None:
        height, width = stored.shape[:2]
        if (width, height) != (self.width, self.height):
            raise InputError(
                f"{path} is {width} x {height}, the frames are {self.width} x {self.height}",
                cause="the file was replaced or resized after the frames were prepared",
                hint="put the prepared one back; or another --out, which prepares the frames anew",
            )


def _version(path: Path) -> tuple[Path, int]:
    """A cache key that an image prepared anew does not share."""
    return path, path.stat().st_mtime_ns
