"""A run folder while it is written: its lock, summary.json and log.jsonl kept current, and what makes room in old/.

A finished or half-finished stage whose settings are others now is never removed: the run is refused with the list of
what differs, or, where the caller says so, the stage moves to RUN/old/N with everything that was made from it.
"""

import json
import logging
import os
import shutil
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import ExitStack, contextmanager
from pathlib import Path
from typing import Any, TypeVar

from swimm3r.errors import DeviceError, InputError, StorageError, Swimm3rError, UsageError
from swimm3r.io.files.atomic import remove_drafts, write_text
from swimm3r.io.files.folder_lock import folder_lock
from swimm3r.io.files.outputs import check_file, output_folder
from swimm3r.memory import available_mb, peak_mb, return_freed
from swimm3r.pipeline.estimate import Estimate, check_disk, duration, size
from swimm3r.pipeline.presets import RunSettings, from_yaml
from swimm3r.pipeline.run_settings import differences, files_by_stage, with_stages_of
from swimm3r.pipeline.stage_keys import StageKey, stage_keys
from swimm3r.pipeline.stage_start import StageStart, ignore_stages
from swimm3r.products.record import summary_section
from swimm3r.scale.rescale import finish_rescale
from swimm3r.scene.run_folder import MARKERS, SCHEMA, STAGES, RunFolder, StageRecord, check_vacant, is_run, read_run

log = logging.getLogger(__name__)
Result = TypeVar("Result")

_SECTIONS = {  # of summary.json that a stage makes; "medium.splat" is an entry of the section "medium"
    "prepare": (),
    "sfm": (
        *("sfm", "rig", "moving", "flicker", "appearance", "medium.sfm", "medium.sfm_linear", "scale", "water"),
        *("input.rectified", "input.rows_rectified"),
    ),
    "splat": ("splat", "medium.splat"),
    "eval": ("test", "restored", "truth"),
}
_OTHERS = "other_protocols"  # scores by other protocols than the run's own, by their names
_FILES = ("settings.yaml", "versions.json", "log.jsonl", "summary.json", "report.html")
_CONTENTS = {  # what a stage leaves, and what later commands make of it
    "prepare": ("prepare",),
    "sfm": ("sfm", "georeference.json", "scale.json"),
    "splat": ("splat", "renders", "localization"),
    "eval": ("renders/test", "renders/protocols", "renders/flythrough.mp4"),
}
_MADE_FROM = {"sfm": ("splat", "eval"), "splat": ("eval",)}  # prepared frames are the same every time
_TITLES = {
    "prepare": "frames",
    "sfm": "structure from motion, depth and water",
    "splat": "map",
    "eval": "scores, flight and report",
}
_TELLING_S = 20.0  # shorter stages say little about the speed of this computer
_MOST_OFF = 4.0  # factor; one slow stage is not taken for all
_SPARE_BYTES = 64 << 20  # below this a stage is not begun: COLMAP's database does not survive a full disk
_SPARE_MB = 500.0  # of memory; with less, OpenBLAS ends the process, which nothing in it can catch


@contextmanager
def open_record(folder: Path, source: Path, fingerprint: str, *, redo: bool = False) -> "Iterator[RunRecord]":
    """Make or open a run folder of an input and hold it; litter of killed processes is removed.

    A new folder goes again where the input is refused. Raises UsageError where `folder` cannot be written to or
    another process is at work there, InputError where it holds something else or a run of another input.
    """
    with ExitStack() as held:
        held.enter_context(output_folder(folder))
        check_vacant(folder)
        held.enter_context(folder_lock(folder))
        for name in _FILES:
            check_file(folder / name)
        remove_drafts(folder)
        finish_rescale(folder)
        is_new = not is_run(folder)
        try:
            yield RunRecord(folder, source, fingerprint, redo)
        except Swimm3rError:
            if is_new and not (folder / MARKERS["prepare"]).exists():
                for name in _FILES:  # there is nothing in them that a corrected input could go on from
                    (folder / name).unlink(missing_ok=True)
            raise


