"""Helpers of the layout readers: folders regardless of case, files by number, and files left over."""

import re
from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path

from swimm3r.io import depth as depth_files
from swimm3r.io import images
from swimm3r.io.image_folder import natural_key


@dataclass(frozen=True)
class Folder:
    """A folder and its visible subfolders by lower-case name."""

    path: Path
    name: str  # relative to the root, doubled levels of unpacked archives removed
    children: dict[str, Path]

    def child(self, *names: str) -> Path | None:
        """The first subfolder that goes by one of the names."""
        return next((self.children[name] for name in names if name in self.children), None)


def folder(path: Path, root: Path) -> Folder:
    """The record of a folder at or below the root."""
    parts: list[str] = []
    for part in path.relative_to(root).parts:
        if not parts or parts[-1] != part:
            parts.append(part)
    children = {p.name.lower(): p for p in sorted(path.iterdir()) if p.is_dir() and not p.name.startswith((".", "__"))}
    return Folder(path, "/".join(parts) or root.resolve().name, children)


def image_files(path: Path) -> list[Path]:
    """The visible images right in a folder, in natural order."""
    return _files(path, images.SUFFIXES)


def depth_maps(path: Path) -> list[Path]:
    """The visible files right in a folder that may be depth maps, in natural order."""
    return _files(path, depth_files.SUFFIXES)


def by_stem(files: Iterable[Path]) -> dict[str, Path]:
    """Files by name without suffix; the first of several."""
    found: dict[str, Path] = {}
    for path in files:
        found.setdefault(path.stem, path)
    return found


def number(path: Path) -> int | None:
    """The last run of digits in a file's name: what pairs depthT_S03082.tif with T_S03082.png or S03082.png."""
    runs = re.findall(r"\d+", path.stem)
    return int(runs[-1]) if runs else None


def counted(count: int, singular: str, plural: str | None = None) -> str:
    """`1 image`, `3 images`."""
    return f"{count} {singular if count == 1 else plural or singular + 's'}"


def _files(path: Path, suffixes: tuple[str, ...]) -> list[Path]:
    found = [p for p in path.iterdir() if p.is_file() and not p.name.startswith(".") and p.suffix.lower() in suffixes]
    return sorted(found, key=lambda p: natural_key(p, path))
