"""The pipeline over a run folder: prepare -> sfm -> splat -> eval, each stage resumable, its record in summary.json.

A stage is reused when its settings and everything before it are unchanged (a hash, the stage's `key`); one that was cut
short goes on from what it left on disk; one whose settings changed is refused or moved away, never removed
(`run_record`).
"""

import json
import logging
import platform
from collections.abc import Callable
from dataclasses import asdict, dataclass, replace
from functools import partial
from importlib.metadata import version
from pathlib import Path

from swimm3r import devices
from swimm3r.io.files.atomic import write_text
from swimm3r.pipeline import held_out
from swimm3r.pipeline import summary as sections
from swimm3r.pipeline.estimate import estimate_run
from swimm3r.pipeline.inputs import check_inputs, input_fingerprint, truth_of
from swimm3r.pipeline.presets import RunSettings, from_yaml, to_yaml
from swimm3r.pipeline.run_record import RunRecord, open_record, stage_keys
from swimm3r.pipeline.run_settings import navigation_of_mapping
from swimm3r.pipeline.scoring import MappedRun, Protocol, film_flight, score_map, score_restored_frames, start_poses
from swimm3r.pipeline.stage_start import StageStart, ignore_stages
from swimm3r.prepare import load_frames, read_frames
from swimm3r.progress import Progress, silent, watched
from swimm3r.report import write_report
from swimm3r.scale.navigation.navigator import NavigationFile
from swimm3r.scale.rig import has_known_baseline
from swimm3r.scale.run import is_scaled, scale_folder, scale_sections
from swimm3r.scene.frames import Frames
from swimm3r.scene.ground_truth import GroundTruth
from swimm3r.scene.placement import Navigator
from swimm3r.scene.reconstruction import Reconstruction
from swimm3r.scene.reconstruction_io import load_reconstruction, unfiltered_matches
from swimm3r.scene.run_folder import open_run
from swimm3r.sfm import reconstruct
from swimm3r.sfm.between import read_between
from swimm3r.sfm.lens import known_lens
from swimm3r.sfm.rectified.frames import RectifiableError
from swimm3r.sfm.rectified.run import (
    given_rectification,
    has_rectified_rows,
    is_rectified,
    rectified_truth,
    rectify_run,
    run_frames,
    write_masks_as_filmed,
)
from swimm3r.splat import train
from swimm3r.splat.map_file import load_map
from swimm3r.splat.settings import MapDevice
from swimm3r.splat.training.observer import Observer
from swimm3r.tasks.settings import EngineSettings

log = logging.getLogger(__name__)


def run_pipeline(
    source: str | Path,
    folder: str | Path,
    settings: RunSettings | None = None,
    *,
    redo: bool = False,
    reference: Path | None = None,
    last_stage: str = "eval",
    map_device: MapDevice = "auto",
    progress: Progress | None = None,
    on_stage: Callable[[StageStart], None] = ignore_stages,
    observer: Observer | None = None,
    engine: EngineSettings = EngineSettings(),  # noqa: B008 - records are frozen
) -> dict:
    """Run the stages up to `last_stage` and return the summary (layout: docs/conventions.md).

    `settings` are a preset's (`swimm3r.PRESETS["fast"]`), or changed from one. Without them the run goes by those that
    the folder holds, a new one by the defaults. Stages made with other settings are refused, or with `redo` moved to
    `folder`/old and made again. `reference` is a cameras.json to score against; a synthetic dive brings its own truth.
    An input may be gone once its frames are prepared, as where the folder was copied to another computer.
    `map_device` is where the map is trained and rendered. A rough estimate of time and disk is logged first, and
    `on_stage` is told of every stage that starts, `observer` of every step of the map's training. A terminal or a
    notebook shows how far it is, unless `progress` is given (`swimm3r.silent`: nothing). `engine` can spread chunks of
    a long clip, dense depth and blocks of a large map over processes or a cluster.

    Raises the errors of its stages (`swimm3r.errors`), UsageError where settings differ, the folder cannot be written
    to or another process works in it, InputError where it belongs to another input, and StorageError where the disk is
    far too small.
    """
    source, folder = Path(source), Path(folder)
    digest = input_fingerprint(source, folder)
    device = devices.for_maps(map_device)  # before there is a folder, and minutes of structure from motion
    with watched(progress) as told, open_record(folder, source, digest, redo=redo) as record:
        settings, reference = record.settle(settings, reference, last_stage)
        superseded = record.superseded(settings, reference)
        keys = stage_keys(record.fingerprint, settings, reference)
        to_do = record.to_do(keys)
        has_sfm = last_stage != "prepare" and "sfm" not in to_do
        scaled = has_sfm and is_scaled(folder, keys["sfm"], settings.scale)
        check_inputs(source, settings, reference, to_do, scaled=scaled)
        record.set_aside(superseded)
        record.write()
        write_text(folder / "settings.yaml", to_yaml(settings))
        write_text(folder / "versions.json", json.dumps(_versions(), indent=2) + "\n")
        plan = estimate_run(source, folder, settings, to_do, on_cpu=device.type == "cpu")
        record.announce(plan, on_stage)
        _make_stages(record, source, settings, reference, last_stage, map_device, told, observer, engine)
        summary = record.write()
        if last_stage == "eval":
            write_report(folder)
        return summary


