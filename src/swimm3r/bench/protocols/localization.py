"""Localization of held-out frames (the paper's localization table), by map and by structure from motion.

Every test frame of a run is a query. Its pose is judged against the structure from motion of all frames, training and
test, by relative poses: of test frame and training frame, where the map's training frames anchor the answer, and of two
test frames, of which short clips have few. The pairs of two training frames say how far the map's own poses agree with
the reference: nothing placed in the map can agree better. Maps are the runs' own, and those that `bench render` left.
Each map is measured in a process of its own, so that neither memory nor time depends on the maps before it.
"""

import json
from collections.abc import Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from swimm3r import devices
from swimm3r.bench import reference
from swimm3r.bench.cells import Result, ResultKey, Scores, kept_cell, over_scenes, scene_folder
from swimm3r.bench.inputs import reconstruction_of, weights_digest
from swimm3r.bench.memory import in_own_process, with_peak_mb
from swimm3r.bench.runs import POSES_REFINED, Clip, SfmRun, clips_of
from swimm3r.bench.scores import columns
from swimm3r.bench.tables import Table
from swimm3r.errors import InputError, WeightsError
from swimm3r.evaluate import NotComputed
from swimm3r.evaluate.poses import RelativePoseErrors, relative_pose_errors, rra, rta
from swimm3r.geometry import best_similarity, rotation_angle
from swimm3r.io.files.cache_key import content_digest
from swimm3r.localization.batch import Answer, Query, answer, with_match_image
from swimm3r.localization.localizer import STAGES, Localizer
from swimm3r.localization.matchers import chosen_matcher
from swimm3r.localization.settings import GS_CPR, LocalizationSettings, with_checkpoint_of
from swimm3r.pipeline.finished_sfm import FinishedSfm
from swimm3r.progress import Progress, silent
from swimm3r.scene.ground_truth import GroundTruth
from swimm3r.scene.reconstruction import Reconstruction
from swimm3r.splat.map_file import load_map
from swimm3r.tasks.settings import EngineSettings

_PAIRS = [f"{score}_{pairs}" for pairs in ("map", "queries") for score in ("rra2", "rta5", "rra15", "rta15")]
_PAIRS += ["rra2_training", "rta5_training"]
COLUMNS = columns(
    "located_pct", "inlier_5px_pct", "reprojection_px", *_PAIRS, "rotation_median_deg", "position_median_pct",
    *(f"fps_{stage}" for stage in STAGES), "fps_localize", "peak_mb", "peak_vram_mb",
)  # fmt: skip


@dataclass(frozen=True)
class FoundMap:
    """A map of a run, and under which name and seed it stands in the table."""

    path: Path
    method: str
    seed: int


def localize(
    runs: Sequence[Path],
    out: Path,
    settings: LocalizationSettings | None = None,
    maps: Path | None = None,
    references: Path | None = None,
    how: EngineSettings | None = None,
    progress: Progress = silent,
) -> Table:
    """Every test frame of every run in each of its maps; `maps` is a folder that `bench render` filled.

    `references` holds NAME.json (a cameras.json) of all frames of every clip, in the place of our own. Raises
    InputError where a run has no map, or holds no finished structure from motion, or a clip has no reference there.
    """
    clips = clips_of(runs)
    reference.required(references, [clip.name for clip in clips])
    for clip in clips:
        for run in clip.runs:
            maps_of(run, maps)
    work = partial(_cells_of_clip, out=out, settings=settings or GS_CPR, maps=maps, references=references)
    cells = over_scenes(clips, work, out, how or EngineSettings(), progress)
    return Table("localization", "Test frames placed in maps", cells, COLUMNS)


