"""Depth, cloud and restored frames beside silhouettes, where windows put surfaces in front of others too far out.

    python benchmarks/silhouettes.py RUN[:TRUTH] ...

RUN are run folders with finished structure from motion. Beside a TRUTH (of a synthetic dive; the demo's is found), over
its frames:

    measured   share of the pixels with measured depth
    in front   share of the pixels whose depth is more than 7 % nearer than the true surface within a pixel ..
    in water   .. and of those that show open water and have a depth
    cloud      share of the cloud's points that lie as far in front of the true surface in any frame, or in open water
    restored   PSNR of the restored frames against the clear colors, dB, on surfaces ..
    beside     .. and on those within 8 pixels of one that is an eighth nearer, or of what it hides
"""

import argparse
import math
from dataclasses import dataclass

import numpy as np
import torch
from dive_runs import dive_run, to_truth
from jaxtyping import Bool, Float
from scipy.ndimage import maximum_filter, minimum_filter
from torch import Tensor

from swimm3r.cameras import project_visible
from swimm3r.io import images
from swimm3r.pipeline.finished_sfm import FinishedSfm

IN_FRONT = 0.07  # of the depth
STEP = 1 / 8  # of the depth, between two surfaces
REACH = 8  # px


@dataclass(frozen=True)
class Sums:
    """Of one frame: shares of its pixels, and mean squared errors."""

    in_front: float
    in_water: float
    restored: float
    beside: float


def nearest_around(true: Float[Tensor, "h w"], size: int) -> Float[np.ndarray, "h w"]:
    """The nearest true depth within a window, infinite where it shows open water alone."""
    return minimum_filter(torch.where(true > 0, true, torch.inf).numpy(), size)


def silhouettes(true: Float[Tensor, "h w"]) -> Bool[np.ndarray, "h w"]:
    """Mask of the surfaces close to a step in depth."""
    farthest = maximum_filter(true.numpy(), 2 * REACH + 1)
    return (true.numpy() > 0) & (farthest > (1 + STEP) * nearest_around(true, 2 * REACH + 1))


def of_frame(sfm: FinishedSfm, name: str, per_unit: float) -> Sums | None:
    """The figures of one frame; None where it was not restored, or its truth is not known."""
    truth = sfm.truth
    assert truth is not None
    true, clear = truth.z_depth(name), truth.clear(name)
    path = sfm.folder / "sfm" / "restored_physical" / f"{name}.png"
    if true is None or clear is None or not path.is_file():
        return None
    z, surface = sfm.rec.depth[name].z_depth.numpy() * per_unit, true.numpy() > 0
    restored = images.read_rgb(path).astype(np.float32) / np.iinfo(np.uint16).max
    error = ((restored - clear.numpy()) ** 2).mean(-1)
    return Sums(
        float((surface & (z > 0) & (z < (1 - IN_FRONT) * nearest_around(true, 3))).mean()),
        float((~surface & (z > 0)).mean()),
        float(error[surface].mean()),
        float(error[silhouettes(true)].mean()),
    )


def cloud_in_front(sfm: FinishedSfm, per_unit: float) -> float:
    """Share of the cloud's points in front of the true surface."""
    rec, truth = sfm.rec, sfm.truth
    assert truth is not None
    assert rec.cloud is not None
    found = torch.zeros(len(rec.cloud.xyz), dtype=torch.bool)
    for i, name in enumerate(rec.names):
        true = truth.z_depth(name)
        if true is None:
            continue
        pixels, z, visible = project_visible(rec.cameras[i], rec.cloud.xyz[None].double())
        at = visible[0].nonzero()[:, 0]
        column, row = pixels[0, at].long().unbind(-1)
        found[at] |= z[0, at] * per_unit < (1 - IN_FRONT) * torch.from_numpy(nearest_around(true, 3))[row, column]
    return float(found.float().mean())


def row(sfm: FinishedSfm) -> str:
    """The table's line of a run."""
    rec, truth = sfm.rec, sfm.truth
    measured = np.mean([float((rec.depth[name].z_depth > 0).float().mean()) for name in rec.names])
    cells = ["-"] * 5
    if truth is not None:
        per_unit = float(to_truth(sfm).scale)
        sums = [found for name in rec.names if (found := of_frame(sfm, name, per_unit))]
        in_front, in_water, restored, beside = np.mean([list(vars(frame).values()) for frame in sums], axis=0)
        cells = [f"{in_front:.2%}", f"{in_water:.2%}", f"{cloud_in_front(sfm, per_unit):.2%}"]
        cells += [f"{-10 * math.log10(error):.2f} dB" for error in (restored, beside)]
    return f"| {sfm.folder.name} | {measured:.2%} | {' | '.join(cells)} |"


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("runs", nargs="+", type=dive_run, metavar="RUN[:TRUTH]")
    options = parser.parse_args()
    print("| run | measured | in front | in water | cloud | restored | beside |")
    print("| --- | --- | --- | --- | --- | --- | --- |")
    for sfm in options.runs:
        print(row(sfm), flush=True)


if __name__ == "__main__":
    main()
