"""One process at a time in a folder: a lock that the operating system lets go of when its process ends, however."""

import os
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

from filelock import FileLock, Timeout

from swimm3r.errors import UsageError

LOCK = ".lock"  # in the folder; it stays there, which means nothing, unless it is alone


@contextmanager
def folder_lock(folder: Path) -> Iterator[None]:
    """Hold the folder. Raises UsageError, with the other's process id, where another process does."""
    path = folder / LOCK
    lock = FileLock(path)
    try:
        lock.acquire(timeout=0)
    except Timeout as error:
        raise UsageError(
            f"{folder} is being written by {_holder(path)}",
            cause="the same command runs already, in another terminal or in the background",
            hint="wait until it is done, or another --out",
        ) from error
    try:
        with suppress(PermissionError):  # Windows lets nobody write into a locked file
            path.write_text(f"{os.getpid()}\n", encoding="utf-8")
        yield
    finally:
        if [entry.name for entry in folder.iterdir()] == [LOCK]:
            with suppress(OSError):  # Windows removes no file that is open
                path.unlink()
        lock.release()


def _holder(path: Path) -> str:
    with suppress(OSError, ValueError):
        return f"process {int(path.read_text(encoding='utf-8'))}"
    return "another process"
