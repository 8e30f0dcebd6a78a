"""Tasks that processes elsewhere can import: they leave files, fail, end their own process or wait."""

import os
import signal
import time
from dataclasses import dataclass
from pathlib import Path

from swimm3r.errors import InputError


@dataclass(frozen=True)
class Part:
    """A named piece of work."""

    name: str
    folder: Path


def work(part: Part) -> None:
    """Write a file that says which process did it; names ask for mishaps."""
    tries = part.folder / f"{part.name}.tries"
    with tries.open("a", encoding="utf-8") as file:
        file.write("x")
    print(f"working on {part.name}")
    if part.name == "refused":
        raise InputError("no frames in it", cause="an empty folder", hint="another one")
    if part.name == "faulty":
        raise ZeroDivisionError("division of a fish by zero")
    if part.name == "killed-once" and len(tries.read_text()) == 1:
        os.kill(os.getpid(), signal.SIGKILL)
    if part.name == "killed":
        os.kill(os.getpid(), signal.SIGKILL)
    (part.folder / f"{part.name}.done").write_text(f"{os.getpid()} {os.environ.get('OMP_NUM_THREADS', '')}")


def wait_long(part: Part) -> None:
    """Say which process waits, and wait longer than any test."""
    (part.folder / f"{part.name}.pid").write_text(str(os.getpid()))
    time.sleep(600)


def tries_of(part: Part) -> int:
    """Number of attempts at a piece of work."""
    path = part.folder / f"{part.name}.tries"
    return len(path.read_text()) if path.exists() else 0
