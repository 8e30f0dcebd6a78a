"""Words of a command line that decide the defaults of its options, found before tyro parses it."""

from collections.abc import Collection, Sequence
from itertools import pairwise
from typing import TypeVar

Name = TypeVar("Name", bound=str)


def values_of(option: str, arguments: Sequence[str], short: str = "") -> list[str]:
    """The values given to an option: --out X, --out=X, and by its short form -o X, -oX or -o=X."""
    found = []
    for word, after in pairwise([*arguments, ""]):
        if word == option or (short and word == short):
            found.append(after)
        elif word.startswith(f"{option}="):
            found.append(word.removeprefix(f"{option}="))
        elif short and word.startswith(short) and not word.startswith("--"):
            found.append(word.removeprefix(short).removeprefix("="))
    return found


def named(option: str, arguments: Sequence[str], known: Collection[Name]) -> Name | None:
    """The first known value that is given to an option; tyro refuses the others."""
    given = values_of(option, arguments)
    return next((one for value in given for one in known if one == value), None)
