"""One attempt at a task: done, or the error and whether another attempt can end otherwise."""

import contextlib
import logging
import os
import sys
import traceback
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path, PurePath
from typing import Any, Protocol, runtime_checkable

from swimm3r.errors import DeviceError, StorageError, Swimm3rError
from swimm3r.io.files.refusals import refusal
from swimm3r.io.files.safe_names import safe_name
from swimm3r.memory import out_of_memory
from swimm3r.tasks.threads import limit_threads

log = logging.getLogger(__name__)


@runtime_checkable  # so that the suite can check calls against it
class Named(Protocol):
    """A small picklable value with a name, such as a frozen record."""

    @property
    def name(self) -> str: ...


Work = Callable[[Any], object]
"""`work(item)`: a function of a module, or a `partial` of one. It keeps its results in files, and a repeated call makes
only those that are missing. Its result is dropped."""


class TaskError(Swimm3rError):
    """A task ended through a fault of Swimm3R or of a library."""


@dataclass(frozen=True)
class Failure:
    """A task that did not succeed, and its log where there is one."""

    name: str
    error: Swimm3rError
    log: Path | None = None

    @property
    def message(self) -> str:
        """One line."""
        return self.error.what


@dataclass(frozen=True)
class Ended:
    """The end of one attempt; without an error the task is done."""

    error: Swimm3rError | None = None

    @property
    def is_worth_another(self) -> bool:
        """The same task can succeed at another time: its error is not one of the input or the settings."""
        return isinstance(self.error, DeviceError | StorageError | TaskError)


def attempt(work: Work, item: Any) -> Ended:
    """Do the work; every failure but an interruption becomes part of the result."""
    try:
        work(item)
    except Swimm3rError as error:
        return Ended(error)
    except Exception as error:  # a task's fault must not end the others
        told = out_of_memory(error) or refusal(error)
        if told is None:
            log.exception("%s failed", item.name)
        return Ended(told or _fault(item.name, error))
    return Ended()


def attempt_in_a_process(work: Work, item: Any, threads: int, path: Path | None) -> Ended:
    """The same in a process that only does tasks: with its share of the cores, everything it prints in a log."""
    limit_threads(threads)
    with contextlib.ExitStack() as stack:
        if path is not None:
            stack.enter_context(_printing_to(path))
        return attempt(work, item)


def ended_unheard(name: str, why: str) -> Ended:
    """The end of an attempt whose process is gone."""
    return Ended(
        DeviceError(
            f"the process of {name} ended before its work was done ({why})",
            cause="it was killed: the memory ran out, a time limit passed, or somebody ended it",
            hint="fewer --jobs, or more memory for each; the same command then goes on from what is finished",
        )
    )


def log_path(logs: Path | None, name: str) -> Path | None:
    """The log of a task."""
    return None if logs is None else logs / (safe_name(PurePath(name + ".log")) + ".log")


def _fault(name: str, error: Exception) -> TaskError:
    where = traceback.extract_tb(error.__traceback__)[-1]
    return TaskError(
        f"{name} failed: {type(error).__name__}: {str(error).splitlines()[0] if str(error) else 'no message'}",
        cause=f"a fault of Swimm3R or of a library, at {Path(where.filename).name}:{where.lineno}",
        hint="the traceback in its log, or above; report it with the log",
    )


@contextlib.contextmanager
def _printing_to(path: Path) -> Iterator[None]:
    """Everything that the process prints inside, libraries in other languages included, at the end of a file."""
    path.parent.mkdir(parents=True, exist_ok=True)
    for stream in (sys.stdout, sys.stderr):
        stream.flush()
    before = [os.dup(number) for number in (1, 2)]
    file = os.open(path, os.O_WRONLY | os.O_CREAT | os.O_APPEND, 0o666)
    try:
        for number in (1, 2):
            os.dup2(file, number)
        handler = logging.StreamHandler(os.fdopen(os.dup(file), "w", encoding="utf-8"))
        handler.setFormatter(logging.Formatter("%(asctime)s %(message)s", "%Y-%m-%d %H:%M:%S"))
        root, package = logging.getLogger(), logging.getLogger("swimm3r")
        others, level = root.handlers[:], package.level
        root.handlers[:] = [handler]
        package.setLevel(logging.INFO)
        try:
            yield
        finally:
            root.handlers[:] = others
            package.setLevel(level)
            handler.stream.close()
    finally:
        for stream in (sys.stdout, sys.stderr):
            stream.flush()
        for number, kept in zip((1, 2), before, strict=True):
            os.dup2(kept, number)
            os.close(kept)
        os.close(file)
