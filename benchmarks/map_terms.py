"""Terms of a map's objective: maps with all of them, without each term beyond Eq. 18, and under other edge scales.

    python benchmarks/map_terms.py RUN... --out DIR [--seeds 1] [--iterations 600] [--long-side 240]
        [--primitives 8000] [--test-steps 100] [--only NAME ...]

RUN are folders with finished structure from motion. The maps have the terms, SGG and edge scale of the preset `best`,
the rates of `fast`, which are made for short runs, and poses held. Results stay in DIR: the same command resumes.
"""

import argparse
import shutil
from dataclasses import asdict, replace
from functools import partial
from pathlib import Path

import torch

from swimm3r.bench import tables
from swimm3r.bench.cells import Result, ResultKey, Scores, kept_cell
from swimm3r.bench.map_scores import map_scores, trained
from swimm3r.bench.protocols.ablation_uwbs import COLUMNS as OF_ABLATION
from swimm3r.bench.scores import columns
from swimm3r.pipeline.finished_sfm import FinishedSfm, open_finished_sfm
from swimm3r.pipeline.presets import PRESETS
from swimm3r.pipeline.scores.held_out import FirstPose
from swimm3r.splat.settings import PoseRefinementSettings, SggSettings, UwbsSettings

COLUMNS = (*OF_ABLATION, *columns("T_D_abs", "B_abs"))  # the last two of synthetic dives
TERMS = ("medium_prior", "in_front", "guess", "coverage", "open_water", "gamut")
_SEEDS_APART = 1_000


def variants(full: UwbsSettings) -> dict[str, UwbsSettings]:
    """Settings by name; "water free at once" has all terms and no wait, the last is the depth term of old."""
    at_once = replace(full.medium, begin=0.0)
    none = replace(full.weights, **dict.fromkeys(TERMS, 0.0))
    return {
        "all": full,
        **{f"without {term}": replace(full, weights=replace(full.weights, **{term: 0.0})) for term in TERMS},
        "water free at once": replace(full, medium=at_once),
        "Eq. 18 alone": replace(full, weights=none, medium=at_once),
        **{f"depth_edges {k:g}": replace(full, weights=replace(full.weights, depth_edges=k)) for k in (1.0, 30.0)},
        "depth_edges 1, depth 0.2": replace(full, weights=replace(full.weights, depth_edges=1.0, depth=0.2)),
    }


def scores(
    folder: Path,
    *,
    sfm: FinishedSfm,
    settings: UwbsSettings,
    test: PoseRefinementSettings,
    poses: dict[str, FirstPose],
) -> Scores:
    """One training, scored on the run's test frames."""
    scene = trained(sfm, settings, folder)
    shutil.rmtree(folder / "checkpoint", ignore_errors=True)
    return map_scores(sfm, scene, poses, folder, test)


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("runs", nargs="+", type=Path)
    parser.add_argument("--out", type=Path, required=True)
    parser.add_argument("--seeds", type=int, default=1)
    parser.add_argument("--iterations", type=int, default=600)
    parser.add_argument("--long-side", type=int, default=240)
    parser.add_argument("--primitives", type=int, default=8000)
    parser.add_argument("--test-steps", type=int, default=100)
    parser.add_argument("--only", nargs="*")
    a = parser.parse_args()
    torch.set_num_threads(1)
    fast, best = PRESETS["fast"].splat, PRESETS["best"].splat
    assert isinstance(fast, UwbsSettings)
    assert isinstance(best, UwbsSettings)
    full = replace(
        fast,
        iterations=a.iterations,
        long_side=a.long_side,
        initial=replace(fast.initial, primitives=a.primitives),
        densify=replace(fast.densify, cap_max=2 * a.primitives),
        weights=best.weights,
        medium=best.medium,
        sgg=SggSettings(),
    )
    test = PoseRefinementSettings(steps=a.test_steps)
    cells: list[Result] = []
    for run in a.runs:
        sfm = open_finished_sfm(run)
        poses = sfm.first_poses(lambda *_: None)
        for seed in range(a.seeds):
            for name, settings in variants(replace(full, seed=_SEEDS_APART * seed)).items():
                if a.only and name not in a.only:
                    continue
                make = partial(scores, sfm=sfm, settings=settings, test=test, poses=poses)
                depends_on = [sfm.key, asdict(settings), asdict(test), [c.score for c in COLUMNS]]
                cells.append(kept_cell(a.out, ResultKey(run.resolve().name, name, seed), depends_on, make))
                print(cells[-1].scene, name, seed, cells[-1].scores, flush=True)
    print(tables.write(a.out, tables.Table("map-terms", "Terms of the objective", cells, COLUMNS)))


if __name__ == "__main__":
    main()
