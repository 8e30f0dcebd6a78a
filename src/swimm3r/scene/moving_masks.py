"""Masks of moving objects that structure from motion found, on disk in the convention of the masks that users give."""

import shutil
from collections.abc import Iterator
from dataclasses import dataclass, replace
from pathlib import Path

from swimm3r.io.files.atomic import atomic_folder
from swimm3r.scene.frames import Frames


@dataclass(frozen=True)
class MovingMasks:
    """One NAME.png per frame that shows anything moving: 0 there, and where the frame's own mask is 0."""

    folder: Path

    def path(self, name: str) -> Path:
        """Path of a frame's mask."""
        return self.folder / f"{name}.png"

    def __contains__(self, name: str) -> bool:
        return self.path(name).is_file()

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

    def copy(self, folder: Path) -> None:
        """Write them into another folder, unless they are there already."""
        if self.folder.resolve() != folder.resolve():
            with atomic_folder(folder) as draft:
                shutil.copytree(self.folder, draft, dirs_exist_ok=True)
