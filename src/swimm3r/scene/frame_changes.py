"""Changes of frames by structure from motion, on disk: one NAME.png for each frame that has any, or one color map."""

import json
import shutil
from collections.abc import Iterator
from dataclasses import dataclass, replace
from pathlib import Path

import torch

from swimm3r.appearance import ORDERS, FrameColors
from swimm3r.io.files.atomic import atomic_folder, write_text
from swimm3r.io.files.damage import Remedy, guard
from swimm3r.io.files.json_file import read_json
from swimm3r.scene.frames import Frames

STEADY = "steady"  # the folder of frames in steady light, in that of a reconstruction
OWN_COLORS = "frame_colors.json"  # the color maps of single frames, there
_LEAST_DETERMINANT = 1e-3  # of the matrix of a frame's colors: half the light of all channels, and more, leaves 0.1


@dataclass(frozen=True)
class _FrameFiles:
    """A folder with an image for each of some frames."""

    folder: Path

    def path(self, name: str) -> Path:
        """Path of a frame's image."""
        return self.folder / f"{name}.png"

    def __contains__(self, name: str) -> bool:
        return self.path(name).is_file()

    def copy(self, folder: Path) -> None:
        """Write them into another folder, unless they are there already."""
        if self.folder.resolve() != folder.resolve():
            with atomic_folder(folder) as draft:
                shutil.copytree(self.folder, draft, dirs_exist_ok=True)


class MovingMasks(_FrameFiles):
    """Masks of moving objects: 0 there, and where the frame's own mask is 0; of frames that show any."""

    def on(self, frames: Frames) -> Frames:
        """The frames with these masks; frames without one keep their own."""
        masked = (replace(frame, mask=self.path(frame.name)) if frame.name in self else frame for frame in frames)
        return replace(frames, frames=tuple(masked))

    def shares(self, frames: Frames) -> Iterator[tuple[str, float]]:
        """Names of the frames with a mask, and the share of their usable pixels that move."""
        masked = self.on(frames)
        for i, frame in enumerate(frames):
            if frame.name in self:
                usable = frames.mask(i)
                yield frame.name, 1 - float(masked.mask(i)[usable].float().mean())


class SteadyFrames(_FrameFiles):
    """Frames as they would have been filmed without the flicker of the sun on the ground."""

    def on(self, frames: Frames) -> Frames:
        """The frames with these images; frames without one, those held back for scores among them, keep their own."""
        lit = (replace(frame, path=self.path(frame.name)) if frame.name in self else frame for frame in frames)
        return replace(frames, frames=tuple(lit))

    def count(self, frames: Frames) -> int:
        """Number of the frames whose light was evened out."""
        return sum(frame.name in self for frame in frames)


@dataclass(frozen=True)
class _OwnColors:
    """An entry of frame_colors.json: rows of (M, b) for red, green and blue, and a row of the shading per cosine."""

    map: tuple[tuple[float, float, float, float], ...]
    shading: tuple[tuple[float, float, float], ...] | None = None


def save_own_colors(path: Path, colors: FrameColors) -> None:
    """Write a frame_colors.json, whole or not at all: the map of each frame and, where there is one, its shading."""
    frames = {name: {"map": own.tolist()} for name, own in zip(colors.names, colors.maps, strict=True)}
    if colors.shading is not None:
        for name, shading in zip(colors.names, colors.shading, strict=True):
            frames[name]["shading"] = shading.tolist()
    write_text(path, json.dumps(frames, indent=1) + "\n")


def read_own_colors(path: Path, remedy: Remedy) -> FrameColors:
    """Read what `save_own_colors` wrote. Raises the remedy's error, which names the file and the fault."""
    stored = read_json(path, dict[str, _OwnColors], remedy)
    with guard(path, remedy):
        maps = torch.tensor([own.map for own in stored.values()])
        if maps.shape[1:] != (3, 4) or bool((torch.linalg.det(maps[..., :3]).abs() < _LEAST_DETERMINANT).any()):
            raise ValueError("every frame has a map of 3 rows whose colors can be told apart")
        shading = torch.tensor([own.shading for own in stored.values() if own.shading is not None])
        if len(shading) and shading.shape != (len(stored), len(ORDERS), 3):
            raise ValueError(f"all frames or none have a shading of {len(ORDERS)} rows")
        return FrameColors(tuple(stored), maps, shading if len(shading) else None)
