"""The dives of a batch: videos, folders of images, folders that hold several of them, and tables with options."""

import glob
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

from swimm3r.batch.dive import Dive, check_names
from swimm3r.batch.sheet import read_sheet
from swimm3r.errors import InputError
from swimm3r.io import images
from swimm3r.io.bags.bag import is_bag
from swimm3r.io.raw import RAW_SUFFIXES
from swimm3r.io.video import VIDEO_SUFFIXES
from swimm3r.pipeline.presets import RunSettings
from swimm3r.prepare import check_source
from swimm3r.prepare.rig import STEREO
from swimm3r.scene.run_folder import is_run


@dataclass(frozen=True)
class Skipped:
    """A path that is no dive, and the reason."""

    path: Path
    reason: str


@dataclass(frozen=True)
class FoundDives:
    """The dives of a command line, and what lies beside them."""

    dives: tuple[Dive, ...]
    skipped: tuple[Skipped, ...] = ()


def find_dives(given: Sequence[Path], settings: RunSettings, out: Path, reference: Path | None = None) -> FoundDives:
    """The dives that paths name: videos, folders of images, folders of such, patterns, and CSV tables.

    Raises InputError where a path leads nowhere or there is no dive at all, and UsageError for a table that cannot be
    used and for two dives of one name.
    """
    dives: list[Dive] = []
    skipped: list[Skipped] = []
    for path in given:
        if path.suffix.lower() == ".csv" and path.is_file():
            dives += read_sheet(path, settings, reference)
            continue
        for one in _expanded(path):
            sources, others = _dives_at(one, out, settings.frames.rig or STEREO)
            dives += [Dive(_name_of(source), source, settings, reference) for source in sources]
            skipped += others
    if not dives:
        raise InputError(
            f"there is no dive in {', '.join(map(str, given))}",
            cause="; ".join(f"{one.path.name}: {one.reason}" for one in skipped[:3]) or "the folder is empty",
            hint="videos, folders of images, a folder that holds such, or a CSV table with a column `dive`",
        )
    return FoundDives(_with_own_names(dives), tuple(skipped))


def _expanded(path: Path) -> list[Path]:
    """The paths that a pattern stands for; a path that exists stands for itself."""
    if path.exists():
        return [path]
    found = sorted(map(Path, glob.glob(str(path), recursive=True))) if glob.has_magic(str(path)) else []
    if not found:
        raise InputError(
            f"there is no {path}",
            cause="a slip in the name or the pattern, or a disk that is not mounted",
            hint="videos, folders of images, a folder that holds such, or a CSV table with a column `dive`",
        )
    return found


def _dives_at(path: Path, out: Path, cameras: Sequence[str]) -> tuple[list[Path], list[Skipped]]:
    """The path where it is a dive, else those of its children that are; and the others with the reason.

    A folder with a folder of each of the `cameras` is a dive of their rig.

    A folder whose images lie deeper counts where it was named itself and no child of it is a dive.
    """
    own = _reason_against(path, out, cameras)
    if own is None:
        return [path], []
    if path.is_dir() and not is_run(path) and path.resolve() != out.resolve():
        children = sorted(child for child in path.iterdir() if not child.name.startswith("."))
        reasons = {child: _reason_against(child, out, cameras) for child in children}
        dives = [child for child, reason in reasons.items() if reason is None]
        if dives:
            return dives, [Skipped(child, reason) for child, reason in reasons.items() if reason is not None]
        if _refusal(path) is None:
            return [path], []
    return [], [Skipped(path, own)]


def _reason_against(path: Path, out: Path, cameras: Sequence[str]) -> str | None:
    """The reason why a path is no dive; None where it is one."""
    try:
        return _reason_in(path, out, cameras)
    except OSError as error:  # lost+found of a disk, somebody else's folder
        return f"it cannot be read: {error.strerror}"


def _reason_in(path: Path, out: Path, cameras: Sequence[str]) -> str | None:
    """`_reason_against` of a path that may be looked into."""
    if path.resolve() == out.resolve():
        return "it is the folder of the results"
    if is_bag(path):
        return _refusal(path)
    if path.is_dir():
        if is_run(path):
            return "it is the folder of a run"
        suffixes = {child.suffix.lower() for child in path.iterdir() if child.is_file()}
        folders = {child.name.lower() for child in path.iterdir() if child.is_dir()}
        inner = "images" in folders or folders >= {name.lower().rstrip("/\\") for name in cameras}
        if not inner and not suffixes & {*images.SUFFIXES, *RAW_SUFFIXES, *VIDEO_SUFFIXES}:
            return "it holds no images, no camera raw files, no folder images/ and no video"
    elif path.suffix.lower() not in VIDEO_SUFFIXES:
        return "it is neither a folder nor a video nor a bag"
    return _refusal(path)


def _refusal(path: Path) -> str | None:
    """The reason why a run would refuse an input at first sight."""
    try:
        check_source(path)
    except InputError as error:
        return error.what
    return None


def _name_of(source: Path) -> str:
    folder = source.resolve()
    if folder.is_dir():
        return folder.parent.name if folder.name == "images" else folder.name
    return folder.stem


def _with_own_names(dives: Sequence[Dive]) -> tuple[Dive, ...]:
    """The dives; those of one name get that of the folder above before it."""
    count = Counter(dive.name.casefold() for dive in dives)

    def with_own(dive: Dive) -> Dive:
        above = dive.source.resolve().parent.name
        return replace(dive, name=f"{above}-{dive.name}") if count[dive.name.casefold()] > 1 else dive

    told_apart = tuple(map(with_own, dives))
    check_names(told_apart)
    return told_apart
