"""Files and folders that are either whole or absent: written beside their place, synced, then renamed into it.

A draft's name begins with `DRAFT`, whatever it is a draft of; a process that is killed leaves its drafts behind, and
`drafts_in` finds them. Bytes reach the disk before the rename and the rename before the function returns, so that a
power cut leaves the old content or the new one, and never a whole name over half a file.
"""

import os
import re
import shutil
import sys
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from swimm3r.errors import StorageError

DRAFT = ".swimm3r-draft-"
_OWNER = re.compile(re.escape(DRAFT) + r"(\d+)-")  # the process that writes it
_LONGEST_SUFFIX = 16  # a longer one is part of the name, which may be as long as the file system allows


@contextmanager
def atomic_path(path: Path) -> Iterator[Path]:
    """A temporary path in the same folder and with the same suffix, which becomes `path` if the block succeeds.

    Raises StorageError where nothing can be written under that name.
    """
    suffix = path.suffix if len(path.suffix) <= _LONGEST_SUFFIX else ""
    with _unusable_place(path):
        path.parent.mkdir(parents=True, exist_ok=True)
        if path.is_dir():
            raise IsADirectoryError
        handle, name = tempfile.mkstemp(dir=path.parent, prefix=f"{DRAFT}{os.getpid()}-", suffix=suffix)
    os.close(handle)
    draft = Path(name)
    try:
        yield draft
        draft.chmod(0o644)  # mkstemp makes private files; a run folder is shared
        _sync(draft)
        with _unusable_place(path):
            draft.replace(path)
        _sync(path.parent)
    finally:
        draft.unlink(missing_ok=True)


@contextmanager
def atomic_folder(path: Path) -> Iterator[Path]:
    """An empty folder beside `path`, which takes its place if the block succeeds; what was there before is removed."""
    with _unusable_place(path):
        path.parent.mkdir(parents=True, exist_ok=True)
        if path.exists() and not path.is_dir():
            raise FileExistsError
        draft, retired = (Path(tempfile.mkdtemp(dir=path.parent, prefix=f"{DRAFT}{os.getpid()}-")) for _ in range(2))
    try:
        yield draft
        draft.chmod(0o755)  # mkdtemp makes private folders; a run folder is shared
        for written in [*draft.rglob("*"), draft]:
            _sync(written)
        if path.exists():
            os.replace(path, retired / path.name)
        os.replace(draft, path)
        _sync(path.parent)
    finally:
        shutil.rmtree(draft, ignore_errors=True)
        shutil.rmtree(retired, ignore_errors=True)


def write_text(path: Path, text: str) -> None:
    """Atomic `Path.write_text`; bytes of a file's name that are no UTF-8 are written as \\udcXX."""
    with atomic_path(path) as draft:
        draft.write_text(text, encoding="utf-8", errors="backslashreplace")


def drafts_in(folder: Path) -> list[Path]:
    """Drafts anywhere under a folder, files and folders, none of them inside another.

    They are litter unless a process is at work there.
    """
    found = sorted(folder.rglob(f"{DRAFT}*"))
    return [path for path in found if not any(parent in found for parent in path.parents)]


def remove_drafts(folder: Path) -> None:
    """Remove the drafts under a folder, except those of processes that still run."""
    for path in drafts_in(folder):
        owner = _OWNER.match(path.name)
        if owner and _is_running(int(owner[1])):
            continue
        if path.is_dir():
            shutil.rmtree(path)
        else:
            path.unlink(missing_ok=True)


def _is_running(process: int) -> bool:
    if sys.platform == "win32":  # where asking would end it
        return True
    try:
        os.kill(process, 0)
    except ProcessLookupError:
        return False
    except PermissionError:  # somebody else's
        return True
    return True


def _sync(path: Path) -> None:
    """Have the disk hold what was written; a folder's names too, where the system can (Windows cannot)."""
    if path.is_dir() and os.name == "nt":
        return
    handle = os.open(path, os.O_RDONLY if path.is_dir() else os.O_RDWR)
    try:
        os.fsync(handle)
    finally:
        os.close(handle)


@contextmanager
def _unusable_place(path: Path) -> Iterator[None]:
    """Say of a path that cannot take a file what is in its way; want of space or permission stays an OSError."""
    try:
        yield
    except (IsADirectoryError, FileExistsError, NotADirectoryError, FileNotFoundError) as error:
        raise StorageError(
            f"{path} cannot be written",
            cause="a folder has that name, or one of the folders on the way to it is a file or cannot be made",
            hint="another place for the output",
        ) from error
