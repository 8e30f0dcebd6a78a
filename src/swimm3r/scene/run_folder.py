"""A run folder as its readers find it: which stages are finished, by summary.json, and what is missing.

docs/conventions.md shows the layout.
"""

import json
import os
from dataclasses import dataclass, field
from importlib.metadata import version
from pathlib import Path
from typing import Any, Literal

from swimm3r.errors import InputError, UsageError
from swimm3r.io.files.damage import Remedy
from swimm3r.io.files.folder_lock import LOCK
from swimm3r.io.files.json_file import read_json

SCHEMA = 2  # 1: Swimm3R 0.1, whose settings and files have other names
STAGES = ("prepare", "sfm", "splat", "eval")
MARKERS = {  # what each of them leaves last, or at least
    "prepare": "prepare/frames.json",
    "sfm": "sfm/reconstruction.json",
    "splat": "splat/map.safetensors",
    "eval": "renders/test",
}
RESCALING = Path(".swimm3r-rescale") / "journal.json"  # there while lengths in the folder are of two units
_PRODUCTS = {"prepare": "prepared frames", "sfm": "finished structure from motion", "splat": "a finished map"}
_REMAKE = Remedy("the command that made the run, with --redo: it moves what is there to RUN/old and starts anew")


@dataclass(frozen=True)
class InputRecord:
    """The section `input` of summary.json."""

    path: str
    fingerprint: str


@dataclass(frozen=True)
class StageRecord:
    """One of its `stages`."""

    status: Literal["running", "done"]
    key: str  # of the stage's settings and everything before it
    reference: str | None = None  # the file of known poses that the scores are taken against
    cpu_seconds: float | None = None
    files: dict[str, str] = field(default_factory=dict[str, str])  # digests of those that settings name, by the setting


@dataclass(frozen=True)
class RunFolder:
    """The facts of summary.json that the next command builds on; `sections` is the whole document."""

    folder: Path
    input: InputRecord
    stages: dict[str, StageRecord]
    sections: dict[str, Any]

    def is_finished(self, stage: str) -> bool:
        """Return whether a stage is done and still there."""
        record = self.stages.get(stage)
        return record is not None and record.status == "done" and (self.folder / MARKERS[stage]).exists()


@dataclass(frozen=True)
class _Summary:
    input: InputRecord
    stages: dict[str, StageRecord]
    schema: int
    sfm: dict[str, Any] | None = None
    medium: dict[str, Any] | None = None
    splat: dict[str, Any] | None = None
    test: dict[str, Any] | None = None
    restored: dict[str, Any] | None = None
    truth: dict[str, Any] | None = None
    other_protocols: dict[str, dict[str, Any]] | None = None
    scale: dict[str, Any] | None = None
    water: dict[str, Any] | None = None
    products: dict[str, Any] | None = None
    warnings: tuple[dict[str, str], ...] = ()


def is_run(folder: Path) -> bool:
    """Return whether a folder is one of `swimm3r run`, finished or not."""
    return os.path.isfile(folder / "summary.json")  # unlike Path.is_file, false where no path is that long


def read_run(folder: Path) -> RunFolder:
    """The record of a run, finished or not. Raises InputError where there is none or it is damaged."""
    path = folder / "summary.json"
    if (folder / RESCALING).is_file():
        raise InputError(
            f"{folder} holds lengths of two units: its rescaling was interrupted",
            cause="swimm3r scale was killed, or the computer stopped",
            hint=f"swimm3r scale {folder}, which finishes it",
        )
    if not path.is_file():
        missing = not folder.exists()
        raise InputError(
            f"there is no {folder}" if missing else f"{folder} is no run folder: it holds no summary.json",
            cause="a slip in the name, or the folder was moved" if missing else "it is another folder, or a part of it",
            hint="the folder that --out named when the run was made",
        )
    summary = read_json(path, _Summary, _REMAKE)
    if summary.schema != SCHEMA:
        author = _version_of(folder)
        raise InputError(
            f"{folder} was written by Swimm3R {author} (schema {summary.schema}); this is {version('swimm3r')}, which"
            f" reads schema {SCHEMA}",
            cause="the names of settings and files changed between the two",
            hint=f"pip install 'swimm3r=={author}' to read it, or {_REMAKE.hint}",
        )
    return RunFolder(folder, summary.input, summary.stages, json.loads(path.read_text(encoding="utf-8")))


def _version_of(folder: Path) -> str:
    """The version of Swimm3R that wrote a run, by its versions.json; "of an unknown version" where that is missing."""
    path = folder / "versions.json"
    if not path.is_file():
        return "of an unknown version"
    found = read_json(path, dict[str, str], _REMAKE).get("swimm3r")
    return found or "of an unknown version"


def input_and_folder(source: Path, folder: Path | None) -> tuple[Path, Path]:
    """The input and the run folder; without a folder, the source is a run folder that lends its own input.

    Raises UsageError where it is none.
    """
    if folder is not None:
        return source, folder
    if not is_run(source):
        raise UsageError(
            "the run folder is missing: --out RUN",
            cause=f"{source} is not a run folder, which could be resumed without it",
            hint="--out with a folder that does not exist yet",
        )
    return Path(read_run(source).input.path), source


def open_run(folder: Path, stage: str) -> RunFolder:
    """The record of a run whose `stage` is finished. Raises InputError that says what is not there."""
    run = read_run(folder)
    if not run.is_finished(stage):
        raise InputError(
            f"the run in {folder} has no {_PRODUCTS[stage].removeprefix('a ')} yet",
            cause="it was interrupted, or stopped at an earlier stage",
            hint=f"swimm3r run {folder}, which goes on where it stopped",
        )
    return run


def check_vacant(folder: Path) -> None:
    """Raises InputError where a folder that a run is to go to holds other things."""
    if not is_run(folder) and any(path.name != LOCK for path in folder.iterdir()):
        raise InputError(
            f"{folder} is not empty and is not a run folder",
            cause="--out names a folder with other things in it",
            hint="an --out that does not exist yet",
        )