def _make_stages(
    record: RunRecord,
    source: Path,
    settings: RunSettings,
    reference: Path | None,
    last_stage: str,
    map_device: MapDevice,
    progress: Progress,
    observer: Observer | None,
    engine: EngineSettings,
) -> None:
    """Make or reuse the stages one after another. Results of a stage are read from disk, to the last bit as a resumed
    run finds it.
    """
    folder = record.folder
    keys = stage_keys(record.fingerprint, settings, reference)
    truth = truth_of(source, reference)
    frames = record.stage(
        "prepare",
        keys["prepare"],
        make=lambda: read_frames(
            source, settings.frames, folder / "prepare", progress, partial(known_lens, settings.sfm)
        ),
        reuse=lambda: load_frames(folder / "prepare"),
    )
    record.summary["input"] |= sections.frames_section(frames)
    record.add({"warnings": [{"what": what, "advice": ""} for what in frames.warnings]})
    if last_stage == "prepare":
        return

    navigation = navigation_of_mapping(settings)
    navigator = None if navigation is None else NavigationFile(navigation)
    record.stage(
        "sfm",
        keys["sfm"],
        make=lambda: _reconstruct(frames, settings, folder, progress, engine, navigator),
        reuse=lambda: None,
    )
    frames, truth = run_frames(folder), rectified_truth(folder, truth)
    record.summary["input"] |= {
        "width": frames.width,
        "height": frames.height,
        "rectified": is_rectified(folder),
        "rows_rectified": has_rectified_rows(folder),
    }
    rec = load_reconstruction(folder / "sfm", frames)
    between = read_between(folder / "sfm")
    placed = 0 if between is None else len(between.names)
    record.add(sections.sfm_sections(rec, frames, unfiltered_matches(folder / "sfm", rec), placed))
    if _scaled(record, rec, settings, progress):
        rec = load_reconstruction(folder / "sfm", frames)
        record.add(sections.sfm_sections(rec, frames, unfiltered_matches(folder / "sfm", rec), placed))
    record.add(scale_sections(folder, rec))
    if last_stage == "sfm":
        return

    record.stage(
        "splat",
        keys["splat"],
        make=lambda: train(rec, frames, settings.splat, folder / "splat", progress, map_device, observer, engine),
        reuse=lambda: None,
    )
    scene = load_map(folder / "splat" / "map.safetensors").to(devices.for_maps(map_device))
    record.add(sections.splat_sections(scene, rec, frames, folder / "splat"))
    if last_stage == "splat":
        return

    run = MappedRun(folder, frames, rec, scene, settings)
    _own_scores(record, run, Protocol(settings.test, reference), truth, progress, reuse=True)


def _reconstruct(
    prepared: Frames,
    settings: RunSettings,
    folder: Path,
    progress: Progress,
    engine: EngineSettings,
    navigator: Navigator | None,
) -> None:
    """Structure from motion of a run, of rectified frames where no lens model explains the prepared ones, or the camera
    turned while their rows were exposed.
    """
    if not is_rectified(folder) and not has_rectified_rows(folder):
        rectification = given_rectification(settings.sfm, prepared)
        if rectification is not None:
            rectify_run(folder, rectification, progress)
    while True:  # once as filmed, and once after each of the two rectifications
        try:
            reconstruct(run_frames(folder), settings.sfm, folder / "sfm", progress, engine, navigator)
            break
        except RectifiableError as error:
            log.info("%s: frames are rectified, and everything from here on works on the rectified ones", error.what)
            rectify_run(folder, error.rectification, progress)
    if is_rectified(folder) or has_rectified_rows(folder):
        write_masks_as_filmed(prepared, folder)


