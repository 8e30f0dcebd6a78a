"""The pipeline over a run folder: prepare -> sfm -> splat -> eval, each stage resumable, its record in summary.json.

A stage is reused when its settings and everything before it are unchanged (a hash, the stage's `key`); one that was cut
short goes on from what it left on disk; one whose settings changed is made again from the start, with all after it.
"""

import json
import platform
import shutil
import sys
import time
from collections.abc import Callable
from dataclasses import asdict, dataclass, replace
from hashlib import sha256
from importlib.metadata import version
from pathlib import Path

from swimm3r import devices, held_out, reconstruction
from swimm3r import summary as sections
from swimm3r.errors import InputError, StorageError
from swimm3r.frames import Frames
from swimm3r.ground_truth import FOLDER as TRUTH_FOLDER
from swimm3r.ground_truth import GroundTruth, read_ground_truth
from swimm3r.io.atomic import write_text
from swimm3r.io.foreign.model import read_foreign
from swimm3r.prepare import check_source, load_frames, read_frames
from swimm3r.presets import RunSettings, from_yaml, to_yaml
from swimm3r.progress import Progress, silent
from swimm3r.reconstruction import Reconstruction
from swimm3r.renders import look_of, write_flythrough
from swimm3r.report import write_report
from swimm3r.sfm import reconstruct
from swimm3r.sfm.model_frames import model_cameras
from swimm3r.sfm.settings import ColmapModelSettings
from swimm3r.splat import train
from swimm3r.splat.checkpoint import load_map
from swimm3r.splat.pose_codes import as_mapped
from swimm3r.splat.rendering import SplatMap
from swimm3r.splat.settings import MapDevice

SCHEMA = 1
STAGES = ("prepare", "sfm", "splat", "eval")
_FOLDERS = {"prepare": "prepare", "sfm": "sfm", "splat": "splat", "eval": "renders"}
_SCORES = ("test", "restored", "truth")  # the sections that the last stage makes
_FLIGHT = 90  # pictures of the fly-through
_SPARE_BYTES = 64 << 20  # below this a stage is not begun: COLMAP's database does not survive a full disk


def run_pipeline(
    source: Path,
    folder: Path,
    settings: RunSettings | None = None,
    *,
    reference: Path | None = None,
    last_stage: str = "eval",
    map_device: MapDevice = "auto",
    progress: Progress = silent,
) -> dict:
    """Run the stages up to `last_stage` and return the summary (layout: docs/conventions.md).

    `reference` is a cameras.json to score against; a synthetic dive brings its own truth. `map_device` is where the map
    is trained and rendered. Raises the errors of its stages (`swimm3r.errors`) and InputError where `folder` belongs to
    another input.
    """
    settings = settings or RunSettings()
    check_source(source)
    devices.for_maps(map_device)  # before there is a folder, and minutes of structure from motion
    fingerprint = fingerprint_of(source, folder)
    is_new = not folder.exists()
    record = _Record(folder, source, fingerprint)
    write_text(folder / "settings.yaml", to_yaml(settings))
    write_text(folder / "versions.json", json.dumps(_versions(), indent=2) + "\n")
    truth = truth_of(source, reference)

    key = _key("prepare", fingerprint, asdict(settings.frames))
    try:
        frames = record.stage(
            "prepare",
            key,
            make=lambda: read_frames(source, settings.frames, folder / "prepare", progress),
            reuse=lambda: load_frames(folder / "prepare"),
        )
    except InputError:
        if is_new:
            shutil.rmtree(folder)  # there is nothing in it that a corrected input could go on from
        raise
    record.summary["input"] |= {
        "frames": len(frames),
        "train": len(frames.train),
        "test": len(frames.test),
        "width": frames.width,
        "height": frames.height,
    }
    if last_stage == "prepare":
        return record.close()

    key = _key("sfm", key, {type(settings.sfm).__name__: asdict(settings.sfm)})
    record.stage(
        "sfm", key, make=lambda: reconstruct(frames, settings.sfm, folder / "sfm", progress), reuse=lambda: None
    )
    # as it is on disk, to the last bit: an interrupted training must find the same poses again
    rec = reconstruction.load(folder / "sfm")
    record.add(sections.sfm_sections(rec, frames))
    if last_stage == "sfm":
        return record.close()

    key = _key("splat", key, asdict(settings.splat))
    scene = record.stage(
        "splat",
        key,
        make=lambda: train(rec, frames, settings.splat, folder / "splat", progress, map_device),
        reuse=lambda: load_map(folder / "splat" / "map.safetensors").to(devices.for_maps(map_device)),
    )
    record.add(sections.splat_sections(scene, rec, frames, folder / "splat"))
    if last_stage == "splat":
        return record.close()

    key = _key("eval", key, {"reference": str(reference), "test": asdict(settings.test)})
    record.stage(
        "eval",
        key,
        make=lambda: record.add(_scores(_Run(folder, frames, rec, scene), settings, truth, progress)),
        reuse=record.keep_scores,
    )
    summary = record.close()
    write_report(folder)
    return summary


