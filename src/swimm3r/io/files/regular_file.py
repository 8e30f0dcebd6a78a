"""Files that are read to their end: a pipe, a device or a socket in their place would never end."""

from pathlib import Path

from swimm3r.errors import InputError


def require_regular_file(path: Path, kind: str) -> None:
    """Raise InputError where a path exists and is no regular file; `kind` is what was expected ("a video").

    Raises OSError where the path cannot be looked up.
    """
    if path.exists() and not path.is_file():
        what = "a folder" if path.is_dir() else "a pipe, a device or a socket"
        raise InputError(
            f"{path} is {what}, and {kind} was expected",
            cause="a slip in the name, or the output of another program given in the place of a file",
            hint="write the file to a disk first, and give its path",
        )
