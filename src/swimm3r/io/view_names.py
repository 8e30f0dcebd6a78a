"""File names of a frame's rendered views: FRAME.png -> FRAME_rgb.png, FRAME_clear.png, ..."""

from collections import Counter
from collections.abc import Sequence
from pathlib import PurePosixPath


def view_stems(names: Sequence[str]) -> dict[str, str]:
    """The beginning of each frame's view names: its own name without the suffix, with it where two would be one.

    Stems that differ in upper and lower case alone count as one: not every file system tells them apart.
    """
    stems = {name: PurePosixPath(name).with_suffix("").as_posix() for name in names}
    while True:
        counts = Counter(stem.casefold() for stem in stems.values())
        shared = [name for name, stem in stems.items() if stem != name and counts[stem.casefold()] > 1]
        if not shared:
            return stems
        stems |= {name: name for name in shared}
