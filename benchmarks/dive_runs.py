"""Runs of dives whose truth may be known, as benchmarks take them: RUN[:TRUTH]."""

import argparse
from pathlib import Path

from swimm3r.errors import InputError
from swimm3r.geometry import Similarity, align_poses
from swimm3r.pipeline.finished_sfm import FinishedSfm, open_finished_sfm


def dive_run(given: str) -> FinishedSfm:
    """The run of an argument RUN or RUN:TRUTH; the truth of the demo's dive is found without."""
    run, _, truth = given.partition(":")
    try:
        return open_finished_sfm(Path(run), Path(truth) if truth else None)
    except InputError as error:
        raise argparse.ArgumentTypeError(str(error)) from error


def to_truth(sfm: FinishedSfm) -> Similarity:
    """The similarity from the axes and the unit of a run to those of its truth, by the cameras of its frames."""
    rec, truth = sfm.rec, sfm.truth
    if truth is None:
        raise SystemExit(f"{sfm.folder.name} has no truth: name it as RUN:TRUTH")
    there = truth.cameras.cam2world[[truth.names.index(name) for name in rec.names]]
    return align_poses(rec.cameras.cam2world.double(), there.double())
