"""--quiet and --verbose, the same for every command: how much is printed beside the results."""

import inspect
import logging
import sys
from collections.abc import Callable
from functools import wraps
from typing import Annotated, Any, get_type_hints

from tyro.conf import FlagCreatePairsOff, arg

from swimm3r.errors import UsageError

FLAGS = ("-q", "--quiet", "-v", "--verbose")

_Quiet = FlagCreatePairsOff[
    Annotated[bool, arg(aliases=("-q",), help="Print nothing but errors and the final results.")]
]
_Verbose = FlagCreatePairsOff[
    Annotated[bool, arg(aliases=("-v",), help="Print the log messages of every module, with the time.")]
]


class MessagePrinter(logging.Handler):
    """Prints messages to the current stderr: above the progress bars, while any are drawn."""

    def emit(self, record: logging.LogRecord) -> None:
        print(self.format(record), file=sys.stderr, flush=True)


def begin_messages() -> None:
    """Print the package's messages, and warnings of others, to stderr."""
    logging.basicConfig(level=logging.WARNING, format="%(message)s", handlers=[MessagePrinter()])
    set_level(quiet=False, verbose=False)


def set_level(*, quiet: bool, verbose: bool) -> None:
    """Choose which messages of the package are printed. Raises UsageError where both are chosen."""
    if quiet and verbose:
        raise UsageError(
            "--quiet and --verbose exclude each other",
            cause="both were given",
            hint="one of them, or neither",
        )
    logging.getLogger("swimm3r").setLevel(logging.ERROR if quiet else logging.DEBUG if verbose else logging.INFO)
    form = "%(asctime)s %(name)s: %(message)s" if verbose else "%(message)s"
    for handler in logging.getLogger().handlers:
        if isinstance(handler, MessagePrinter):
            handler.setFormatter(logging.Formatter(form, "%H:%M:%S"))


def is_quiet() -> bool:
    """Return whether nothing but errors and final results is asked for."""
    return not logging.getLogger("swimm3r").isEnabledFor(logging.WARNING)


def with_output_level(command: Callable) -> Callable:
    """The command with --quiet and --verbose, which take effect before it runs."""

    @wraps(command)
    def call(*arguments: Any, quiet: bool = False, verbose: bool = False, **options: Any) -> None:
        set_level(quiet=quiet, verbose=verbose)
        command(*arguments, **options)

    given = inspect.signature(command)
    hints = {**get_type_hints(command, include_extras=True), "quiet": _Quiet, "verbose": _Verbose}
    levels = [
        inspect.Parameter(name, inspect.Parameter.KEYWORD_ONLY, default=False, annotation=hints[name])
        for name in ("quiet", "verbose")
    ]
    signature = given.replace(parameters=[*given.parameters.values(), *levels])
    setattr(call, "__signature__", signature)  # noqa: B010 - functions have it, type stubs not
    call.__annotations__ = hints
    del call.__wrapped__  # tyro would read that one's hints
    return call