class RunRecord:
    """summary.json and log.jsonl of a run folder, kept current on disk."""

    def __init__(self, folder: Path, source: Path, fingerprint: str, redo: bool = False) -> None:
        self.folder = folder
        self._count = 0  # of the stages to come, where it is known
        self._plan: Estimate | None = None
        self._pace = 1.0  # seconds that a second of the estimate took so far
        self._on_stage: Callable[[StageStart], None] = ignore_stages
        self._redo = redo
        before = self._found(fingerprint)
        sections = {"stages": {}} if before is None else before.sections
        given = {"path": str(source.resolve()), "fingerprint": fingerprint}
        self.summary: dict[str, Any] = {"schema": SCHEMA, **sections, "input": {**sections.get("input", {}), **given}}
        self._log("opened", process=os.getpid(), input=str(source))

    def settle(
        self, settings: RunSettings | None, reference: Path | None, last_stage: str
    ) -> tuple[RunSettings, Path | None]:
        """Decide what the run goes by: given settings, else those the folder holds, else the defaults.

        Settings of stages after the last one are the folder's own, where it has any; so is a reference not given.
        """
        self._count = STAGES.index(last_stage) + 1
        held = self._held(settings is None)
        chosen = settings or held or RunSettings()
        if held is not None:
            chosen = with_stages_of(chosen, held, STAGES[self._count :])
        scored = self._stage("eval")
        if reference is None and scored is not None and scored.reference:
            reference = Path(scored.reference)
        return chosen, reference

    @property
    def fingerprint(self) -> str:
        """Digest of the input's files."""
        return self.summary["input"]["fingerprint"]

    def to_do(self, keys: dict[str, StageKey]) -> list[str]:
        """The stages up to the last one that are not done with these keys."""
        return [name for name in STAGES[: self._count] if not self.is_done(name, keys[name])]

    def is_done(self, name: str, key: StageKey) -> bool:
        """Return whether a stage is done with this key and still there."""
        before = self._stage(name)
        return before is not None and before.status == "done" and key.is_of(before) and self._is_there(name)

    def announce(self, plan: Estimate | None, on_stage: Callable[[StageStart], None] = ignore_stages) -> None:
        """Log the estimate of the work to come and tell `on_stage` of its stages.

        Raises StorageError where the disk is far too small for it.
        """
        self._plan, self._on_stage = plan, on_stage
        if plan is None or not plan.seconds:
            return
        log.info("%s (%s free). A busy computer takes longer.", plan, size(shutil.disk_usage(self.folder).free))
        if warning := check_disk(plan, self.folder):
            log.warning("%s", warning)

    def superseded(self, settings: RunSettings, reference: Path | None) -> tuple[str, ...]:
        """The stages in the folder that were made with other settings than these, and those made from them.

        Raises UsageError where there are some and the record was not opened with `redo`.
        """
        keys = stage_keys(self.fingerprint, settings, reference)
        made = {name: record for name in STAGES if (record := self._stage(name)) is not None}
        changed = [name for name, record in made.items() if not keys[name].is_of(record)]
        if not changed:
            self._complete(made, keys)
            return ()
        held = self._held(False)
        listed = [] if held is None else differences(held, settings, list(made))
        scored = made.get("eval")
        if scored is not None and scored.reference != _text(reference):
            listed.append(f"reference: {scored.reference} -> {reference}")
        paths = {name: path for files in files_by_stage(settings, reference).values() for name, path in files.items()}
        named = dict.fromkeys(name for stage, record in made.items() for name in keys[stage].changed_files(record))
        edited = [name for name in named if not any(line.startswith(f"{name}: ") for line in listed)]
        if held is not None and not listed and not edited:
            # the settings are the same: another version of the program names or hashes them in another way
            log.warning("%s was made by another version; its finished stages are kept", self.folder)
            self._complete(made, keys)
            return ()
        found = STAGES[STAGES.index(changed[0]) :]
        if not self._redo:
            stages = [name for name in made if name in found]
            raise _superseded(self.folder, stages, listed, [f"{name}: {paths[name]}" for name in edited])
        return found

    def _complete(self, made: dict[str, StageRecord], keys: dict[str, StageKey]) -> None:
        """Give stages the keys of this version, with digests of the files that earlier ones did not record."""
        for name, record in made.items():
            self.summary["stages"][name] |= keys[name].entry(record)

    def set_aside(self, stages: Sequence[str]) -> None:
        """Move what these stages made to old/."""
        if not stages:
            return
        target = _set_aside(self.folder, stages)
        self._log("moved", stages=list(stages), to=str(target.relative_to(self.folder)))
        for stage in stages:
            self._forget(stage)
        if "sfm" in stages:  # prepared frames say all of this anew
            self.summary.pop("warnings", None)
            self.summary["input"] = {name: self.summary["input"][name] for name in ("path", "fingerprint")}
        self.write()

    def describe(self, stage: str, found: dict[str, object]) -> None:
        """The sections of a stage, in the place of those of before; entries that other stages made of one stay."""
        self._drop_sections(stage)
        for name, section in found.items():
            before = self.summary.get(name)
            if isinstance(before, dict) and isinstance(section, dict):
                section = {**before, **section}
            self.summary[name] = section

    def add_protocol(self, name: str, scores: dict[str, object]) -> None:
        """Scores by another protocol than the run's own."""
        self.summary[_OTHERS] = {**self.summary.get(_OTHERS, {}), name: scores}
        self._log("scored", protocol=name)

    def reread(self) -> None:
        """Take over summary.json as another part of the program left it on disk."""
        self.summary = read_run(self.folder).sections

    def _forget(self, stage: str) -> None:
        """Take a stage out of the summary, with all that it tells of its result and what was made of it."""
        self.summary["stages"].pop(stage, None)
        self._drop_sections(stage)
        self.summary.pop(_OTHERS, None)

    def _drop_sections(self, stage: str) -> None:
        for name, _, entry in (path.partition(".") for path in _SECTIONS[stage]):
            if not entry:
                self.summary.pop(name, None)
            elif name in self.summary:
                self.summary[name] = {key: value for key, value in self.summary[name].items() if key != entry}
                if not self.summary[name]:
                    del self.summary[name]

    def stage(
        self,
        name: str,
        key: StageKey,
        make: Callable[[], Result],
        reuse: Callable[[], Result] | None = None,
        **facts: Any,
    ) -> Result:
        """Do a stage, or reuse it where it is done with the same key and is still there; `facts` go to its record.

        Stages made from one that is made again are to be made again, even where this run is killed in between.
        """
        self._begin(name)
        if reuse and self.is_done(name, key):
            self._log("reused", stage=name)
            return reuse()
        self._check_space()
        self._check_memory(name)
        entry = key.entry(self._stage(name))
        for later in _MADE_FROM.get(name, ()):  # their keys tell settings, not what is made now
            self._forget(later)
        self._drop_sections(name)
        self.summary["stages"][name] = {"status": "running", **entry, **facts}
        self.write()
        self._log("started", stage=name)
        wall, cpu = time.perf_counter(), _cpu_seconds()
        try:
            result = make()
        except BaseException as error:
            self._check_space(error)  # before the log, which a full disk would not take either
            self._log("stopped", stage=name, error=f"{type(error).__name__}: {error}")
            raise
        self._measure_pace(name, time.perf_counter() - wall)
        return_freed()
        peak = peak_mb()
        self.summary["stages"][name] = {
            "seconds": round(time.perf_counter() - wall, 2),
            "cpu_seconds": round(_cpu_seconds() - cpu, 2),
            "peak_mb": None if peak is None else round(peak),
            "status": "done",
            **entry,
            **facts,
        }
        self.write()
        self._log("done", stage=name, **self.summary["stages"][name])
        return result

    def _begin(self, name: str) -> None:
        if not self._count:
            return
        left = None if self._plan is None else self._plan.seconds_from(name)
        start = StageStart(
            STAGES.index(name) + 1, self._count, _TITLES[name], None if left is None else left * self._pace
        )
        told = "" if not start.seconds_left else f" (about {duration(start.seconds_left)} left in all)"
        log.info("Stage %d of %d: %s%s", start.number, start.count, start.title, told)
        self._on_stage(start)

    def _measure_pace(self, name: str, seconds: float) -> None:
        """Learn from a stage how far the estimate is off."""
        expected = None if self._plan is None else self._plan.seconds.get(name)
        if expected and seconds > _TELLING_S:
            self._pace = min(max(seconds / expected, 1 / _MOST_OFF), _MOST_OFF)

    def write(self) -> dict:
        """Bring summary.json up to date and return it."""
        self.summary.pop("products", None)
        self.summary |= summary_section(self.folder)
        write_text(self.folder / "summary.json", json.dumps(self.summary, indent=2) + "\n")
        return self.summary

    def _found(self, fingerprint: str) -> RunFolder | None:
        """The run that the folder holds; None of a new one."""
        if not is_run(self.folder):
            return None
        try:
            run = read_run(self.folder)
        except InputError:
            if not self._redo:
                raise
            _set_aside(self.folder, STAGES)
            return None
        if run.input.fingerprint != fingerprint:
            raise InputError(
                f"{self.folder} holds a run of another input ({run.input.path})",
                cause="the same --out was given for two inputs, or the input's files changed since",
                hint="another --out, or remove that folder",
            )
        return run

    def _held(self, needed: bool) -> RunSettings | None:
        """The settings in the folder; None where there are none, or none that can be read and none are needed."""
        path = self.folder / "settings.yaml"
        if not path.is_file():
            return None
        try:
            return from_yaml(path)
        except InputError:
            if needed:
                raise
            return None

    def _stage(self, name: str) -> StageRecord | None:
        found = self.summary["stages"].get(name)
        if found is None:
            return None
        return StageRecord(found["status"], found["key"], found.get("reference"), files=found.get("files", {}))

    def _is_there(self, name: str) -> bool:
        return (self.folder / MARKERS[name]).exists()

    def _check_space(self, error: BaseException | None = None) -> None:
        """Raise StorageError where too little space is left; `error` is what the lack of it may have caused."""
        free = shutil.disk_usage(self.folder).free
        if free < _SPARE_BYTES:
            raise StorageError(
                f"only {free / 1e6:.0f} MB are left on the disk of {self.folder}",
                cause="the disk is full or over quota",
                hint="free some space or choose another --out; the same command then goes on from here",
            ) from error

    def _check_memory(self, name: str) -> None:
        free = available_mb()
        if free is not None and free < _SPARE_MB:
            raise DeviceError(
                f"only {free:.0f} MB of memory are left, too little to begin the stage {name}",
                cause="other programs hold the computer's memory, or a limit is set (ulimit -v)",
                hint=f"leave this command {_SPARE_MB:.0f} MB and more; the same command then goes on from here",
            )

    def _log(self, event: str, **details: object) -> None:
        line = json.dumps({"time": time.strftime("%Y-%m-%dT%H:%M:%S%z"), "event": event, **details})
        with (self.folder / "log.jsonl").open("a", encoding="utf-8") as file:
            file.write(line + "\n")


