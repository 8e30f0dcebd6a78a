"""Scores of a map in the record of its run: its own, by the last stage, and those of other protocols beside them."""

from dataclasses import asdict, replace
from pathlib import Path

from swimm3r import devices
from swimm3r.pipeline.inputs import truth_of
from swimm3r.pipeline.presets import from_yaml
from swimm3r.pipeline.run_record import RunRecord, open_record
from swimm3r.pipeline.scores.scoring import MappedRun, Protocol, film_flight, score_map, score_restored_frames
from swimm3r.pipeline.stage_keys import stage_keys
from swimm3r.progress import Progress, watched
from swimm3r.report import write_report
from swimm3r.scene.ground_truth import GroundTruth
from swimm3r.scene.reconstruction_io import load_reconstruction
from swimm3r.scene.run_folder import open_run
from swimm3r.sfm.rectified.run import run_frames, run_truth
from swimm3r.splat.map_file import load_map
from swimm3r.splat.settings import MapDevice


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
    reference = None if reference is None else reference.resolve()
    settings, source = from_yaml(folder / "settings.yaml"), Path(before.input.path)
    scored = before.stages.get("eval")
    own = Protocol(settings.test, None if scored is None or scored.reference is None else Path(scored.reference))
    asked = Protocol(
        settings.test if steps is None else replace(settings.test, steps=steps), reference or own.reference
    )
    with watched(progress) as told, open_record(folder, source, before.input.fingerprint) as record:
        scene = load_map(folder / "splat" / "map.safetensors").to(devices.for_maps(map_device))
        frames = run_frames(folder)
        run = MappedRun(folder, frames, load_reconstruction(folder / "sfm", frames), scene, settings)
        truth = run_truth(folder, frames, truth_of(source, asked.reference))
        if beside := asked.key_beside(own):
            record.add_protocol(beside, _other_scores(run, asked, truth, f"renders/protocols/{beside}", told))
        else:
            own_scores(record, run, asked, truth, told)
        summary = record.write()
        write_report(folder)
        return summary


def own_scores(
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
        record.describe("eval", {**scores, "restored": restored})

    reference = None if own.reference is None else str(own.reference)
    key = stage_keys(record.fingerprint, run.settings, own.reference)["eval"]
    record.stage("eval", key, make, (lambda: None) if reuse else None, reference=reference)


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
