"""Failures a user can cause or mend: what happened, the likely cause, one thing to try, and the exit code.

Exit codes: 0 done, 2 usage, 3 input data, 4 weights, 5 device or memory, 6 too few registered images, 7 storage, 8
dives of a batch failed for different reasons, 130 interrupted, 141 the reader of the output ended.
Everything else is our own mistake and keeps its traceback.
"""

from functools import partial
from typing import Any


class Swimm3rError(Exception):
    """Something the user can act on."""

    exit_code = 1

    def __init__(self, what: str, *, cause: str, hint: str) -> None:
        super().__init__(what)
        self.what = what
        self.cause = cause
        self.hint = hint

    def __reduce__(self) -> tuple[Any, ...]:
        return partial(type(self), cause=self.cause, hint=self.hint), (self.what,)  # between processes

    def __str__(self) -> str:
        return f"{self.what}\n  Likely cause: {self.cause}\n  Try: {self.hint}"


class UsageError(Swimm3rError):
    """The command or the settings contradict themselves."""

    exit_code = 2


class InputError(Swimm3rError):
    """The video, the images, the masks or another input file cannot be used."""

    exit_code = 3


class WeightsError(Swimm3rError):
    """Model weights are missing, damaged or of another model."""

    exit_code = 4


class DeviceError(Swimm3rError):
    """The requested accelerator is missing, or memory ran out: its own or the computer's."""

    exit_code = 5


class RegistrationError(Swimm3rError):
    """Too few frames could be placed relative to each other."""

    exit_code = 6


class StorageError(Swimm3rError):
    """The disk is full or cannot be written."""

    exit_code = 7
