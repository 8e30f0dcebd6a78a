"""Keys of results that are kept on disk: another key wherever anything that decided the result is another.

A result is decided by its settings, by the content of the files it was made from (weights among them, or that there
were none) and by the code that made it. The code counts as its statements: comments, docstrings and the modules that
only show results leave a key as it is, so that kept results survive an edit that cannot have changed them.
"""

import ast
import json
import os
from collections.abc import Sequence
from contextlib import suppress
from dataclasses import asdict, is_dataclass
from functools import cache, lru_cache
from hashlib import file_digest, sha256
from importlib.metadata import version
from pathlib import Path
from typing import Any

import swimm3r

_ONLY_SHOWS = ("cli", "report", "export")
_OF_SYSTEMS = ("thumbs.db", "desktop.ini")
_LENGTH = 32  # hexadecimal digits
_READ_WHOLE = 64 << 20  # bytes
_SAMPLE = 16 << 10  # bytes, at either end of a file


def cache_key(*parts: object) -> str:
    """The key of a result that these decided: plain values, paths (as they are written), dataclasses of such."""
    text = json.dumps([_plain(part) for part in parts], sort_keys=True)
    return sha256(text.encode()).hexdigest()[:_LENGTH]


def bytes_digest(*parts: bytes) -> str:
    """Of parts of bytes, each as a whole: moving a byte from one to the next gives another digest."""
    return sha256(b"".join(sha256(part).digest() for part in parts)).hexdigest()[:_LENGTH]


def content_digest(path: Path | None) -> str | None:
    """Of a file's bytes, or of all files below a folder with their names; None where there is nothing."""
    if path is None or not path.exists():
        return None
    if path.is_file():
        stat = path.stat()
        return _file_digest(path.resolve(), stat.st_size, stat.st_mtime_ns)
    return cache_key(*([file.relative_to(path).as_posix(), content_digest(file)] for file in files_below(path)))


def given_digest(path: Path) -> str | None:
    """Of a file or folder that a setting names; None where there is nothing.

    A file of up to 64 MiB is read whole. A larger one, and the files of a folder, count by names, sizes and their first
    and last 16 KiB (`sample_digest`): bags, weights, and folders of masks or models would take long otherwise.
    """
    if not path.exists():
        return None
    whole = path.is_file() and path.stat().st_size <= _READ_WHOLE
    return content_digest(path) if whole else sample_digest(path)


def sample_digest(path: Path, leave_out: Path | None = None) -> str:
    """Of a file's size and of its first and last 16 KiB, or of those of all files below a folder with their names.

    Hours of video are told apart as fast as they are found, and a copy on another disk is the same. Files below
    `leave_out` are no part of it, nor are hidden ones and those that systems leave in folders (.DS_Store, Thumbs.db);
    those that may not be read count by name and size.
    """
    return samples_digest(path, files_below(path, leave_out))


def samples_digest(path: Path, files: Sequence[Path]) -> str:
    """`sample_digest` of some of the files below a folder, in their order."""
    digest = sha256()
    for file in (file for file in files if not _is_of_system(file.relative_to(path))):
        with suppress(FileNotFoundError):  # removed meanwhile
            size = file.stat().st_size
            digest.update(f"{file.relative_to(path)}|{size}\n".encode(errors="surrogateescape"))
            with suppress(PermissionError), file.open("rb") as opened:  # whoever needs the file says so
                for start in sorted({0, max(0, size - _SAMPLE)}):
                    opened.seek(start)
                    digest.update(opened.read(_SAMPLE))
    return digest.hexdigest()[:_LENGTH]


def files_below(path: Path, leave_out: Path | None = None) -> list[Path]:
    """The file itself, or all files below a folder, sorted; folders that may not be searched count as empty."""
    if not path.is_dir():
        return [path]
    closed = None if leave_out is None else os.path.realpath(leave_out)
    found: list[Path] = []
    for where, folders, names in os.walk(path):
        folders[:] = [name for name in folders if os.path.realpath(Path(where, name)) != closed]
        found += [Path(where, name) for name in names]
    return sorted(file for file in found if os.path.isfile(file))


@cache
def code_version() -> str:
    """Of the statements of this package, as they lie on disk."""
    package = Path(swimm3r.__file__).parent
    digest = sha256(version("swimm3r").encode())
    for path in sorted(package.rglob("*.py")):
        if path.relative_to(package).parts[0] not in _ONLY_SHOWS:
            digest.update(path.relative_to(package).as_posix().encode())
            digest.update(statements(path.read_text(encoding="utf-8")).encode())
    return digest.hexdigest()[:_LENGTH]


def statements(source: str) -> str:
    """Python source without what does not run: comments, layout, docstrings."""
    tree = ast.parse(source)
    for node in ast.walk(tree):
        body = getattr(node, "body", None)
        if isinstance(body, list):
            node.body = [line for line in body if not _is_text(line)]  # pyright: ignore[reportAttributeAccessIssue]
    return ast.dump(tree)


@lru_cache(maxsize=4096)
def _file_digest(path: Path, size: int, changed: int) -> str:
    with path.open("rb") as file:
        return file_digest(file, "sha256").hexdigest()[:_LENGTH]


def _is_of_system(relative: Path) -> bool:
    return any(part.startswith(".") for part in relative.parts) or relative.name.lower() in _OF_SYSTEMS


def _is_text(node: Any) -> bool:
    return isinstance(node, ast.Expr) and isinstance(node.value, ast.Constant) and isinstance(node.value.value, str)


def _plain(value: object) -> object:
    """The value as JSON can hold it; dataclasses carry the name of their type, which is a part of their identity."""
    if is_dataclass(value) and not isinstance(value, type):
        return {type(value).__name__: _plain(asdict(value))}
    if isinstance(value, dict):
        return {str(name): _plain(inner) for name, inner in value.items()}
    if isinstance(value, list | tuple):
        return [_plain(inner) for inner in value]
    if isinstance(value, Path):
        return str(value)
    return value
