"""The outcome of an export, and the refusal to replace what another program wrote."""

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

from swimm3r.errors import UsageError


@dataclass(frozen=True)
class Exported:
    """A file or folder that was written."""

    path: Path
    content: str  # in words: "12,000 Gaussians of 13,000 primitives"
    loss: str = ""  # measured; empty where nothing is lost

    @property
    def bytes(self) -> int:
        """Size on disk, of a folder with everything in it."""
        files = [self.path] if self.path.is_file() else [path for path in self.path.rglob("*") if path.is_file()]
        return sum(path.stat().st_size for path in files)

    def __str__(self) -> str:
        size = f"{self.bytes / 1e6:.1f} MB" if self.bytes >= 1e5 else f"{self.bytes / 1e3:.1f} kB"
        return f"{self.path}: {self.content}, {size}." + (f"\n{self.loss}" if self.loss else "")


def check_replaceable(path: Path, is_ours: Callable[[Path], bool], kind: str) -> None:
    """Raise UsageError where a file exists that is no file of this kind ("PLY file")."""
    if path.is_file() and not is_ours(path):
        raise UsageError(
            f"{path} exists and is no {kind}: it is not replaced",
            cause="a slip in the name of the file to write",
            hint="another name, or remove the file first",
        )


def begins_with(*marks: bytes) -> Callable[[Path], bool]:
    """Return the check that a file begins with one of these bytes."""

    def check(path: Path) -> bool:
        with path.open("rb") as file:
            return file.read(max(map(len, marks))).startswith(marks)

    return check


def has_numbers(count: int) -> Callable[[Path], bool]:
    """Return the check that the first line of a file is this many numbers."""

    def check(path: Path) -> bool:
        with path.open("rb") as file:
            words = file.readline(4096).split()
        try:
            return len(words) == count and all(float(word) is not None for word in words)
        except ValueError:
            return False

    return check
