"""Failures of files in the user's words: the system refuses to read or to write one."""

import errno
import os
from pathlib import Path

from swimm3r.errors import InputError, StorageError, Swimm3rError

_STORAGE_ERRORS = {errno.ENOSPC, errno.EDQUOT, errno.EROFS, errno.EACCES, errno.EPERM, errno.EFBIG}


def refusal(error: Exception) -> Swimm3rError | None:
    """The failure in the user's words where the system refused a file; None where that is not what happened."""
    if not isinstance(error, OSError) or error.errno not in _STORAGE_ERRORS:
        return None
    if error.errno in (errno.EACCES, errno.EPERM) and error.filename and not _readable(Path(error.filename)):
        return InputError(
            f"cannot read {error.filename}: {error.strerror}",
            cause="it belongs to another user, or lies in a folder that may not be entered",
            hint="change the permissions (chmod -R u+rX FOLDER), or copy it to a folder of your own",
        )
    return StorageError(
        f"cannot write {error.filename or 'to the run folder'}: {error.strerror}",
        cause="the disk is full, over quota or read-only",
        hint="free some space or choose another --out; the same command then resumes from here",
    )


def _readable(path: Path) -> bool:
    """Return whether a path, or the nearest folder above it that is known to exist, may be read."""
    there = next((one for one in (path, *path.absolute().parents) if os.path.lexists(one)), path)
    effective = os.access in os.supports_effective_ids
    return os.access(there, os.R_OK | (os.X_OK if there.is_dir() else 0), effective_ids=effective)
