"""Places a command is about to write to, checked before any work."""

import errno
import os
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

from swimm3r.errors import StorageError, Swimm3rError, UsageError

_UNUSABLE = {  # what is wrong with the path itself
    errno.ENOTDIR: "it lies below a file",
    errno.ELOOP: "it is a link that leads to itself",
    errno.ENAMETOOLONG: "it is too long",
    errno.EINVAL: "it is no valid name",
}


@contextmanager
def output_folder(path: Path, option: str = "--out") -> Iterator[Path]:
    """Make a folder to write into. If the block fails, the folders that were made go again unless something is in them.

    Raises UsageError where the path cannot be a folder, StorageError where it cannot be made or written into.
    """
    with _explained(path, option):
        if path.is_symlink() and not path.exists():
            raise _unusable(path, option, "it is a link to a place that does not exist")
        if path.exists() and not path.is_dir():
            raise _unusable(path, option, "it is a file")
        made = [folder for folder in (path, *path.parents) if not folder.exists()]
        path.mkdir(parents=True, exist_ok=True)
        if not os.access(path, os.W_OK | os.X_OK):
            raise PermissionError(errno.EACCES, os.strerror(errno.EACCES), str(path))
    try:
        yield path
    except BaseException:
        with suppress(OSError):  # one that is not empty keeps those above it
            for folder in made:
                folder.rmdir()
        raise


@contextmanager
def output_file(path: Path, option: str = "--out") -> Iterator[Path]:
    """The same for a file: its folder is made. Raises UsageError where the path cannot be a file."""
    check_file(path, option)
    with output_folder(path.parent, option):
        yield path


def check_file(path: Path, option: str = "--out") -> None:
    """Raises UsageError where a folder lies in the place of a file to be written, or the path can be no file."""
    with _explained(path, option):
        if path.exists() and not path.is_file():  # a device or a pipe would be replaced, too
            raise _unusable(path, option, "it is a folder" if path.is_dir() else "it is no ordinary file")


def check_empty(folder: Path) -> None:
    """Raises StorageError where a folder to be written holds anything, or is a file."""
    if folder.exists() and (not folder.is_dir() or any(folder.iterdir())):
        raise StorageError(
            f"{folder} is not written to: " + ("other things lie in it" if folder.is_dir() else "it is a file"),
            cause="the name of a folder that is in use",
            hint="a folder that does not exist yet",
        )


@contextmanager
def _explained(path: Path, option: str) -> Iterator[None]:
    try:
        if os.path.lexists(path):
            path.stat()
        yield
    except OSError as error:
        if isinstance(error, FileNotFoundError) and path.is_symlink():
            raise _unusable(path, option, "it is a link to a place that does not exist") from error
        if error.errno in _UNUSABLE:
            raise _unusable(path, option, _UNUSABLE[error.errno]) from error
        raise StorageError(
            f"cannot write to {path}: {error.strerror}",
            cause="the disk or the folder is read-only, of another user, or full",
            hint=f"{option} in a folder of your own",
        ) from error


def _unusable(path: Path, option: str, why: str) -> Swimm3rError:
    shown = str(path) if len(str(path)) <= 200 else f"{str(path)[:200]}..."
    return UsageError(
        f"{shown} cannot be written to: {why}",
        cause=f"a slip in {option}, or something else lies there",
        hint=f"{option} with a path that does not exist yet",
    )
