"""A folder of stills: which of its files are images, which are masks, and in which order."""

import os
import re
from collections.abc import Callable, Collection, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

from swimm3r.io.images import SUFFIXES

RUN_MARK = Path("prepare") / "frames.json"  # a folder that holds this is a run folder


@dataclass(frozen=True)
class FilesBelow:
    """The files below a folder in natural order, and the folders that could not be searched."""

    paths: list[Path]
    unreadable: list[Path]


def find_files(folder: Path, suffixes: tuple[str, ...], leave_out: Sequence[Path] = ()) -> FilesBelow:
    """Every file of these kinds below a folder, without hidden files, run folders and `leave_out`.

    Raises OSError where the folder itself cannot be searched.
    """
    closed = {path.resolve() for path in leave_out}
    unreadable: list[Path] = []

    def pass_over(error: OSError) -> None:
        if Path(error.filename) == folder:
            raise error
        unreadable.append(Path(error.filename))

    found = [
        Path(where) / name for where, files in _walk(folder, closed, pass_over) for name in files if _is(name, suffixes)
    ]
    return FilesBelow(sorted(found, key=lambda path: natural_key(path, folder)), unreadable)


def find_images(folder: Path, leave_out: Sequence[Path] = ()) -> FilesBelow:
    """Every image below a folder; masks beside their images are none."""
    found = find_files(folder, SUFFIXES, leave_out)
    masks = masks_beside(found.paths)
    return FilesBelow([path for path in found.paths if path not in masks], found.unreadable)


class GrowingFolder:
    """A folder that images are being written into: each look takes as long as listing it, however many there are."""

    def __init__(self, folder: Path) -> None:
        self._folder = folder
        self._listed: dict[str, set[str]] = {}  # names below each folder
        self._files: set[Path] = set()
        self._stems: set[Path] = set()

    def new_images(self) -> list[Path]:
        """The images, in natural order, that were not there at the last look; masks beside their images are none.

        Raises OSError where the folder itself cannot be searched.
        """

        def pass_over(error: OSError) -> None:
            if Path(error.filename) == self._folder:
                raise error

        new: list[Path] = []
        for where, files in _walk(self._folder, set(), pass_over):
            listed = self._listed.setdefault(where, set())
            new += [Path(where) / name for name in files if name not in listed and _is(name, SUFFIXES)]
            listed.update(files)
        self._files.update(new)
        self._stems.update(path.with_suffix("") for path in new)
        images = (path for path in new if not _is_mask(path, self._files, self._stems))
        return sorted(images, key=lambda path: natural_key(path, self._folder))


def masks_beside(images: Sequence[Path]) -> set[Path]:
    """Those that are masks of others in the same folder: a_mask.png or a.jpg.png beside a.jpg."""
    files = set(images)
    stems = {path.with_suffix("") for path in images}
    return {path for path in images if _is_mask(path, files, stems)}


class MaskFolder:
    """The masks below a folder, by the names of the images they belong to."""

    def __init__(self, folder: Path, images: Collection[Path], leave_out: Sequence[Path] = ()) -> None:
        """`images` are files that are no masks, wherever they lie. Raises OSError where there is no such folder."""
        found = find_files(folder, SUFFIXES, leave_out).paths
        self.paths = [path for path in found if path not in images]
        self._by_stem = {path.relative_to(folder).with_suffix(""): path for path in reversed(self.paths)}

    def mask_of(self, image: Path) -> Path | None:
        """The mask of the image with this relative name: NAME_mask.png, NAME.jpg.png or NAME.png, of any suffix."""
        stem = image.with_suffix("")
        candidates = (stem.with_name(f"{stem.name}_mask"), image, stem)
        return next((self._by_stem[name] for name in candidates if name in self._by_stem), None)


def natural_key(path: Path, folder: Path) -> list[tuple[int, int, str]]:
    """Sorts img2 before img10, and a folder's own images before those of its subfolders."""
    relative = path.relative_to(folder)
    pieces = re.split(r"(\d+)", relative.as_posix().lower())
    number = [(0, int(piece), "") if piece.isdecimal() else (1, 0, piece) for piece in pieces]
    return [(len(relative.parts) > 1, 0, ""), *number, (1, 0, relative.as_posix())]


def numbered(images: Sequence[Path]) -> bool:
    """Return whether they lie in one folder and differ only in a running number: as a camera or a video export names
    them."""
    patterns = {re.sub(r"\d+", "#", path.stem) for path in images}
    return len({path.parent for path in images}) == 1 and len(patterns) == 1 and "#" in patterns.pop()


def _walk(
    folder: Path, closed: Collection[Path], on_error: Callable[[OSError], None]
) -> Iterator[tuple[str, list[str]]]:
    """The folders below a folder and the names of their files, without what is hidden and run folders."""
    for where, folders, files in os.walk(folder, onerror=on_error):
        folders[:] = [name for name in folders if not _hidden(name) and not _closed(Path(where) / name, closed)]
        yield where, [name for name in files if not _hidden(name)]


def _is(name: str, suffixes: tuple[str, ...]) -> bool:
    return name.lower().endswith(suffixes)


def _is_mask(path: Path, files: Collection[Path], stems: Collection[Path]) -> bool:
    return path.with_suffix("") in files or (
        path.stem.endswith("_mask") and path.with_name(path.stem.removesuffix("_mask")) in stems
    )


def _hidden(name: str) -> bool:
    return name.startswith((".", "__"))  # .Trash, ._IMG_0001.jpg, __MACOSX


def _closed(folder: Path, closed: Collection[Path]) -> bool:
    return folder.resolve() in closed or os.path.isfile(folder / RUN_MARK)  # Path.is_file raises where it may not look
