"""What scattering-aware gradients and the depth regulariser gain (the paper's Tab. ablation_compact), with its spread.

From one structure from motion each variant is trained under several seeds and scored on the held-out frames. Every
training with its scores keeps a folder OUT/RUN/VARIANT/SEED; one that is there is not made again, one that was cut
short goes on. Our own terms (the water's prior, coverage) stay as they are in every variant, and need the depth maps.
"""

import json
import shutil
import time
from collections.abc import Sequence
from dataclasses import asdict, dataclass, replace
from hashlib import sha256
from pathlib import Path

from swimm3r import held_out
from swimm3r.bench.statistics import Cell
from swimm3r.errors import InputError
from swimm3r.evaluate import NotComputed
from swimm3r.io.atomic import write_text
from swimm3r.progress import Progress, silent
from swimm3r.run import FinishedSfm, open_finished_sfm
from swimm3r.splat import train
from swimm3r.splat.checkpoint import load_map
from swimm3r.splat.settings import PoseRefinementSettings, UwbsSettings
from swimm3r.summary import truth_section

SCORES = ("psnr", "ssim", "lpips", "sharpness", "clear_psnr")
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
    progress: Progress = silent,
) -> list[Cell]:
    """The scores of every run, variant and seed; `full` is what the paper calls UWBS (full).

    Raises InputError where a folder holds no finished structure from motion, or two have one name.
    """
    names = [run.resolve().name for run in runs]
    if len(set(names)) < len(names):
        raise InputError(
            f"two of the runs have one name: {', '.join(sorted(names))}",
            cause="results are kept by the runs' names",
            hint="another name for one of the folders",
        )
    test = test or PoseRefinementSettings()
    cells = []
    for name, run in zip(names, runs, strict=True):
        sfm, poses = open_finished_sfm(run), None
        for seed in range(seeds):  # seed by seed, so that what is there at any time can be compared
            for variant in VARIANTS:
                folder = out / name / variant.name.replace("+ ", "plus-") / f"{seed}"
                settings = variant.settings(full, seed)
                key = sha256(json.dumps([sfm.key, asdict(settings), asdict(test)], sort_keys=True).encode()).hexdigest()
                cell = _finished(folder, key)
                if cell is None:
                    poses = poses or sfm.first_poses(progress)
                    scores = _trained(sfm, settings, test, poses, folder, progress)
                    cell = Cell(name, variant.name, seed, scores)
                    write_text(folder / "scores.json", json.dumps({"key": key, **asdict(cell)}, indent=2) + "\n")
                cells.append(cell)
    return cells


def _finished(folder: Path, key: str) -> Cell | None:
    path = folder / "scores.json"
    if not path.is_file():
        return None
    stored = json.loads(path.read_text(encoding="utf-8"))
    if stored.pop("key") != key:
        return None
    return Cell(**stored)


def _trained(
    sfm: FinishedSfm,
    settings: UwbsSettings,
    test: PoseRefinementSettings,
    poses: dict[str, held_out.FirstPose],
    folder: Path,
    progress: Progress,
) -> dict[str, float | None]:
    """Train, or take the finished map, and score the held-out frames."""
    cpu = time.process_time()
    path = folder / "map.safetensors"
    scene = load_map(path) if path.is_file() else None
    if scene is None or scene.settings != settings:
        scene = train(sfm.rec, sfm.frames, settings, folder, progress)
    shutil.rmtree(folder / "checkpoint", ignore_errors=True)
    cpu = time.process_time() - cpu
    there = held_out.in_axes_of(scene, sfm.rec, poses)
    views = held_out.score_views(scene, sfm.rec, sfm.frames, there, folder / "test", test, progress)
    scores: dict[str, float | NotComputed | None] = dict(vars(held_out.mean_scores(views)))
    if sfm.truth is not None:
        of_map = truth_section(sfm.rec, sfm.frames, sfm.truth, scene, views, progress).get("splat")
        scores["clear_psnr"] = of_map["clear_psnr"] if isinstance(of_map, dict) else None
    values = {name: scores.get(name) for name in SCORES}
    numbers = {name: None if isinstance(v, NotComputed) else v for name, v in values.items()}
    return {**numbers, "train_cpu_seconds": cpu}
