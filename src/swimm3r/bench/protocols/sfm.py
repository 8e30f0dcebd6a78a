"""Structure from motion by every method on the same frames (the paper's Tab. sfm_metrics), and the clouds side by side.

A method that succeeds leaves a run folder OUT/SCENE/METHOD/0/run for `bench render`, `localization` and `restoration`.
"""

import shutil
from collections.abc import Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path

from swimm3r.bench import reference
from swimm3r.bench.cells import Result, ResultKey, Scores, check_choice, kept_cell, over_scenes
from swimm3r.bench.images import Panel, write_grid
from swimm3r.bench.inputs import files_of
from swimm3r.bench.runs import clip_name, clip_names, original_pixels
from swimm3r.bench.scores import columns
from swimm3r.bench.settings import SfmMethods
from swimm3r.bench.sfm_methods import Uncapped, model_scores, reference_scores, settings_for
from swimm3r.bench.tables import Table
from swimm3r.errors import RegistrationError
from swimm3r.evaluate import NotComputed
from swimm3r.geometry import Similarity, best_similarity
from swimm3r.io.files.cache_key import sample_digest
from swimm3r.pipeline.inputs import truth_of
from swimm3r.pipeline.presets import RunSettings
from swimm3r.pipeline.run import run_pipeline
from swimm3r.prepare import check_source
from swimm3r.progress import Progress, silent
from swimm3r.report.plan_view import plan_view
from swimm3r.scene.ground_truth import GroundTruth
from swimm3r.scene.reconstruction import Reconstruction
from swimm3r.scene.reconstruction_io import load_reconstruction
from swimm3r.sfm.rectified.run import run_frames, run_truth
from swimm3r.sfm.settings import ColmapSettings, Mast3rSettings
from swimm3r.tasks.settings import EngineSettings

COLUMNS = columns(
    "registered_pct", "epipolar_mean_px", "inlier_1px_pct", "points", "dense_points", "rra15", "rta15", "maa30",
    "reference_pct", "sfm_cpu_seconds",
)  # fmt: skip


def compare_sfm(
    clips: Sequence[Path],
    out: Path,
    given: SfmMethods,
    settings: RunSettings,
    mast3r: Mast3rSettings,
    references: Path | None = None,
    how: EngineSettings | None = None,
    progress: Progress = silent,
) -> Table:
    """Every method on every clip; `settings` say how frames are taken and how COLMAP works.

    Poses are judged where a reference is known: a synthetic dive brings its own, `references` holds NAME.json (a
    cameras.json) of others. Raises InputError where a clip cannot be read or two have one name, and UsageError for no
    method.
    """
    check_choice("methods", given.methods)
    reference.given(references, "")
    clip_names(clips)
    for clip in clips:
        check_source(clip)
    work = partial(_cells_of_clip, out=out, given=given, settings=settings, mast3r=mast3r, references=references)
    cells = over_scenes(clips, work, out, how or EngineSettings(), progress)
    return Table("sfm", "Structure from motion by every method", cells, COLUMNS)


def _cells_of_clip(
    clip: Path,
    /,
    *,
    out: Path,
    given: SfmMethods,
    settings: RunSettings,
    mast3r: Mast3rSettings,
    references: Path | None,
    progress: Progress,
) -> list[Result]:
    scene = clip_name(clip)
    truth = reference.given(references, scene) or truth_of(clip, None)
    assert isinstance(settings.sfm, ColmapSettings)
    cells = []
    for method in given.methods:
        chosen = settings_for(method, scene, given, settings.sfm, mast3r)
        if isinstance(chosen, NotComputed):
            cells.append(Result(scene, method, 0, not_run=chosen.reason))
            continue
        made_from = [sample_digest(clip, leave_out=out), settings.frames, chosen, files_of(chosen)]
        scored_by = [None if truth is None else reference.digest(truth), [c.score for c in COLUMNS]]
        make = partial(_scores, clip=clip, settings=replace(settings, sfm=chosen), truth=truth, progress=progress)
        cells.append(kept_cell(out, ResultKey(scene, method), made_from, make, scored_by))
    _cloud_grid(out, scene, [cell.method for cell in cells if not cell.not_run])
    return cells


def _scores(
    folder: Path, *, clip: Path, settings: RunSettings, truth: GroundTruth | None, progress: Progress
) -> Scores:
    run, rec, uncapped = folder / "run", None, None
    try:
        summary = run_pipeline(clip, run, settings, redo=True, last_stage="sfm", progress=progress)
        rec = load_reconstruction(run / "sfm")
        seconds = summary["stages"]["sfm"]["cpu_seconds"]
    except RegistrationError as failure:  # no frame counts as registered, and the row says why
        seconds = NotComputed(failure.what)
    frames = run_frames(run)
    truth = run_truth(run, frames, truth)
    if rec is not None:
        uncapped = Uncapped.of(run / "sfm", rec, frames, settings.sfm.water.tracks, progress)
    scores = model_scores(rec, uncapped, len(frames.train), original_pixels(clip, frames))
    if truth is not None:
        scores |= reference_scores(rec, frames.train.names, truth)
    if rec is None:  # METHOD/0/run is for others to take
        shutil.rmtree(folder / "failed", ignore_errors=True)
        run.rename(folder / "failed")
    return {**scores, "sfm_cpu_seconds": seconds}


def _cloud_grid(out: Path, scene: str, methods: Sequence[str]) -> None:
    """OUT/images/SCENE.png: each method's cloud from above, as filmed and without the water, in one method's axes."""
    filmed, restored, first = [], [], None
    for method in methods:
        folder = ResultKey(scene, method).folder(out) / "run" / "sfm"
        if not (folder / "reconstruction.json").is_file():
            filmed.append(Panel(method, None))
            restored.append(Panel("without the water", None))
            continue
        rec = load_reconstruction(folder)
        first = first or rec
        raw, clear = _from_above(rec, first)
        filmed.append(Panel(method, raw))
        restored.append(Panel("without the water", clear))
    if first is not None:
        write_grid(out / "images" / f"{scene}.png", [filmed, restored])


def _from_above(rec: Reconstruction, first: Reconstruction) -> tuple:
    xyz, raw = rec.points.xyz, rec.points.rgb
    restored = raw
    if rec.cloud is not None:
        xyz, raw, restored = rec.cloud.xyz, rec.cloud.raw, rec.cloud.restored
    to_first = _between(rec, first)
    poses = rec.cameras.cam2world.double()
    if to_first is not None:
        xyz, poses = to_first.points(xyz.double()), to_first.poses(poses)
    view = plan_view(xyz.numpy(), raw.numpy(), restored.numpy(), poses.numpy())
    return view.raw, None if rec.cloud is None else view.restored


def _between(rec: Reconstruction, first: Reconstruction) -> Similarity | None:
    shared = [name for name in rec.names if name in first.names]
    ours, theirs = (r.cameras.cam2world[[r.index(name) for name in shared]].double() for r in (rec, first))
    return best_similarity(ours, theirs) if shared else None
