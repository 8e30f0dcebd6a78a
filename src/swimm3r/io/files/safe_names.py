"""File names: what every file of a run can carry, what people can be shown, and what stays inside its folder."""

import unicodedata
from collections.abc import Iterable
from hashlib import sha256
from pathlib import PurePath, PurePosixPath, PureWindowsPath

_MOST_BYTES = 200  # a file system takes 255; what is written beside NAME.png adds up to 40 (.NAME_z_depth.png.k3x9f_2a)


def safe_name(relative: PurePath) -> str:
    """A relative path without its suffix, each part valid UTF-8 of at most 200 bytes and free of control characters.

    Different paths may become one name: callers keep them apart.
    """
    return "/".join(_shortened(_printable(part)) for part in relative.with_suffix("").parts)


def shown_name(path: PurePath | str) -> str:
    """A path for a message or a page; bytes that are not UTF-8 are shown as U+FFFD."""
    return str(path).encode("utf-8", "surrogateescape").decode("utf-8", "replace")


def check_name(name: str) -> None:
    """Raise ValueError for a relative path that is empty, leads out of its folder, or is no path at all."""
    path = PurePosixPath(name)
    if not path.name or "\0" in name:
        raise ValueError(f"it names a file {name!r}, which is no file's name")
    for kind in (path, PureWindowsPath(name)):
        if kind.anchor or ".." in kind.parts:
            raise ValueError(f"it names a file outside its folder: {name}")


def check_names(names: Iterable[str]) -> None:
    """`check_name` of each, and that no two are the same."""
    seen = set()
    for name in names:
        check_name(name)
        if name in seen:
            raise ValueError(f"it names {name} twice")
        seen.add(name)


def _printable(part: str) -> str:
    shown = shown_name(part).replace("\N{REPLACEMENT CHARACTER}", "_")
    return "".join("_" if unicodedata.category(letter) == "Cc" else letter for letter in shown)


def _shortened(part: str) -> str:
    encoded = part.encode()
    if len(encoded) <= _MOST_BYTES:
        return part
    digest = sha256(encoded).hexdigest()[:8]
    return f"{encoded[: _MOST_BYTES - len(digest) - 1].decode('utf-8', 'ignore')}_{digest}"
