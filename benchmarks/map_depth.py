"""Depth of a map in its own training frames, beside the depth that was measured there.

    python benchmarks/map_depth.py RUN[:TRUTH] ...

RUN are run folders with a finished map. In every second training frame, where a surface was measured and the map is
opaque:

    confident, doubtful   share of these pixels whose depth has a confidence of 0.3 or more, and of the others, which
                          few frames share or little texture determines
    off                   share of them whose depth in the map is off by more than 5 % of what was measured ..
    true                  .. and, beside a TRUTH (the demo's is found), of the true depth or before open water
"""

import argparse
from collections.abc import Iterator

import torch
from dive_runs import dive_run, to_truth
from jaxtyping import Bool, Float
from torch import Tensor

from swimm3r.imaging.undistortion import nearest_pixels
from swimm3r.pipeline.finished_sfm import FinishedSfm
from swimm3r.splat.map_file import load_map

EVERY = 2  # training frames
OFF = 0.05  # of the depth
SURE = 0.3  # confidence
OPAQUE = 0.5


def off(z: Float[Tensor, " n"], than: Float[Tensor, " n"]) -> Bool[Tensor, " n"]:
    """Depths that differ by more than `OFF`."""
    return (z / than.clamp(min=1e-9)).log().abs() > OFF


def pixels(sfm: FinishedSfm) -> Iterator[Float[Tensor, "n 3"]]:
    """Of a frame's measured pixels: confidence, 1 where the map is off, 1 where it is off the truth (NaN: unknown)."""
    rec, truth = sfm.rec, sfm.truth
    scene = load_map(sfm.folder / "splat" / "map.safetensors")
    unit = 1.0 if truth is None else float(to_truth(sfm).scale)
    for i in range(0, len(rec.names), EVERY):
        name, lens = rec.names[i], rec.cameras[i]
        camera = lens.drawn(sfm.settings.splat.long_side)
        row, column = nearest_pixels(lens, camera)
        depth = rec.depth[name]
        z, confidence = depth.z_depth[row, column], depth.confidence[row, column]
        out = scene.render(camera, sfm.frames.frames[sfm.frames.index(name)].time, backscatter=False, observed=False)
        at = (z > 0) & (out.alpha > OPAQUE)
        wrong = torch.full((int(at.sum()),), torch.nan)
        if truth is not None and (true := truth.z_depth(name)) is not None:
            wrong = off(out.z_depth[at], true[row, column][at] / unit).float()
        yield torch.stack([confidence[at], off(out.z_depth[at], z[at]).float(), wrong], 1)


def cells(found: Float[Tensor, "n 3"]) -> list[str]:
    """Shares of some pixels that are off what was measured, and off the truth; - where none is known."""
    return ["-" if share.isnan() else f"{float(share):.1%}" for share in found[:, 1:].nanmean(0)]


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("runs", nargs="+", type=dive_run, metavar="RUN[:TRUTH]")
    options = parser.parse_args()
    print("| run | confident | off | true | doubtful | off | true |\n| --- | --- | --- | --- | --- | --- | --- |")
    for sfm in options.runs:
        found = torch.cat(list(pixels(sfm)))
        sure = found[:, 0] >= SURE
        row = []
        for part in (sure, ~sure):
            row += [f"{float(part.float().mean()):.0%}", *cells(found[part])]
        print(f"| {sfm.folder.name} | {' | '.join(row)} |", flush=True)


if __name__ == "__main__":
    main()
