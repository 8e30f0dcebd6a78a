"""`swimm3r weights list|get|verify|path`: which model weights exist, which are here, and how the others come here."""

from pathlib import Path
from typing import Annotated

from tyro.conf import Positional, arg

from swimm3r import weights as store
from swimm3r.cli.terminal.console import drawn_progress
from swimm3r.errors import WeightsError

Name = Annotated[str, arg(metavar="NAME")]


def list_all() -> None:
    """Print every file this program can use: what for, its size, its license, and where it lies. No network."""
    for entry in store.MANIFEST:
        size = "size not published" if entry.about_mb is None else f"{entry.about_mb:,.4g} MB"
        print(f"{entry.name:<20} {whereabouts(entry.name)}\n    {entry.purpose}; {size}\n    {entry.license}")
    print(f"Downloads go to {store.directory()}")


def get(name: Positional[Name], /, accept_license: bool = False) -> None:
    """Download weights, or go on with an interrupted download, and print where they lie.

    Args:
        name: Name of the weights, as `swimm3r weights list` prints it.
        accept_license: Confirm that you have read the license of non-commercial weights and your use is within it.
    """
    with drawn_progress() as progress:
        path = store.fetch(name, accept_license=accept_license, progress=progress)
    print(path)


def verify(name: Positional[Name], /, file: Path | None = None) -> None:
    """Read a whole file and compare its checksum with the published one, else with that of its first use.

    Args:
        name: Name of the weights, as `swimm3r weights list` prints it.
        file: File to check, if it lies elsewhere.
    """
    checked = store.verify(name, file)
    outcome = {
        "published": "is the published file",
        "first use": "is unchanged since its first use here (no checksum is published)",
        "nothing": "has no published checksum; this one is kept to compare with from now on",
    }[checked.against]
    print(f"{checked.path} {outcome}: {checked.size:,} bytes, sha256 {checked.sha256}")


def path(name: Positional[Annotated[str | None, arg(metavar="[NAME]")]] = None, /) -> None:
    """Print the path of weights, for scripts; without a name the folder downloads go to. No network.

    Args:
        name: Name of the weights, as `swimm3r weights list` prints it.
    """
    print(store.directory() if name is None else store.require(name))


WEIGHTS = {"list": list_all, "get": get, "verify": verify, "path": path}
"""The sub-commands by their names."""


def whereabouts(name: str) -> str:
    """The path of weights, or why there is none."""
    try:
        found = store.find(name)
    except WeightsError as damaged:
        return damaged.what
    except OSError as error:
        return f"not known: {error.filename} cannot be read ({error.strerror})"
    return "not here" if found is None else str(found)