def maps_of(run: SfmRun, maps: Path | None) -> list[FoundMap]:
    """The run's own map and those of the same structure from motion below `maps`."""
    found = []
    own = run.folder / "splat" / "map.safetensors"
    if own.is_file() and maps is None:
        found.append(FoundMap(own, f"{run.sfm} / {load_map(own).settings.recipe}", 0))
    if maps is not None:
        for path in sorted(scene_folder(maps, run.scene).glob("*/*/*/map.safetensors")):
            record = path.parent / "scores.json"
            if not record.is_file():  # still in training
                continue
            method = json.loads(record.read_text(encoding="utf-8"))["method"]
            if method.split(" / ")[0].removesuffix(POSES_REFINED) == run.sfm:
                found.append(FoundMap(path, method, int(path.parent.name)))
    if not found:
        raise InputError(
            f"there is no map of {run.folder}" + (f" below {maps}" if maps else ""),
            cause="the run stopped after structure from motion, or the maps are of other runs",
            hint="swimm3r run INPUT --out RUN; or swimm3r bench render RUN --out DIR, then --maps DIR",
        )
    return found


def _cells_of_clip(
    clip: Clip,
    /,
    *,
    out: Path,
    settings: LocalizationSettings,
    maps: Path | None,
    references: Path | None,
    progress: Progress,
) -> list[Result]:
    truth = reference.given(references, clip.name)
    if truth is None:
        own = scene_folder((maps or out) / "references", clip.name)
        truth = reference.of_clip(clip.runs[0].open(), own, progress)
    cells = []
    keys = {run.folder: reconstruction_of(run.folder, run.open()) for run in clip.runs}
    work = [(run, found) for run in clip.runs for found in maps_of(run, maps)]
    for done, (run, found) in enumerate(work):
        progress("localizing in maps", done, len(work))
        chosen = with_checkpoint_of(settings, run.open().settings.sfm)
        made_from = [keys[run.folder], content_digest(found.path), chosen, _matcher(chosen)]
        scored_by = [reference.digest(truth), [c.score for c in COLUMNS]]
        place = ResultKey(clip.name, found.method, found.seed)
        scores = partial(_scores, run=run, path=found.path, truth=truth, settings=chosen)
        cells.append(kept_cell(out, place, made_from, partial(in_own_process, scores), scored_by))
    progress("localizing in maps", len(work), len(work))
    return cells


def _matcher(settings: LocalizationSettings) -> list[str | None]:
    """The matcher that is used here, with its weights."""
    try:
        chosen = chosen_matcher(settings)
    except WeightsError as unfit:  # the cell then says the same
        return [unfit.what]
    return [chosen, weights_digest("mast3r", settings.weights) if chosen == "mast3r" else None]


def _scores(
    folder: Path, *, run: SfmRun, path: Path, truth: GroundTruth | NotComputed, settings: LocalizationSettings
) -> Scores:
    sfm = run.open()
    scene = load_map(path).to(devices.for_maps())

    def work() -> tuple[Localizer, list[Answer]]:
        localizer = Localizer(scene, sfm.rec, sfm.rec.still(sfm.frames), settings)
        return localizer, _answers(localizer, sfm, folder)

    (localizer, answers), peaks = with_peak_mb(work)
    return {**localization_scores(answers), **pose_scores(localizer.rec, answers, truth), **peaks}


def _answers(localizer: Localizer, sfm: FinishedSfm, folder: Path) -> list[Answer]:
    """Every test frame placed; folder/matches/NAME.png shows what with."""
    queries = []
    for frame in sfm.frames.test:
        f = sfm.frames.index(frame.name)
        queries.append(Query(frame.name, frame.time, sfm.frames.image(f), sfm.frames.mask(f), frame.time, frame.name))
    for query in queries[:1]:
        answer(localizer, query)  # once more than needed: kernels are loaded, references described
    return [with_match_image(answer(localizer, query), folder) for query in queries]


def localization_scores(answers: Sequence[Answer]) -> dict[str, float | NotComputed]:
    """The scores that need no reference: localized frames, their evidence, and speed."""
    if not answers:
        speeds = [f"fps_{stage}" for stage in (*STAGES, "localize")]
        names = ["located_pct", "inlier_5px_pct", "reprojection_px", *speeds]
        return dict.fromkeys(names, NotComputed("the run has no test frames"))
    found = [a.found for a in answers if a.found is not None]
    nothing = NotComputed("no test frame was located")
    refined = [f.reprojection_px for f in found if f.reprojection_px is not None]
    scores: dict[str, float | NotComputed] = {
        "located_pct": 100 * len(found) / len(answers),
        "inlier_5px_pct": 100 * sum(f.inliers / max(1, f.matches) for f in found) / len(answers),
        "reprojection_px": float(torch.tensor(refined).quantile(0.5)) if refined else nothing,
    }
    for stage in STAGES:
        seconds = sum(f.seconds[stage] for f in found)
        scores[f"fps_{stage}"] = len(found) / seconds if seconds > 0 else nothing
    total = sum(sum(f.seconds.values()) for f in found)
    scores["fps_localize"] = len(found) / total if total > 0 else nothing
    return scores


