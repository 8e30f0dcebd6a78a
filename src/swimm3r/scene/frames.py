"""The frames of one dive: which images, when they were taken, how sharp they are, which are held back for testing.

Images stay on disk as prepared (`read_frames` makes them) and are loaded one at a time through a bounded cache. Every
eighth frame (index % 8 == 0) is a test frame, as the paper and 3DGS count; SfM and training see `train` only.
"""

import json
import shutil
from collections.abc import Iterator, Sequence
from dataclasses import asdict, dataclass, replace
from functools import cached_property
from pathlib import Path
from typing import Literal

import numpy as np
import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from swimm3r import notebook
from swimm3r.appearance import FrameColors
from swimm3r.errors import InputError
from swimm3r.io import images
from swimm3r.io.files.atomic import atomic_folder, write_text
from swimm3r.io.files.cache import ArrayCache
from swimm3r.io.files.outputs import check_empty
from swimm3r.scene.rig import Rig

_CACHE = ArrayCache(max_bytes=256 << 20, least_entries=20)  # of 8-bit images: 40 frames of 1080p, 20 of 4K
MASKS = "masks"  # the folder of the masks beside the frames
_SHOWN = 6  # frames in a notebook
_SHOWN_PIXELS = 12e6  # decoded for it, at most


Part = Literal["train", "test", "between"]
"""Frames that everything is made from, those held back for scores, and those between keyframes, which get a pose."""


