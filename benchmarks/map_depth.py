"""Depth of a map in its own training frames, beside the depth that was measured or guessed there.

    python benchmarks/map_depth.py RUN[:TRUTH] ...

RUN are run folders with a finished map. In every second training frame, where it shows a surface and the map is opaque:

    confident, doubtful   share of these pixels whose depth was measured with a confidence of 0.3 or more, and with
                          less, as few frames share it or little texture determines it
    guessed               share of them that have no measured depth, so that it is filled in
    off                   share of a kind whose depth in the map is off by more than 5 % of what was measured or guessed
    true                  and, beside a TRUTH (the demo's is found), of the true depth or before open water
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
from swimm3r.splat.settings import UwbsSettings
from swimm3r.splat.views import TrainingViews

EVERY = 2  # training frames
OFF = 0.05  # of the depth
SURE = 0.3  # confidence
LEAST = 1e-3  # confidence of measured depth, so that 0 is that of none
OPAQUE = 0.5


def off(z: Float[Tensor, " n"], than: Float[Tensor, " n"]) -> Bool[Tensor, " n"]:
    """Depths that differ by more than `OFF`."""
    return (z / than.clamp(min=1e-9)).log().abs() > OFF


def pixels(sfm: FinishedSfm) -> Iterator[Float[Tensor, "n 3"]]:
    """Of a frame's surfaces: confidence of their depth, 0 of a guess; 1 where the map is off, and off the truth (NaN:
    unknown)."""
    rec, truth = sfm.rec, sfm.truth
    scene = load_map(sfm.folder / "splat" / "map.safetensors")
    views = TrainingViews(rec, sfm.frames, UwbsSettings(long_side=sfm.settings.splat.long_side), 1.0)
    unit = 1.0 if truth is None else float(to_truth(sfm).scale)
    for k in range(0, len(views), EVERY):
        name = views.names[k]
        lens = rec.cameras[rec.index(name)]
        camera = lens.drawn(sfm.settings.splat.long_side)
        row, column = nearest_pixels(lens, camera)
        depth = rec.depth[name]
        measured, confidence = depth.z_depth[row, column], depth.confidence[row, column]
        guessed = views[k].guessed_z_depth
        assert guessed is not None
        z = torch.where(measured > 0, measured, guessed)
        confidence = torch.where(measured > 0, confidence.clamp(min=LEAST), 0.0)
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
    kinds = ("confident", "doubtful", "guessed")
    print(f"| run | {' | '.join(f'{kind} | off | true' for kind in kinds)} |\n{'| --- ' * 10}|")
    for sfm in options.runs:
        found = torch.cat(list(pixels(sfm)))
        sure, guessed = found[:, 0] >= SURE, found[:, 0] == 0
        row = []
        for part in (sure, ~sure & ~guessed, guessed):
            row += [f"{float(part.float().mean()):.0%}", *cells(found[part])]
        print(f"| {sfm.folder.name} | {' | '.join(row)} |", flush=True)


if __name__ == "__main__":
    main()
