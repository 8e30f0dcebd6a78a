"""Ways to damage a file, by kind; each takes the path of a good file and leaves a bad one."""

import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np

Damage = Callable[[Path], None]


def truncated(path: Path) -> None:
    """The first third of the file."""
    data = path.read_bytes()
    path.write_bytes(data[: max(1, len(data) // 3)])


def empty(path: Path) -> None:
    """No bytes."""
    path.write_bytes(b"")


def garbage(path: Path) -> None:
    """Bytes that are no text and no known format."""
    path.write_bytes(bytes(range(130, 256)) * 20)


def missing(path: Path) -> None:
    """No file."""
    path.unlink()


def folder(path: Path) -> None:
    """A folder of that name."""
    path.unlink()
    path.mkdir()


ANY = {f.__name__: f for f in (truncated, empty, garbage, missing, folder)}


def _text(value: str) -> Damage:
    def write(path: Path) -> None:
        path.write_text(value)

    return write


JSON_KINDS: dict[str, Damage] = {
    "list": _text("[]"),
    "null": _text("null"),
    "number": _text("3"),
    "object": _text("{}"),
    "deep": _text("[" * 100_000),
    "deep-object": _text('{"a":' * 100_000),
}


def edited(change: Callable[[Any], Any]) -> Damage:
    """The JSON document after `change`, which edits it in place or returns another."""

    def damage(path: Path) -> None:
        document = json.loads(path.read_text())
        path.write_text(json.dumps(change(document) or document))

    return damage


def npz(**changes: Any) -> Damage:
    """Arrays replaced by name: an array, a function of the old one, or None to leave it out."""

    def damage(path: Path) -> None:
        with np.load(path) as stored:
            arrays = {name: stored[name] for name in stored.files}
        for name, change in changes.items():
            if change is None:
                arrays.pop(name, None)
            else:
                arrays[name] = change(arrays[name]) if callable(change) else change
        np.savez(path, **arrays)

    return damage


def pickled(path: Path) -> None:
    """An archive of a pickled object."""
    np.savez(path, z_depth=np.array([{}], dtype=object), confidence=np.array([{}], dtype=object))