@dataclass(frozen=True)
class Frame:
    """One prepared image."""

    name: str  # unique relative path, the key of everything a run writes
    path: Path
    time: float  # seconds since the start of the clip; the index where stills carry no time
    sharpness: float  # variance of the Laplacian of a gray copy of at most 960 px, 8-bit units
    split: Part
    mask: Path | None = None  # image of the same size, 0 where the frame is not to be used
    camera: str | None = None  # of a rig
    instant: int | None = None  # of a rig: frames of one instant were taken together
    up: tuple[float, float, float] | None = None  # away from the earth in image axes, where the camera measured it
    gains: tuple[float, float, float] | None = None  # exposure x ISO x white balance, where the camera recorded them


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
    recorded: str | None = None  # begin of the recording, ISO 8601, as the files state it: EXIF, container or headers
    start_ns: int | None = None  # nanoseconds since 1970 at second 0, where every image is stamped: those of a bag
    calibration: Path | None = None  # the lens as the source states it, a file beside the frames
    rig: Rig | None = None  # cameras that are fixed to each other; frames of one instant are neighbors in the list
    development: str | None = None  # how raw, linear or log values became sRGB's; None where frames are as stored
    rows_rectified: bool = False  # rows that were exposed while the camera turned are drawn as at half time
    timed: bool = True  # false where times are places in the order: stills of which one at least has no clock
    own_colors: FrameColors | None = None  # of frames that are given in the dive's common colors; None: all as stored

    def __len__(self) -> int:
        return len(self.frames)

    def __repr__(self) -> str:
        if not self.frames:
            return f"Frames(none, {self.width}x{self.height})"
        masked = sum(frame.mask is not None for frame in self.frames)
        split = self._split_in_words + f", {masked} masked" * (masked > 0)
        first, last = self.span
        return (
            f"Frames({len(self)} of {self.width}x{self.height}, {split},\n"
            f"  {self.names[0]} to {self.names[-1]}, {first:.1f} to {last:.1f} s)"
        )

    def _repr_html_(self) -> str:
        """A strip of a few frames, evenly spread over the dive. Raises InputError where one of them is damaged."""
        count = min(len(self), _SHOWN, max(2, int(_SHOWN_PIXELS / (self.width * self.height))))
        chosen = sorted({round(i) for i in np.linspace(0, len(self) - 1, count)}) if count else []
        title = f"{len(self)} frames of {self.width}x{self.height}: {self._split_in_words}"
        shown = [(images.jpeg_uri(self._eight_bits(i), 160, 80), self._caption(i)) for i in chosen]
        return notebook.image_row(title, shown)

    @property
    def _split_in_words(self) -> str:
        between = len(self.between)
        words = f"{len(self.train)} for training, {len(self.test)} for testing"
        return words + f", {between} between keyframes" * (between > 0)

    def _caption(self, i: int) -> str:
        frame = self.frames[i]
        return f"{frame.name}, {frame.time:.1f} s" + f", {frame.split}" * (frame.split != "train")

    def __iter__(self) -> Iterator[Frame]:
        return iter(self.frames)

    def select(self, indices: Sequence[int]) -> "Frames":
        """Some of the frames, in the order given."""
        return replace(self, frames=tuple(self.frames[i] for i in indices))

    @cached_property
    def names(self) -> tuple[str, ...]:
        return tuple(frame.name for frame in self.frames)

    @cached_property
    def _position(self) -> dict[str, int]:
        return {name: i for i, name in reversed(tuple(enumerate(self.names)))}

    @property
    def train(self) -> "Frames":
        """The frames SfM and training may see."""
        return replace(self, frames=tuple(f for f in self.frames if f.split == "train"))

    @property
    def test(self) -> "Frames":
        """The frames held back for scoring."""
        return replace(self, frames=tuple(f for f in self.frames if f.split == "test"))

    @property
    def between(self) -> "Frames":
        """The frames between keyframes: they get a pose, and nothing is made from them."""
        return replace(self, frames=tuple(f for f in self.frames if f.split == "between"))

    @property
    def span(self) -> tuple[float, float]:
        """Times of the first and the last frame."""
        times = [frame.time for frame in self.frames]
        return min(times), max(times)

    def index(self, name: str) -> int:
        """The position of a frame by its name. Raises ValueError where no frame has it."""
        if name not in self._position:
            raise ValueError(f"no frame is called {name}")
        return self._position[name]

    def stamps_of(self, names: Sequence[str]) -> tuple[int, ...] | None:
        """Nanoseconds since 1970 of the frames of these names; None where the source does not stamp its images."""
        start = self.start_ns
        return None if start is None else tuple(start + round(time * 1e9) for time in self.times_of(names))

    def times_of(self, names: Sequence[str]) -> tuple[float, ...]:
        """Times of the frames of these names, seconds since the start of the clip."""
        times = {frame.name: frame.time for frame in self.frames}
        return tuple(times[name] for name in names)

    def image(self, i: int) -> Float[Tensor, "h w 3"]:
        """Image i as stored (sRGB-encoded, raw and log inputs too), 0..1. Raises InputError on a damaged one.

        Of frames with `own_colors` it is in the colors that the dive has on average, which may leave 0..1 a little.
        """
        image, name = _unit(self._stored(i)), self.frames[i].name
        if self.own_colors is None or name not in self.own_colors.names:
            return image
        return self.own_colors.common(name, image.permute(2, 0, 1)).permute(1, 2, 0)

    def colors(self, i: int, pixels: Int[Tensor, " n"]) -> Float[Tensor, "n 3"]:
        """Some pixels of image i, by their row-major index; cheaper than `image`, which converts all of it."""
        if self.own_colors is not None:
            return self.image(i).reshape(-1, 3)[pixels]
        return _unit(self._stored(i).reshape(-1, 3)[pixels.numpy()])

    def mask(self, i: int) -> Bool[Tensor, "h w"]:
        """True where image i may be used; true everywhere without a mask. Raises InputError where it is damaged."""
        path = self.frames[i].mask
        if path is None:
            return torch.ones(self.height, self.width, dtype=torch.bool)
        (usable,) = _CACHE.get(_version(path), lambda: (images.read_mask(path),))
        self._check_size(usable, path)
        return torch.from_numpy(usable.copy())

    def save(self, folder: str | Path) -> None:
        """Copy images and masks into a folder with a frames.json beside them; `swimm3r.load_frames` reads it.

        The folder is new or empty, and appears once it is whole. Raises StorageError where other things lie there.
        """
        folder = Path(folder)
        check_empty(folder)
        with atomic_folder(folder) as draft:
            copied = []
            for frame in self.frames:
                path = _copied(frame.path, draft / frame.name)
                mask = None if frame.mask is None else _copied(frame.mask, draft / MASKS / f"{frame.name}.png")
                copied.append(replace(frame, path=path, mask=mask))
            lens = self.calibration
            calibration = None if lens is None else _copied(lens, draft / lens.name)
            write_index(draft, replace(self, frames=tuple(copied), calibration=calibration))

    def _eight_bits(self, i: int) -> np.ndarray:
        stored = self._stored(i)
        return stored if stored.dtype == np.uint8 else (stored >> 8).astype(np.uint8)

    def _stored(self, i: int) -> np.ndarray:
        """The pixel values of image i, of 8 or 16 bits. Raises InputError on a damaged one."""
        path = self.frames[i].path
        (stored,) = _CACHE.get(_version(path), lambda: (images.read_rgb(path),))
        self._check_size(stored, path)
        return stored

    def _check_size(self, stored: np.ndarray, path: Path) -> None:
        height, width = stored.shape[:2]
        if (width, height) != (self.width, self.height):
            raise InputError(
                f"{path} is {width} x {height}, the frames are {self.width} x {self.height}",
                cause="the file was replaced or resized after the frames were prepared",
                hint="put the prepared one back; or another --out, which prepares the frames anew",
            )