def pose_scores(
    rec: Reconstruction, answers: Sequence[Answer], truth: GroundTruth | NotComputed
) -> dict[str, float | NotComputed]:
    """RRA and RTA of pairs, and the errors after alignment by the training frames, whose poses are `rec`'s."""
    names = [*_PAIRS, "rotation_median_deg", "position_median_pct"]
    if isinstance(truth, NotComputed):
        return dict.fromkeys(names, truth)
    rows = {name: row for row, name in enumerate(truth.names)}
    queries = [a for a in answers if a.name in rows]
    trained = [name for name in rec.names if name in rows]
    if not queries:
        return dict.fromkeys(names, NotComputed("the reference has no test frame"))
    identity = torch.eye(4, dtype=torch.float64)
    placed = [identity if a.found is None else a.found.cam2world.double() for a in queries]
    ours = rec.cameras.cam2world[[rec.index(name) for name in trained]].double()
    theirs = truth.cameras.cam2world[[rows[name] for name in (*(a.name for a in queries), *trained)]].double()
    found = torch.tensor([a.found is not None for a in queries] + [True] * len(trained))
    errors = relative_pose_errors(torch.cat([torch.stack(placed), ours]), theirs, found)
    is_query = torch.arange(len(found)) < len(queries)
    both = is_query[errors.pairs].sum(-1)
    scores: dict[str, float | NotComputed] = {}
    for kind, count in (("training", 0), ("map", 1), ("queries", 2)):
        chosen = _selected(errors, both == count)
        few = NotComputed("there is no such pair of frames in the reference")
        for threshold in (2, 15):
            scores[f"rra{threshold}_{kind}"] = rra(chosen, threshold) if len(chosen.pairs) else few
        for threshold in (5, 15):
            scores[f"rta{threshold}_{kind}"] = rta(chosen, threshold) if len(chosen.pairs) else few
    scores = {name: scores[name] for name in _PAIRS}
    return scores | _aligned_errors(torch.stack(placed)[found[: len(queries)]], ours, theirs, found, len(queries))


def _aligned_errors(
    placed: Float[Tensor, "q 4 4"],
    ours: Float[Tensor, "t 4 4"],
    theirs: Float[Tensor, "n 4 4"],
    found: Bool[Tensor, " n"],
    queries: int,
) -> dict[str, float | NotComputed]:
    """Median errors of the located frames, once the reference lies on the map by the training frames of both."""
    names = ("rotation_median_deg", "position_median_pct")
    to_ours = best_similarity(theirs[queries:], ours) if len(ours) else None
    if to_ours is None or not len(placed):
        why = "no test frame was located" if to_ours is not None else "the training frames do not align"
        return dict.fromkeys(names, NotComputed(why))
    true = to_ours.poses(theirs[:queries][found[:queries]])
    turned = torch.rad2deg(rotation_angle(true[:, :3, :3].mT @ placed[:, :3, :3]))
    moved = (true[:, :3, 3] - placed[:, :3, 3]).norm(dim=-1)
    centers = ours[:, :3, 3]
    spread = (centers - centers.mean(0)).norm(dim=-1).square().mean().sqrt()
    return {names[0]: turned.quantile(0.5).item(), names[1]: 100 * (moved.quantile(0.5) / spread).item()}


def _selected(errors: RelativePoseErrors, rows: Bool[Tensor, " pairs"]) -> RelativePoseErrors:
    return RelativePoseErrors(**{name: values[rows] for name, values in vars(errors).items()})
