"""Held-out views: structure from motion x renderer (the paper's quantitative comparison).

Every recipe is trained on the same reconstruction and frames. A test frame's pose comes from the structure from motion
of all frames, brought into the reconstruction's axes by the similarity of the training cameras, and is then refined on
each frozen map from the same start: the paper's route, after 3R-GS, but that the cameras' orientations count, too.
Poses that somebody else found of all frames can take the place of our own structure from motion of them.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from itertools import product
from pathlib import Path

from swimm3r.bench import reference
from swimm3r.bench.cells import Result, ResultKey, Scores, check_choice, kept_cell, over_scenes, scene_folder
from swimm3r.bench.images import Panel, stored, write_grid
from swimm3r.bench.inputs import lpips_weights, reconstruction_of
from swimm3r.bench.map_scores import COLUMNS, map_scores, trained
from swimm3r.bench.runs import POSES_REFINED, Clip, SfmRun, clips_of, made_runs
from swimm3r.bench.settings import Seeds
from swimm3r.bench.tables import Table
from swimm3r.evaluate import NotComputed
from swimm3r.io.view_names import view_stems
from swimm3r.pipeline.finished_sfm import FinishedSfm
from swimm3r.pipeline.presets import RunSettings
from swimm3r.pipeline.scores import held_out
from swimm3r.progress import Progress, silent
from swimm3r.scene.ground_truth import GroundTruth
from swimm3r.settings import accepted
from swimm3r.splat.settings import (
    RECIPES,
    PoseRefinementSettings,
    RecipeName,
    SplatSettings,
    UwbsSettings,
    with_recipe,
)
from swimm3r.tasks.settings import EngineSettings

_SEEDS_APART = 1_000


def compare_renderers(
    runs: Sequence[Path],
    out: Path,
    recipes: Sequence[RecipeName],
    base: UwbsSettings,
    seeds: int = 1,
    poses: bool = False,
    test: PoseRefinementSettings | None = None,
    against: str | None = None,
    references: Path | None = None,
    how: EngineSettings | None = None,
    progress: Progress = silent,
) -> Table:
    """Every recipe at the size and length of `base` on every run; `poses` adds them all with training poses refined.

    Differences are from `against`, by default the first recipe, within the same structure from motion. `references`
    holds NAME.json (a cameras.json) of all frames of every clip, in the place of our own. Raises UsageError for no
    recipe, no seed, or an `against` that is not among the recipes, and InputError for a clip without its reference.
    """
    check_choice("recipes", recipes, against)
    accepted("seeds", seeds, Seeds)
    clips = clips_of(runs)
    reference.required(references, [clip.name for clip in clips])
    work = partial(
        _cells_of_clip,
        out=out,
        trials=_trials(base, recipes, seeds, poses),
        test=test or PoseRefinementSettings(),
        references=references,
    )
    cells = over_scenes(clips, work, out, how or EngineSettings(), progress)
    title = "Test frames rendered, by structure from motion and renderer"
    return Table("render", title, cells, COLUMNS, against or recipes[0])


def compare_on_clips(
    inputs: Sequence[Path],
    out: Path,
    settings: RunSettings,
    recipes: Sequence[RecipeName] = RECIPES,
    *,
    seeds: int = 1,
    poses: bool = False,
    given_poses: bool = False,
    against: str | None = None,
    references: Path | None = None,
    how: EngineSettings | None = None,
    progress: Progress = silent,
) -> Table:
    """`compare_renderers` on run folders and on clips, whose structure from motion is made first, in OUT/runs.

    With `given_poses` clips are folders of images with a COLMAP model. Clips that cannot be used are refused before the
    structure from motion.
    """
    check_choice("recipes", recipes, against)
    accepted("seeds", seeds, Seeds)
    reference.given(references, "")
    assert isinstance(settings.splat, UwbsSettings), "recipes start from settings of UWBS"
    runs = made_runs(inputs, out, settings, given_poses, progress)
    return compare_renderers(
        runs, out, recipes, settings.splat, seeds, poses, settings.test, against, references, how, progress
    )


@dataclass(frozen=True)
class _Trial:
    """A recipe to be trained on every reconstruction of a clip."""

    recipe: RecipeName
    refined: bool  # training poses, with the map
    seed: int
    settings: SplatSettings

    def key(self, clip: Clip, run: SfmRun) -> ResultKey:
        """The name of its result."""
        return ResultKey(clip.name, f"{run.sfm}{POSES_REFINED if self.refined else ''} / {self.recipe}", self.seed)


def _trials(base: UwbsSettings, recipes: Sequence[RecipeName], seeds: int, poses: bool) -> list[_Trial]:
    every = product(range(seeds), (False, True) if poses else (False,), recipes)
    return [_Trial(recipe, refined, seed, settings_for(base, recipe, refined, seed)) for seed, refined, recipe in every]


def _cells_of_clip(
    clip: Clip,
    /,
    *,
    out: Path,
    trials: Sequence[_Trial],
    test: PoseRefinementSettings,
    references: Path | None,
    progress: Progress,
) -> list[Result]:
    first = clip.runs[0].open()
    truth = reference.given(references, clip.name)
    if truth is None:
        truth = reference.of_clip(first, scene_folder(out / "references", clip.name), progress)
    cells: list[Result] = []
    shown: dict[str, Path] = {}
    for run in clip.runs:
        sfm = run.open()
        start: dict[str, held_out.FirstPose] = {}
        made: dict[SplatSettings, tuple[Result, Path]] = {}
        for trial in trials:
            key, settings = trial.key(clip, run), trial.settings
            if settings not in made:  # some recipes refine poses of their own accord
                made_from = [reconstruction_of(run.folder, sfm), settings]
                scored_by = [test, reference.digest(truth), lpips_weights(), [c.score for c in COLUMNS]]
                make = partial(_scores, sfm=sfm, settings=settings, test=test, truth=truth, start=start)
                cell = kept_cell(out, key, made_from, partial(make, progress=progress), scored_by)
                made[settings] = cell, key.folder(out)
            cell, folder = made[settings]
            cells.append(replace(cell, method=key.method))
            shown.setdefault(key.method, folder / "test")
    stems = view_stems(first.frames.names)
    for name in first.frames.test.names:
        if not all((images / f"{stems[name]}_target.png").is_file() for images in shown.values()):
            continue  # a test frame that could not be placed
        _side_by_side(out / "images" / clip.name, stems[name], shown)
    return cells


def settings_for(base: UwbsSettings, recipe: RecipeName, refined: bool, seed: int) -> SplatSettings:
    """A recipe at the size and length of `base`, its training poses refined where asked."""
    settings = with_recipe(base, recipe)
    settings = replace(settings, seed=settings.seed + _SEEDS_APART * seed)
    return replace(settings, poses=replace(settings.poses, enabled=True)) if refined else settings


def _scores(
    folder: Path,
    *,
    sfm: FinishedSfm,
    settings: SplatSettings,
    test: PoseRefinementSettings,
    truth: GroundTruth | NotComputed,
    start: dict[str, held_out.FirstPose],
    progress: Progress,
) -> Scores:
    if not start:  # the same for every renderer
        known = None if isinstance(truth, NotComputed) else truth
        features = sfm.settings.sfm.features
        start.update(held_out.first_poses(sfm.rec, sfm.frames, features, known, progress))
    scene = trained(sfm, settings, folder, progress)
    return map_scores(sfm, scene, start, folder, test, progress)


def _side_by_side(out: Path, stem: str, shown: Mapping[str, Path]) -> None:
    """OUT/STEM.png, a row per structure from motion: the frame, then colors and depth of each map."""
    rows: dict[str, list[Panel]] = {}
    for method, images in shown.items():
        sfm, recipe = method.split(" / ")
        row = rows.setdefault(sfm, [stored(f"{sfm}: test frame", images / f"{stem}_target.png")])
        row += [stored(recipe, images / f"{stem}_rgb.png"), stored("depth", images / f"{stem}_z_depth.png")]
    write_grid(out / f"{stem}.png", list(rows.values()))