@dataclass(frozen=True)
class FinishedSfm:
    """A run folder as its map's training finds it."""

    frames: Frames
    rec: Reconstruction
    settings: RunSettings
    truth: GroundTruth | None
    key: str  # another one where anything before the map is another

    def first_poses(self, progress: Progress = silent) -> dict[str, held_out.FirstPose]:
        """Where the test frames' refinement starts, in the reconstruction's axes."""
        reference = _reference(self.settings, self.frames, self.truth)
        return held_out.first_poses(self.rec, self.frames, self.settings.sfm.features, reference, progress)


def open_finished_sfm(folder: Path, reference: Path | None = None) -> FinishedSfm:
    """Read a run folder up to its map. Raises InputError where structure from motion is not finished."""
    path = folder / "summary.json"
    summary = json.loads(path.read_text(encoding="utf-8")) if path.is_file() else {}
    stage = summary.get("stages", {}).get("sfm", {})
    if stage.get("status") != "done":
        raise InputError(
            f"{folder} holds no finished structure from motion",
            cause="it is another folder, or the run was interrupted",
            hint="swimm3r sfm INPUT --out RUN, or swimm3r run",
        )
    return FinishedSfm(
        load_frames(folder / "prepare"),
        reconstruction.load(folder / "sfm"),
        from_yaml(folder / "settings.yaml"),
        truth_of(Path(summary["input"]["path"]), reference),
        stage["key"],
    )


@dataclass(frozen=True)
class _Run:
    """What a finished run holds."""

    folder: Path
    frames: Frames
    rec: Reconstruction
    scene: SplatMap


def evaluate_run(
    folder: Path,
    *,
    steps: int | None = None,
    reference: Path | None = None,
    progress: Progress = silent,
) -> dict:
    """Score a finished run again, its test frames' poses found anew, and return the summary.

    `steps` of pose refinement take the place of the run's own. Raises InputError where the run has no map yet.
    """
    if not (folder / "splat" / "map.safetensors").is_file() or not (folder / "summary.json").is_file():
        raise InputError(
            f"{folder} holds no finished map",
            cause="it is another folder, or the run was interrupted, or stopped after structure from motion",
            hint="swimm3r run INPUT --out RUN, which goes on where it stopped",
        )
    settings = from_yaml(folder / "settings.yaml")
    if steps is not None:
        settings = replace(settings, test=replace(settings.test, steps=steps))
    before = json.loads((folder / "summary.json").read_text(encoding="utf-8"))
    source = Path(before["input"]["path"])
    record = _Record(folder, source, before["input"]["fingerprint"])
    record.summary |= {name: section for name, section in before.items() if name not in _SCORES}
    frames, rec = load_frames(folder / "prepare"), reconstruction.load(folder / "sfm")
    scene = load_map(folder / "splat" / "map.safetensors").to(devices.for_maps())
    run = _Run(folder, frames, rec, scene)
    truth = truth_of(source, reference)
    key = _key("eval", before["stages"]["splat"]["key"], {"reference": str(reference), "test": asdict(settings.test)})
    record.stage("eval", key, make=lambda: record.add(_scores(run, settings, truth, progress)))
    summary = record.close()
    write_report(folder)
    return summary


