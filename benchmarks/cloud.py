"""Points of the dense cloud that stand in front of the true surface, with and without those that frames look through.

    python benchmarks/cloud.py RUN[:TRUTH] ... [--most-behind X]

RUN are finished run folders, whose depth maps are fused again: with every point, and with `water.tracks.most_behind` as
in the run, or as given. Beside a TRUTH (of a synthetic dive; the demo's is found):

    points   number of dense tracks
    dropped  share of them that frames look through
    in front share of the points that lie more than 7 % nearer than the true surface, within a pixel, in any frame
"""

import argparse
from dataclasses import replace
from pathlib import Path

import torch
from jaxtyping import Float
from scipy.ndimage import minimum_filter
from torch import Tensor

from swimm3r.cameras import project_visible
from swimm3r.geometry import align_poses
from swimm3r.pipeline.finished_sfm import FinishedSfm, open_finished_sfm
from swimm3r.scene.ground_truth import GroundTruth
from swimm3r.scene.reconstruction import Reconstruction
from swimm3r.sfm.medium.dense_tracks import fuse_depth

IN_FRONT = 0.07  # of the depth
EVERY = 1000.0  # more frames behind a point than any run has


def in_front(rec: Reconstruction, truth: GroundTruth, xyz: Float[Tensor, "n 3"]) -> float:
    """Share of the points in front of the true surface."""
    there = truth.cameras.cam2world[[truth.names.index(name) for name in rec.names]]
    per_unit = float(align_poses(rec.cameras.cam2world.double(), there.double()).scale)
    found = torch.zeros(len(xyz), dtype=torch.bool)
    for i, name in enumerate(rec.names):
        true = truth.z_depth(name)
        if true is None:
            continue
        nearest = torch.from_numpy(minimum_filter(torch.where(true > 0, true, torch.inf).numpy(), 3))
        pixels, z, visible = project_visible(rec.cameras[i], xyz[None].double())
        at = visible[0].nonzero()[:, 0]
        column, row = pixels[0, at].long().unbind(-1)
        found[at] |= z[0, at] * per_unit < (1 - IN_FRONT) * nearest[row, column]
    return float(found.float().mean())


def row(sfm: FinishedSfm, name: str, most_behind: float | None) -> str:
    """The table's line of a run."""
    kept = sfm.settings.sfm.water.tracks
    if most_behind is not None:
        kept = replace(kept, most_behind=most_behind)
    rec = replace(sfm.rec, steady=None)  # tracks are those of the frames as filmed
    clouds = [
        fuse_depth(rec, rec.still(sfm.frames), settings).xyz for settings in (replace(kept, most_behind=EVERY), kept)
    ]
    truth = sfm.truth
    shares = ["-", "-"] if truth is None else [f"{in_front(rec, truth, xyz):.2%}" for xyz in clouds]
    dropped = 1 - len(clouds[1]) / max(1, len(clouds[0]))
    return f"| {name} | {len(clouds[0]):,} | {dropped:.2%} | {' | '.join(shares)} |"


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("runs", nargs="+", metavar="RUN[:TRUTH]")
    parser.add_argument("--most-behind", type=float)
    options = parser.parse_args()
    print("| run | points | dropped | in front, every point | in front, kept |")
    print("| --- | --- | --- | --- | --- |")
    for given in options.runs:
        run, _, truth = given.partition(":")
        sfm = open_finished_sfm(Path(run), Path(truth) if truth else None)
        print(row(sfm, Path(run).name, options.most_behind), flush=True)


if __name__ == "__main__":
    main()
