"""Gains that change over a frame: maps of the preset `fast` without and with them, held to be there in the second.

    python benchmarks/shading.py RUN... --out DIR [--iterations 2000]

RUN are folders with finished structure from motion. Each map is scored in the colors that its test frames are fitted
in, which is a finer fit with shadings: the scores do not compare across the two. The renderings and targets in DIR do,
under any one fit of `swimm3r.evaluate.registration`. Results stay in DIR: the same command resumes.
"""

import argparse
from dataclasses import asdict, replace
from functools import partial
from pathlib import Path

import torch
from map_terms import scores

from swimm3r.bench import tables
from swimm3r.bench.cells import Result, ResultKey, kept_cell
from swimm3r.bench.scores import columns
from swimm3r.imaging.appearance import color_tracks
from swimm3r.imaging.frame_colors import fit_frame_colors
from swimm3r.pipeline.finished_sfm import open_finished_sfm
from swimm3r.pipeline.presets import PRESETS
from swimm3r.splat.settings import UwbsSettings

COLUMNS = columns("psnr_affine", "psnr_observed", "ssim_3dgs", "sharpness_observed", "flow_px")


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("runs", nargs="+", type=Path)
    parser.add_argument("--out", type=Path, required=True)
    parser.add_argument("--iterations", type=int, default=PRESETS["fast"].splat.iterations)
    a = parser.parse_args()
    torch.set_num_threads(1)
    fast, test = PRESETS["fast"].splat, PRESETS["fast"].test
    assert isinstance(fast, UwbsSettings)
    cells: list[Result] = []
    for run in a.runs:
        sfm = open_finished_sfm(run)
        names = [name for name in sfm.rec.names if name in {frame.name for frame in sfm.frames.train}]
        fit = fit_frame_colors(color_tracks(sfm.rec, sfm.frames, names))
        if fit is not None:
            print(f"{run}: shadings explain {fit.evidence.by_shading or 0.0:.0%} of what water and maps leave")
        poses = sfm.first_poses(lambda *_: None)
        for name, mode, shading in (("without", "auto", "off"), ("with", "on", "on")):
            appearance = replace(fast.appearance, mode=mode, shading=shading)
            settings = replace(fast, iterations=a.iterations, appearance=appearance)
            make = partial(scores, sfm=sfm, settings=settings, test=test, poses=poses)
            depends_on = [sfm.key, asdict(settings), asdict(test), [c.score for c in COLUMNS]]
            cells.append(kept_cell(a.out, ResultKey(run.resolve().name, name, 0), depends_on, make))
    print(tables.write(a.out, tables.Table("shading", "Gains that change over a frame", cells, COLUMNS)))


if __name__ == "__main__":
    main()