def _scores(run: _Run, settings: RunSettings, truth: GroundTruth | None, progress: Progress) -> dict[str, object]:
    folder, frames, rec, scene = run.folder, run.frames, run.rec, run.scene
    poses = FinishedSfm(frames, rec, settings, truth, "").first_poses(progress)
    poses = held_out.in_axes_of(scene, rec, poses)
    restore, into = settings.sfm.restore, folder / "renders" / "test"
    views = held_out.score_views(scene, rec, frames, poses, into, settings.test, restore, progress)
    canvas = held_out.cut(views[0].canvas, views[0].window)
    path = as_mapped(rec, scene.poses)
    times = [frames.frames[frames.index(name)].time for name in path.names]
    flight = folder / "renders" / "flythrough.mp4"
    look = look_of(scene, rec, restore)
    write_flythrough(flight, scene, canvas, path.cameras.cam2world, times, _FLIGHT, look, progress)
    return {
        "test": sections.test_section(views, settings.test),
        "restored": {
            "sfm": sections.restored_section(folder / "sfm" / "restored", rec.names, progress),
            "splat": sections.restored_section(into, [f"{view.name}_clear" for view in views], progress),
        },
        "truth": sections.truth_section(rec, frames, truth, scene, views, progress) if truth else None,
    }


def _reference(settings: RunSettings, frames: Frames, truth: GroundTruth | None) -> GroundTruth | None:
    """Poses of the test frames that somebody else knows."""
    if truth is None and isinstance(settings.sfm, ColmapModelSettings):
        names, cameras = model_cameras(frames, read_foreign(settings.sfm.model).model)
        return GroundTruth(names, cameras, metric=False)
    return truth


