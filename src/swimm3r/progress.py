"""Progress of long work, reported to its caller; drawn only by the command line."""

from typing import Protocol, runtime_checkable


@runtime_checkable  # so that the suite can check calls against it
class Progress(Protocol):
    """Called as `progress("matching", 12, 300)`. Whatever it raises (KeyboardInterrupt) stops the work cleanly."""

    def __call__(self, what: str, done: int, total: int, /) -> None: ...


def silent(what: str, done: int, total: int, /) -> None:
    """The default: nobody is watching."""
