"""Ablation of scattering-aware gradients and the depth regularizer (the paper's ablation table), with its spread.

From one structure from motion each variant is trained under several seeds and scored on the held-out frames. Our own
terms (the water's prior, coverage) stay as they are in every variant, and need the depth maps.
"""

import shutil
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path

from swimm3r.bench.cells import Result, ResultKey, Scores, kept_cell, over_scenes
from swimm3r.bench.inputs import lpips_weights, reconstruction_of
from swimm3r.bench.map_scores import map_scores, trained
from swimm3r.bench.scores import columns
from swimm3r.bench.settings import Seeds
from swimm3r.bench.tables import Table
from swimm3r.errors import InputError
from swimm3r.pipeline.finished_sfm import FinishedSfm, open_finished_sfm
from swimm3r.pipeline.scores import held_out
from swimm3r.progress import Progress, silent
from swimm3r.settings import accepted
from swimm3r.splat.settings import PoseRefinementSettings, UwbsSettings
from swimm3r.tasks.settings import EngineSettings

COLUMNS = columns("psnr", "ssim_3dgs", "lpips_vgg", "sharpness", "clear_psnr", "train_cpu_seconds")
_SEEDS_APART = 1_000  # a preset's own seed and these do not meet


@dataclass(frozen=True)
class Variant:
    """A row of the paper's table."""

    name: str
    sgg: bool
    depth: bool

    def settings(self, full: UwbsSettings, seed: int) -> UwbsSettings:
        """`full` with this variant's parts on and the others off; a preset may have had SGG off."""
        weights = full.weights if self.depth else replace(full.weights, depth=0.0)
        sgg = replace(full.sgg, enabled=self.sgg)
        return replace(full, weights=weights, sgg=sgg, seed=full.seed + _SEEDS_APART * seed)


VARIANTS = (
    Variant("baseline", sgg=False, depth=False),
    Variant("+ SGG", sgg=True, depth=False),
    Variant("+ depth", sgg=False, depth=True),
    Variant("full", sgg=True, depth=True),
)


def ablate(
    runs: Sequence[Path],
    out: Path,
    full: UwbsSettings,
    seeds: int,
    test: PoseRefinementSettings | None = None,
    how: EngineSettings | None = None,
    progress: Progress = silent,
) -> Table:
    """The scores of every run, variant and seed; `full` is what the paper calls UWBS (full).

    Raises InputError where a folder holds no finished structure from motion, or two have one name, and UsageError for
    no seed.
    """
    accepted("seeds", seeds, Seeds)
    names = [run.resolve().name for run in runs]
    if len(set(names)) < len(names):
        raise InputError(
            f"two of the runs have one name: {', '.join(sorted(names))}",
            cause="results are kept by the runs' names",
            hint="another name for one of the folders",
        )
    for run in runs:
        open_finished_sfm(run)
    work = partial(_cells_of_run, out=out, full=full, seeds=seeds, test=test or PoseRefinementSettings())
    cells = over_scenes(runs, work, out, how or EngineSettings(), progress)
    return Table("ablation", "Underwater Beta Splatting without its parts", cells, COLUMNS)


def _cells_of_run(
    run: Path, /, *, out: Path, full: UwbsSettings, seeds: int, test: PoseRefinementSettings, progress: Progress
) -> list[Result]:
    sfm = open_finished_sfm(run)
    poses: dict[str, held_out.FirstPose] = {}

    def scores(settings: UwbsSettings, folder: Path) -> Scores:
        poses.update(poses or sfm.first_poses(progress))
        return _trained_and_scored(sfm, settings, test, poses, folder, progress)

    cells = []
    for seed in range(seeds):  # seed by seed, so that what is there at any time can be compared
        for variant in VARIANTS:
            settings = variant.settings(full, seed)
            made_from = [reconstruction_of(run, sfm), settings]
            scored_by = [test, lpips_weights(), [c.score for c in COLUMNS]]
            place = ResultKey(run.resolve().name, variant.name, seed)
            cells.append(kept_cell(out, place, made_from, partial(scores, settings), scored_by))
    return cells


def _trained_and_scored(
    sfm: FinishedSfm,
    settings: UwbsSettings,
    test: PoseRefinementSettings,
    poses: dict[str, held_out.FirstPose],
    folder: Path,
    progress: Progress,
) -> Scores:
    scene = trained(sfm, settings, folder, progress)
    shutil.rmtree(folder / "checkpoint", ignore_errors=True)
    return map_scores(sfm, scene, poses, folder, test, progress)