def _set_aside(folder: Path, stages: Sequence[str]) -> Path:
    """Move what stages made, with copies of the files that describe it, to old/1, old/2, ..."""
    numbers = [int(path.name) for path in (folder / "old").glob("*") if path.name.isdecimal()]
    target = folder / "old" / str(max(numbers, default=0) + 1)
    target.mkdir(parents=True)
    for name in ("settings.yaml", "versions.json", "summary.json", "report.html"):
        if (folder / name).is_file():
            shutil.copy2(folder / name, target / name)
    for place in (place for stage in stages for place in _CONTENTS[stage]):
        if (folder / place).exists():
            (target / place).parent.mkdir(parents=True, exist_ok=True)
            (folder / place).rename(target / place)
    log.info("moved what was made before to %s", target)
    return target


def _cpu_seconds() -> float:
    """Processor time of this process and of its child processes that have ended."""
    return sum(os.times()[:4])


def _text(path: Path | None) -> str | None:
    return None if path is None else str(path)


def _superseded(folder: Path, stages: list[str], listed: list[str], edited: list[str]) -> UsageError:
    if edited and not listed:
        return UsageError(
            f"{folder} holds stages made from files that have changed since ({', '.join(stages)}):"
            + "".join(f"\n    {line}" for line in edited),
            cause="a file or folder that the settings name was edited or made again",
            hint=f"--redo moves these stages to {folder / 'old'} and makes them again; or the files as they were; or"
            " another --out",
        )
    listed = [*listed, *(f"{line} has changed" for line in edited)]
    shown = "".join(f"\n    {line}" for line in listed) or " (settings.yaml, which names them, cannot be read)"
    if listed and all(line.startswith("scale.") for line in listed):
        return UsageError(
            f"{folder} was mapped with another navigation, or none:{shown}",
            cause="navigation is used in mapping, too",
            hint=f"swimm3r scale {folder} with these options gives it unit and place as it is mapped; --redo moves"
            f" what was made to {folder / 'old'} and maps again",
        )
    return UsageError(
        f"{folder} holds stages made with other settings ({', '.join(stages)}):{shown}",
        cause="options or the preset are others than those the folder was made with",
        hint=f"swimm3r run {folder} goes on with the folder's own; --redo moves these stages to {folder / 'old'} and"
        " makes them again; or another --out",
    )
