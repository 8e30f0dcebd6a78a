"""Weight files on this computer: where they are looked for, and whether they are whole.

A file is looked for at the path the user gave, then in $SWIMM3R_WEIGHTS_DIR, then in the cache ($SWIMM3R_CACHE, else
$XDG_CACHE_HOME/swimm3r). Where the author publishes no checksum, the one of the first complete download is kept beside
the file and later compared with ("trust on first use").
"""

import hashlib
import logging
import os
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

from swimm3r.errors import WeightsError
from swimm3r.weights.manifest import MANIFEST, Weights, entry

log = logging.getLogger(__name__)


@dataclass(frozen=True)
class Checked:
    """A file whose size and checksum are as expected."""

    path: Path
    size: int
    sha256: str
    against: Literal["published", "first use", "nothing"]
    """The source of the expected digest; "nothing" on first use."""


def directory() -> Path:
    """Folder of downloads: $SWIMM3R_WEIGHTS_DIR, else `weights` in the cache."""
    return directories()[0]


def directories() -> list[Path]:
    """Folders that are searched for weights, in order."""
    given = os.environ.get("SWIMM3R_WEIGHTS_DIR")
    return [*([Path(given)] if given else []), cache_folder() / "weights"]


def cache_folder() -> Path:
    """Folder of files that can be downloaded or computed again."""
    given = os.environ.get("SWIMM3R_CACHE")
    return Path(given) if given else Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache") / "swimm3r"


def find(name: str, explicit: Path | None = None, manifest: tuple[Weights, ...] = MANIFEST) -> Path | None:
    """Path of the weights, or None. Never uses the network.

    Raises WeightsError for an explicit path without a file, a folder that cannot be read, and a file of the wrong size.
    """
    if explicit is not None:
        if not _is_there(explicit):
            raise WeightsError(
                f"there are no weights at {explicit}",
                cause="the path is mistyped, or is a folder",
                hint=f"give the path of {entry(name, manifest).filename} itself, or swimm3r weights get {name}",
            )
        return explicit
    wanted = entry(name, manifest)
    for weights in (wanted, *(w for w in manifest if w.serves_as == name)):
        for folder in directories():
            path = folder / weights.filename
            if _is_there(path):
                check_size(path, weights)
                return path
    return None


def _is_there(path: Path) -> bool:
    """Return whether a file is there. Raises WeightsError where the folder does not let anybody look."""
    try:
        return path.is_file()
    except OSError as error:
        raise WeightsError(
            f"{path.parent} cannot be looked into ({error.strerror})",
            cause="the folder of weights belongs to somebody else, or its disk is not there",
            hint="chmod u+rx on it, or $SWIMM3R_WEIGHTS_DIR with a folder of your own",
        ) from error


def require(name: str, explicit: Path | None = None, manifest: tuple[Weights, ...] = MANIFEST) -> Path:
    """`find`, or a WeightsError that says which file is missing, how large it is, where it is and where to put it."""
    path = find(name, explicit, manifest)
    if path is None:
        raise missing(entry(name, manifest), f"the weights {name!r} are not on this computer", "nobody got them yet")
    return path


def verify(name: str, explicit: Path | None = None, manifest: tuple[Weights, ...] = MANIFEST) -> Checked:
    """Reads the whole file and compares its checksum with the published one, else with that of the first use.

    Raises WeightsError where they differ.
    """
    path = require(name, explicit, manifest)
    weights = next((w for w in manifest if w.filename == path.name), entry(name, manifest))
    checked = compare(weights, path)
    if checked.against == "nothing":
        note(path, checked.sha256)
    return checked


def compare(weights: Weights, path: Path) -> Checked:
    """The result of `verify` for one file; a file just downloaded is deleted if its digest is wrong."""
    check_size(path, weights)
    with path.open("rb") as file:
        digest = hashlib.file_digest(file, "sha256").hexdigest()
    noted = _noted(path)
    if weights.sha256 is not None:
        expected, against = weights.sha256, "published"
    elif noted.is_file():
        expected, against = noted.read_text().split()[0], "first use"
    else:
        return Checked(path, path.stat().st_size, digest, "nothing")
    if not digest.startswith(expected):
        arriving = path.suffix == ".part"
        if arriving:
            path.unlink()
        raise WeightsError(
            f"{path} is not the {against} file: sha256 {digest}, expected {expected}",
            cause="it was damaged on the way, or replaced by another version",
            hint="download it again" if arriving else f"delete it, then swimm3r weights get {weights.name}",
        )
    return Checked(path, path.stat().st_size, digest, against)


def _noted(path: Path) -> Path:
    return path.with_name(path.name + ".sha256")


def note(path: Path, digest: str) -> None:
    """Keep the checksum of a first use."""
    try:
        _noted(path).write_text(f"{digest}  {path.name}\n")
    except OSError as error:  # a read-only folder of shared weights is no reason to stop
        log.warning("%s: its checksum could not be kept (%s)", path, error)


def check_size(path: Path, weights: Weights) -> None:
    """Raises WeightsError for an empty file, or one that is not as long as the published one."""
    size = path.stat().st_size
    if size == 0 or (weights.size is not None and size != weights.size):
        expected = f"{weights.size:,}" if weights.size is not None else "more"
        raise WeightsError(
            f"{path} has {size:,} bytes, expected {expected}",
            cause="a copy or a download that stopped early, or another version",
            hint=f"delete it, then swimm3r weights get {weights.name}",
        )


def missing(weights: Weights, what: str, cause: str) -> WeightsError:
    """The error of a file that is not here, with how to bring it."""
    accept = " --accept-license" if weights.non_commercial else ""
    size = f"about {weights.about_mb:g} MB" if weights.about_mb is not None else "size not published"
    return WeightsError(
        what,
        cause=cause,
        hint=f"with a network: swimm3r weights get {weights.name}{accept}; without: bring {weights.filename} "
        f"({size}) from {weights.urls[0]} and put it into {directory()}",
    )
