"""Changes of frames by structure from motion, on disk: one NAME.png for each frame that has any."""

import shutil
from collections.abc import Iterator
from dataclasses import dataclass, replace
from pathlib import Path

from swimm3r.io.files.atomic import atomic_folder
from swimm3r.scene.frames import Frames

STEADY = "steady"  # the folder of frames in steady light, in that of a reconstruction


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
