"""A folder of stills: which of its files are pictures, which are masks, in which order, and when they were taken."""

import os
import re
from collections.abc import Sequence
from datetime import datetime
from pathlib import Path

from PIL import Image

from swimm3r.io.images import SUFFIXES

RUN_MARK = Path("prepare") / "frames.json"  # a folder that holds this is a run folder
_TAKEN, _FRACTION, _EXIF = 36867, 37521, 0x8769  # DateTimeOriginal, SubSecTimeOriginal and the IFD they stand in
_MASK_SUFFIXES = (".png", ".jpg", ".jpeg", ".tif", ".tiff", ".bmp")


def find_pictures(folder: Path, leave_out: Sequence[Path] = ()) -> list[Path]:
    """Every picture below a folder, in natural order, without masks, hidden files, run folders and `leave_out`."""
    closed = {path.resolve() for path in leave_out}
    found: list[Path] = []
    for where, folders, files in os.walk(folder):
        here = Path(where)
        folders[:] = [name for name in folders if not _hidden(name) and not _closed(here / name, closed)]
        found += [here / name for name in files if not _hidden(name) and name.lower().endswith(SUFFIXES)]
    masks = masks_beside(found)
    return sorted((path for path in found if path not in masks), key=lambda path: natural_key(path, folder))


def masks_beside(pictures: Sequence[Path]) -> set[Path]:
    """Those that are masks of others in the same folder: a_mask.png or a.jpg.png beside a.jpg."""
    files = set(pictures)
    stems = {path.with_suffix("") for path in pictures}
    return {
        path
        for path in pictures
        if path.with_suffix("") in files
        or (path.stem.endswith("_mask") and path.with_name(path.stem.removesuffix("_mask")) in stems)
    }


def find_mask(name: Path, folder: Path, not_masks: set[Path]) -> Path | None:
    """The mask of the picture with this relative name: NAME_mask.png, NAME.jpg.png or NAME.png."""
    for stem in (f"{name.with_suffix('')}_mask", str(name), str(name.with_suffix(""))):
        for suffix in _MASK_SUFFIXES:
            candidate = folder / f"{stem}{suffix}"
            if candidate.is_file() and candidate not in not_masks:
                return candidate
    return None


def natural_key(path: Path, folder: Path) -> list[tuple[int, int, str]]:
    """Sorts img2 before img10, and a folder's own pictures before those of its subfolders."""
    relative = path.relative_to(folder)
    pieces = re.split(r"(\d+)", relative.as_posix().lower())
    number = [(0, int(piece), "") if piece.isdigit() else (1, 0, piece) for piece in pieces]
    return [(len(relative.parts) > 1, 0, ""), *number, (1, 0, relative.as_posix())]


def capture_time(path: Path) -> float | None:
    """Seconds on the camera's clock (EXIF DateTimeOriginal with its fraction); None where the file does not tell."""
    try:
        with Image.open(path) as header:
            exif = Image.Image.getexif(header).get_ifd(_EXIF)  # PngImageFile's own decodes the picture
            taken = datetime.strptime(str(exif[_TAKEN]).strip("\x00 "), "%Y:%m:%d %H:%M:%S")
            digits = str(exif.get(_FRACTION, "")).strip("\x00 ")
    except (OSError, KeyError, ValueError, SyntaxError):
        return None
    return (taken - datetime(1970, 1, 1)).total_seconds() + (float(f"0.{digits}") if digits.isdigit() else 0.0)


def numbered(pictures: Sequence[Path]) -> bool:
    """Whether they lie in one folder and differ only in a running number: as a camera or a video export names them."""
    patterns = {re.sub(r"\d+", "#", path.stem) for path in pictures}
    return len({path.parent for path in pictures}) == 1 and len(patterns) == 1 and "#" in patterns.pop()


def _hidden(name: str) -> bool:
    return name.startswith((".", "__"))  # .Trash, ._IMG_0001.jpg, __MACOSX


def _closed(folder: Path, closed: set[Path]) -> bool:
    return folder.resolve() in closed or (folder / RUN_MARK).is_file()