def rows_of_one_camera(names: Sequence[str], clip: Frames) -> list[int]:
    """Places in a list of frames of those that the first camera of a rig took, or the next that took any.

    All of them without a rig, and where none is a frame of the clip.
    """
    camera = {frame.name: frame.camera for frame in clip}
    own = [camera.get(name) for name in names]
    cameras = () if clip.rig is None else clip.rig.names
    first = next((each for each in cameras if each in own), None)
    return [row for row, each in enumerate(own) if first is None or each == first]


def _unit(stored: np.ndarray) -> Float[Tensor, "*n 3"]:
    """Stored values as 0..1."""
    return torch.from_numpy(stored.astype(np.float32)) / (255.0 if stored.dtype == np.uint8 else 65535.0)


def write_index(folder: Path, frames: Frames, source: str = "") -> None:
    """Write frames.json beside images and masks that are in the folder; `source` is what they were prepared from."""
    document = {
        "schema": 1,
        "source": source,
        "width": frames.width,
        "height": frames.height,
        "ordered": frames.ordered,
        "gray": frames.gray,
        "masks": {"used": sum(frame.mask is not None for frame in frames), "unused": frames.unused_masks},
        "warnings": list(frames.warnings),
        "recorded": frames.recorded,
        "start_ns": frames.start_ns,
        "calibration": None if frames.calibration is None else frames.calibration.relative_to(folder).as_posix(),
        "rig": None if frames.rig is None else asdict(frames.rig),
        "development": frames.development,
        **({"rows_rectified": True} if frames.rows_rectified else {}),
        **({} if frames.timed else {"timed": False}),
        "frames": [
            {
                "name": frame.name,
                **({} if frame.camera is None else {"camera": frame.camera, "instant": frame.instant}),
                **({} if frame.up is None else {"up": [round(value, 6) for value in frame.up]}),
                **({} if frame.gains is None else {"gains": [float(f"{value:.6g}") for value in frame.gains]}),
                "time": frame.time,
                "split": frame.split,
                "sharpness": frame.sharpness,
                "mask": None if frame.mask is None else frame.mask.relative_to(folder).as_posix(),
            }
            for frame in frames
        ],
    }
    write_text(folder / "frames.json", json.dumps(document, indent=1) + "\n")


def _copied(source: Path, target: Path) -> Path:
    target.parent.mkdir(parents=True, exist_ok=True)
    shutil.copyfile(source, target)
    return target


def _version(path: Path) -> tuple[Path, int]:
    """A cache key that an image prepared anew does not share."""
    return path, path.stat().st_mtime_ns