def _scaled(record: RunRecord, rec: Reconstruction, settings: RunSettings, progress: Progress) -> bool:
    """Give the run the unit and the place that its settings or its rig tell; return whether anything was to be done."""
    if not settings.scale.has_sources and not has_known_baseline(rec):
        return False
    record.write()
    run = open_run(record.folder, "sfm")
    if is_scaled(record.folder, run.stages["sfm"].key, settings.scale):
        return False
    scale_folder(record.folder, run, settings.scale, progress)
    return True


@dataclass(frozen=True)
class FinishedSfm:
    """A run folder as its map's training finds it."""

    frames: Frames
    rec: Reconstruction
    settings: RunSettings
    truth: GroundTruth | None
    key: str  # another one where anything before the map is another

    def first_poses(self, progress: Progress = silent) -> dict[str, held_out.FirstPose]:
        """Poses from which the refinement of the test frames starts, in the reconstruction's axes."""
        return start_poses(self.rec, self.frames, self.settings, self.truth, progress)


def open_finished_sfm(folder: Path, reference: Path | None = None) -> FinishedSfm:
    """Read a run folder up to its map. Raises InputError where structure from motion is not finished."""
    run = open_run(folder, "sfm")
    frames = run_frames(folder)
    return FinishedSfm(
        frames,
        load_reconstruction(folder / "sfm", frames),
        from_yaml(folder / "settings.yaml"),
        rectified_truth(folder, truth_of(Path(run.input.path), reference)),
        run.stages["sfm"].key,
    )


def evaluate_run(
    folder: Path,
    *,
    steps: int | None = None,
    reference: Path | None = None,
    map_device: MapDevice = "auto",
    progress: Progress | None = None,
) -> dict:
    """Score a finished run again, its test frames' poses found anew, and return the summary.

    With other `steps` of pose refinement or another `reference` than the run's own, the scores stand beside its own, in
    "other_protocols", and the views in RUN/renders/protocols. Raises InputError where the run has no map yet.
    """
    before = open_run(folder, "splat")
    settings, source = from_yaml(folder / "settings.yaml"), Path(before.input.path)
    scored = before.stages.get("eval")
    own = Protocol(settings.test, None if scored is None or scored.reference is None else Path(scored.reference))
    asked = Protocol(
        settings.test if steps is None else replace(settings.test, steps=steps), reference or own.reference
    )
    with watched(progress) as told, open_record(folder, source, before.input.fingerprint) as record:
        record.summary |= before.sections
        scene = load_map(folder / "splat" / "map.safetensors").to(devices.for_maps(map_device))
        frames = run_frames(folder)
        run = MappedRun(folder, frames, load_reconstruction(folder / "sfm", frames), scene, settings)
        truth = rectified_truth(folder, truth_of(source, asked.reference))
        if beside := asked.key_beside(own):
            record.add_protocol(beside, _other_scores(run, asked, truth, f"renders/protocols/{beside}", told))
        else:
            _own_scores(record, run, asked, truth, told)
        summary = record.write()
        write_report(folder)
        return summary


def _own_scores(
    record: RunRecord,
    run: MappedRun,
    own: Protocol,
    truth: GroundTruth | None,
    progress: Progress,
    *,
    reuse: bool = False,
) -> None:
    """The last stage, by the run's own protocol; scores of before are reused or replaced whole."""

    def make() -> None:
        scores = score_map(run, own.test, truth, run.folder / "renders" / "test", progress)
        film_flight(run, progress)
        restored = {"sfm": score_restored_frames(run, progress), **(scores["restored"] or {})}
        record.summary |= {**scores, "restored": restored}

    reference = None if own.reference is None else str(own.reference)
    key = stage_keys(record.fingerprint, run.settings, own.reference)["eval"]
    record.stage("eval", key, make, record.keep_scores if reuse else None, reference=reference)


def _other_scores(
    run: MappedRun, asked: Protocol, truth: GroundTruth | None, views: str, progress: Progress
) -> dict[str, object]:
    """An entry of the section "other_protocols"."""
    return {
        "settings": asdict(asked.test),
        "reference": None if asked.reference is None else str(asked.reference),
        "views": views,
        **score_map(run, asked.test, truth, run.folder / views, progress),
    }


def _versions() -> dict[str, str]:
    packages = ("swimm3r", "torch", "numpy", "scipy", "numba", "pycolmap", "opencv-python-headless", "av")
    return {"python": platform.python_version(), "platform": platform.platform()} | {p: version(p) for p in packages}
