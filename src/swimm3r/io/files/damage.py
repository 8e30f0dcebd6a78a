"""Files that cannot be read back, told in one form: the file, the fault, the likely cause, and what makes it again.

Readers put `guard` around what they do with a file: the errors of the operating system and of the decoders become one
error of `swimm3r.errors` that names the file. A ValueError raised inside, by a check of the content, does so too.
"""

import json
import zipfile
import zlib
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path

from safetensors import SafetensorError

from swimm3r.errors import InputError, Swimm3rError


@dataclass(frozen=True)
class Remedy:
    """Advice for the user of a file that is refused."""

    hint: str
    cause: str = "a crash or a full disk cut it off, it was edited, or another version of swimm3r wrote it"
    error: type[Swimm3rError] = InputError
    fault: str = "is damaged"  # said of a file that is there and holds something else than it should


def remake(path: Path) -> Remedy:
    """Advice for a file that is made again with what `path`, it or the folder of a finished stage, held."""
    return Remedy(f"remove {path}; the swimm3r command that made it makes it again")


def damaged(path: Path, why: str, remedy: Remedy) -> Swimm3rError:
    """The error of a file that is there and holds something else than it should."""
    return _refused(f"{path} {remedy.fault} ({why})", remedy)


@contextmanager
def guard(path: Path, remedy: Remedy) -> Iterator[None]:
    """Turn whatever a damaged, missing or foreign file causes inside the block into one error that names it."""
    try:
        yield
    except FileNotFoundError as error:
        raise _refused(f"{path} is missing", remedy) from error
    except IsADirectoryError as error:
        raise _refused(f"{path} is a folder where a file is expected", remedy) from error
    except json.JSONDecodeError as error:
        raise damaged(path, f"line {error.lineno}: {error.msg}", remedy) from error
    except UnicodeDecodeError as error:
        raise damaged(path, "it is not UTF-8 text", remedy) from error
    except RecursionError as error:
        raise damaged(path, "it is nested too deeply", remedy) from error
    except KeyError as error:
        raise damaged(path, f"it has no {error.args[0]}", remedy) from error
    except zlib.error as error:
        raise damaged(path, "its compressed data are broken", remedy) from error
    except (ValueError, IndexError, ArithmeticError, EOFError, zipfile.BadZipFile, SafetensorError) as error:
        raise damaged(path, first_line(error), remedy) from error
    except OSError as error:
        raise _refused(f"{path} cannot be read ({error.strerror or first_line(error)})", remedy) from error


def first_line(error: BaseException) -> str:
    """The first line of an error's text, or the name of its kind where it has none."""
    lines = str(error).strip().splitlines()
    return lines[0][:200] if lines else type(error).__name__


def _refused(what: str, remedy: Remedy) -> Swimm3rError:
    return remedy.error(what, cause=remedy.cause, hint=remedy.hint)
