"""One cell of a table: the scores of one method on one scene under one seed.

A cell's folder OUT/SCENE/METHOD/SEED keeps what the method made (a map, images) and two keys (`io.files.cache_key`):

    made_from.json   of everything that decides what the method makes: input, settings, weights, the package's code
    scores.json      of that and of what decides the scores alone: the reference, weights of perceptual scores

A cell whose scores have the key is not computed again. One that was cut short, or is only scored differently, goes on
from what its folder holds; what was made from something else is set aside in SEED/old and never taken for it.
"""

import json
import re
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from typing import Any

from swimm3r.errors import DeviceError, UsageError, WeightsError
from swimm3r.evaluate import NotComputed, summary_entries
from swimm3r.io.files.atomic import write_text
from swimm3r.io.files.cache_key import cache_key, code_version
from swimm3r.progress import Progress, silent
from swimm3r.tasks import EngineSettings, run_tasks

Scores = Mapping[str, float | NotComputed]


@dataclass(frozen=True)
class Result:
    """One method on one scene. A method that could not be run says why, and has no scores."""

    scene: str
    method: str
    seed: int
    scores: dict[str, float | NotComputed] = field(default_factory=dict)
    not_run: str = ""


@dataclass(frozen=True)
class ResultKey:
    """The place of a result in the table, which is also its folder's."""

    scene: str
    method: str  # parts that are varied separately stand apart: "colmap / uwbs-static"
    seed: int = 0

    def folder(self, out: Path) -> Path:
        """OUT/SCENE/METHOD/SEED, a folder per part of the method's name."""
        return scene_folder(out, self.scene).joinpath(*map(_plain, self.method.split(" / ")), f"{self.seed}")


def scene_folder(out: Path, scene: str) -> Path:
    """The folder of a scene's results."""
    return out / _plain(scene)


_MARK, _OLD = "made_from.json", "old"

SceneWork = Callable[..., list[Result]]
"""`work(scene, progress=...)`; a `partial` of a module's function, for it is sent to other processes."""


def kept_cell(
    out: Path, place: ResultKey, made_from: object, make: Callable[[Path], Scores], scored_by: object = None
) -> Result:
    """The cell of that place, from its folder where it was computed from the same; else `make(folder)` computes it.

    `made_from` decides what the method makes, `scored_by` besides it the scores; both are what `cache_key` takes, and
    the package's code counts by itself. Where weights or a device are missing the cell says so and is not kept: the
    next call tries again.
    """
    folder = place.folder(out)
    path = folder / "scores.json"
    work = cache_key(code_version(), made_from)
    key = cache_key(work, scored_by)
    stored = _stored(path)
    if stored.get("key") == key:
        return Result(place.scene, place.method, place.seed, _scores(stored["scores"]))
    _set_aside(folder, work)
    try:
        scores = dict(make(folder))
    except (WeightsError, DeviceError) as missing:
        return Result(place.scene, place.method, place.seed, not_run=missing.what)
    document = {"key": key, "scene": place.scene, "method": place.method, "seed": place.seed}
    write_text(path, json.dumps({**document, "scores": summary_entries(scores)}, indent=2) + "\n")
    return Result(place.scene, place.method, place.seed, _scores(summary_entries(scores)))


def _set_aside(folder: Path, work: str) -> None:
    """Leaves in a cell's folder only what was made from that key; the rest moves into folder/old."""
    mark = folder / _MARK
    before = _stored(mark).get("key")
    if before == work:
        return
    others = [path for path in folder.iterdir() if path.name != _OLD] if folder.is_dir() else []
    if others:
        known = before[:8] if isinstance(before, str) else "unknown"
        count = len(list((folder / _OLD).glob(f"{known}-*"))) if (folder / _OLD).is_dir() else 0
        aside = folder / _OLD / f"{known}-{count}"
        aside.mkdir(parents=True)
        for path in others:
            path.rename(aside / path.name)
    write_text(mark, json.dumps({"key": work}) + "\n")


def _stored(path: Path) -> dict[str, Any]:
    """A record of this module; empty where there is none, or one that cannot be read: the cell is then made anew."""
    try:
        found = json.loads(path.read_text(encoding="utf-8"))
    except (FileNotFoundError, NotADirectoryError, ValueError, RecursionError):
        return {}
    return found if isinstance(found, dict) else {}


def check_choice(what: str, chosen: Sequence[str], against: str | None = None) -> None:
    """Raises UsageError where nothing is compared, or differences are asked from something that is not."""
    if not chosen:
        raise UsageError(f"no {what} were named", cause=f"--{what} stands alone", hint=f"leave --{what} out for all")
    if against is not None and against not in chosen:
        raise UsageError(
            f"differences cannot be taken from {against}: it is not among the {what}",
            cause=f"compared are {', '.join(chosen)}",
            hint=f"--against one of them, or add {against} to --{what}",
        )


def over_scenes(
    scenes: Sequence[object], work: SceneWork, out: Path, how: EngineSettings, progress: Progress = silent
) -> list[Result]:
    """The cells of all scenes in the scenes' order. One scene's error is raised when the others are done."""
    if not scenes:
        raise UsageError(
            "there is nothing to measure on", cause="no run folder or clip was named", hint="name at least one"
        )
    work = partial(work, progress=progress if how.is_in_this_process else silent)
    folder = out / "jobs"
    items = [_Scene(f"{number}", scene) for number, scene in enumerate(scenes)]
    failures = run_tasks(partial(_keep_cells, work=work, folder=folder), items, how, progress, "scenes", logs=folder)
    if failures:
        raise failures[0].error
    return [cell for item in items for cell in _kept_cells(folder / f"{item.name}.json")]


@dataclass(frozen=True)
class _Scene:
    """A scene with the number that its results lie under until they are joined."""

    name: str
    scene: object


def _keep_cells(item: _Scene, *, work: SceneWork, folder: Path) -> None:
    cells = [{**vars(cell), "scores": summary_entries(cell.scores)} for cell in work(item.scene)]
    write_text(folder / f"{item.name}.json", json.dumps(cells, indent=2) + "\n")


def _kept_cells(path: Path) -> list[Result]:
    cells = json.loads(path.read_text(encoding="utf-8"))
    return [Result(**{**cell, "scores": _scores(cell["scores"])}) for cell in cells]


def _scores(entries: Mapping[str, Any]) -> dict[str, float | NotComputed]:
    return {
        name: NotComputed(str(entries.get(f"{name}_reason", "no reason was kept"))) if value is None else float(value)
        for name, value in entries.items()
        if not name.endswith("_reason")
    }


def _plain(name: str) -> str:
    """A folder's name: `+ SGG` is plus-SGG."""
    return re.sub(r"[^\w.+-]+", "-", name.replace("+ ", "plus-")).strip("-.") or "unnamed"