class _Record:
    """summary.json and log.jsonl of a run folder, kept current on disk."""

    def __init__(self, folder: Path, source: Path, fingerprint: str) -> None:
        self.folder = folder
        path = folder / "summary.json"
        self.summary: dict = {"schema": SCHEMA, "input": {}, "stages": {}}
        self._scores_before: dict = {}
        if path.is_file():
            before = json.loads(path.read_text(encoding="utf-8"))
            if before["input"]["fingerprint"] != fingerprint:
                raise InputError(
                    f"{folder} holds a run of another input ({before['input']['path']})",
                    cause="the same --out was given for two inputs, or the input's files changed since",
                    hint="another --out, or remove that folder",
                )
            self.summary["stages"] = before["stages"]
            self._scores_before = {name: before[name] for name in _SCORES if name in before}
        elif folder.exists() and any(folder.iterdir()):
            raise InputError(
                f"{folder} is not empty and is not a run folder",
                cause="--out names a folder with other things in it",
                hint="an --out that does not exist yet",
            )
        self.summary["input"] = {"path": str(source.resolve()), "fingerprint": fingerprint}
        self._write()

    def add(self, found: dict[str, object]) -> None:
        """Sections for the summary; what a section already holds of an earlier stage stays."""
        for name, section in found.items():
            before = self.summary.get(name)
            if isinstance(before, dict) and isinstance(section, dict):
                section = {**before, **section}
            self.summary[name] = section

    def keep_scores(self) -> None:
        """The sections of the last stage as the summary had them."""
        self.add(self._scores_before)

    def stage(self, name: str, key: str, make: Callable, reuse: Callable | None = None):
        """Do a stage, or reuse it where it is done with the same key."""
        before = self.summary["stages"].get(name, {})
        if before.get("key") == key and before.get("status") == "done" and reuse:
            self._log("reused", stage=name)
            return reuse()
        if before.get("key") not in (None, key):
            self._forget(name)
        self._check_space()
        self.summary["stages"][name] = {"status": "running", "key": key}
        self._write()
        self._log("started", stage=name)
        wall, cpu = time.perf_counter(), time.process_time()
        try:
            result = make()
        except BaseException as error:
            self._check_space(error)  # before the log, which a full disk would not take either
            self._log("stopped", stage=name, error=f"{type(error).__name__}: {error}")
            raise
        self.summary["stages"][name] = {
            "seconds": round(time.perf_counter() - wall, 2),
            "cpu_seconds": round(time.process_time() - cpu, 2),
            "peak_mb": _peak_mb(),
            "status": "done",
            "key": key,
        }
        self._write()
        self._log("done", stage=name, **self.summary["stages"][name])
        return result

    def _check_space(self, error: BaseException | None = None) -> None:
        """Raise StorageError where too little space is left; `error` is what the lack of it may have caused."""
        free = shutil.disk_usage(self.folder).free
        if free < _SPARE_BYTES:
            raise StorageError(
                f"only {free / 1e6:.0f} MB are left on the disk of {self.folder}",
                cause="the disk is full or over quota",
                hint="free some space or choose another --out; the same command then goes on from here",
            ) from error

    def close(self) -> dict:
        """Write the summary a last time."""
        self._write()
        return self.summary

    def _forget(self, name: str) -> None:
        """Drop a stage made with other settings, and everything that was made from it."""
        for later in STAGES[STAGES.index(name) :]:
            self.summary["stages"].pop(later, None)
            if _FOLDERS[later]:
                shutil.rmtree(self.folder / _FOLDERS[later], ignore_errors=True)

    def _write(self) -> None:
        write_text(self.folder / "summary.json", json.dumps(self.summary, indent=2) + "\n")

    def _log(self, event: str, **details: object) -> None:
        line = json.dumps({"time": time.strftime("%Y-%m-%dT%H:%M:%S%z"), "event": event, **details})
        with (self.folder / "log.jsonl").open("a", encoding="utf-8") as log:
            log.write(line + "\n")


def truth_of(source: Path, reference: Path | None) -> GroundTruth | None:
    """What is known for certain of a clip: the reference where one is given, else what a synthetic dive brings."""
    if reference is not None:
        return read_ground_truth(reference)
    beside = source / TRUTH_FOLDER
    return read_ground_truth(beside) if beside.is_dir() else None


def fingerprint_of(source: Path, folder: Path) -> str:
    """What tells one input from another: names, sizes and times of its files, not where it lies.

    A run folder inside the input is no part of it.
    """
    files = [source]
    if source.is_dir():
        files = sorted(p for p in source.rglob("*") if p.is_file() and not p.resolve().is_relative_to(folder.resolve()))
    digest = sha256()
    for path in files:
        stat = path.stat()
        digest.update(f"{path.relative_to(source.parent)}|{stat.st_size}|{stat.st_mtime_ns}\n".encode())
    return digest.hexdigest()[:16]


def _key(stage: str, before: str, settings: dict) -> str:
    text = json.dumps([stage, before, settings], sort_keys=True, default=str)  # paths are all that JSON does not know
    return sha256(text.encode()).hexdigest()[:16]


def _versions() -> dict[str, str]:
    packages = ("swimm3r", "torch", "numpy", "scipy", "numba", "pycolmap", "opencv-python-headless", "av")
    return {"python": platform.python_version(), "platform": platform.platform()} | {p: version(p) for p in packages}


def _peak_mb() -> int | None:
    """Peak memory of this process so far; None on Windows, which has no getrusage."""
    if sys.platform == "win32":
        return None
    import resource

    per_mb = 1024**2 if sys.platform == "darwin" else 1024
    return round(resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / per_mb)
