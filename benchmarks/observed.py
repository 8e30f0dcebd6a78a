"""`observed` of views of a map against the true depth of its training frames.

    python benchmarks/observed.py RUN[:TRUTH] ...

RUN are run folders with a finished map of a synthetic dive, TRUTH their truth (the demo's is found). Views are those of
the test frames, and the same moved aside and up by parts of the median depth, and turned. Means over them:

    seen       share of the pixels whose surface, or open water, some training frame saw: a point of the map's depth
               that lies no more than 5 % behind the true surface there
    missed     share that frames saw and `observed` denies, and those of them in open water
    claimed    share that no frame saw and `observed` holds, and those of them in open water

The record of the map is made anew from its depth, so that it is of the code at hand.
"""

import argparse
from collections.abc import Iterator
from dataclasses import dataclass, replace

import numpy as np
import torch
from dive_runs import dive_run, to_truth
from jaxtyping import Bool, Float
from torch import Tensor

from swimm3r.cameras import Cameras, pixel_grid, project, unproject
from swimm3r.geometry import pose_from, so3_exp
from swimm3r.pipeline.finished_sfm import FinishedSfm
from swimm3r.splat.map_file import load_map
from swimm3r.splat.rendering import SplatMap
from swimm3r.splat.train_map import seen_in_training

LONG_SIDE = 480  # px of the views
BEHIND = 1.05  # of the true depth, up to where a point is seen
FAR = 8.0  # largest depths, where open water is asked for
# aside and up, parts of the median depth; degrees about the vertical axis of the view
MOVES = {
    "from a test frame": (0.0, 0.0, 0.0),
    "moved aside": (0.5, 0.0, 0.0),
    "moved up": (0.0, 0.4, 0.0),
    "turned": (0.0, 0.0, 20.0),
    "moved and turned": (-0.6, 0.2, -17.0),
}


@dataclass(frozen=True)
class TrueFrames:
    """Training frames with their true depth."""

    cameras: Cameras
    z_depth: Float[Tensor, "n h w"]  # scene units; infinite in open water

    def see(self, points: Float[Tensor, "p 3"]) -> Bool[Tensor, " p"]:
        """Mask of the points that some frame saw."""
        seen = torch.zeros(len(points), dtype=torch.bool)
        size = torch.tensor([self.cameras.width, self.cameras.height])
        for i, surface in enumerate(self.z_depth):
            pixels, z = project(self.cameras[[i]], points[None])
            inside = (z[0] > 0) & ((pixels[0] >= 0) & (pixels[0] < size)).all(-1)
            column, row = torch.where(inside[:, None], pixels[0], 0.0).long().unbind(-1)
            seen |= inside & (z[0] <= BEHIND * surface[row, column])
        return seen


def moved(camera: Cameras, aside: float, up: float, degrees: float) -> Cameras:
    """A camera moved in its own axes, then turned."""
    turn = so3_exp(torch.tensor([0.0, np.radians(degrees), 0.0], dtype=torch.float64))
    own = pose_from(turn, torch.tensor([aside, -up, 0.0], dtype=torch.float64))
    return replace(camera, cam2world=camera.cam2world.double() @ own)


def shares(scene: SplatMap, camera: Cameras, frames: TrueFrames) -> list[float]:
    """The table's figures of one view."""
    out = scene.render(camera, backscatter=False)
    assert out.observed is not None
    height, width = out.z_depth.shape
    surface = (out.alpha > 0.5) & (out.z_depth > 0)
    far = FAR * float(frames.z_depth[frames.z_depth.isfinite()].max())
    z = torch.where(surface, out.z_depth.double(), far).reshape(1, -1)
    points = unproject(camera, pixel_grid(height, width).reshape(1, -1, 2).double(), z)[0]
    seen = frames.see(points).reshape(height, width)
    missed, claimed = seen & ~out.observed, ~seen & out.observed
    parts = [seen, missed, missed & ~surface, claimed, claimed & ~surface]
    return [float(part.float().mean()) for part in parts]


def rows(sfm: FinishedSfm) -> Iterator[str]:
    """The table's lines of a run."""
    there, rec, truth = to_truth(sfm), sfm.rec, sfm.truth
    assert truth is not None
    depth = {i: z for i, name in enumerate(rec.names) if (z := truth.z_depth(name)) is not None}
    true = torch.stack(list(depth.values())).double() / there.scale
    frames = TrueFrames(rec.cameras[list(depth)], torch.where(true > 0, true, torch.inf))
    scene = load_map(sfm.folder / "splat" / "map.safetensors")
    scene = replace(scene, coverage=seen_in_training(scene, rec, sfm.frames, rec.names))
    unit = float(rec.point_depths().median())
    held_out = [i for i, name in enumerate(truth.names) if name not in rec.names]
    poses = there.inverse().poses(truth.cameras.cam2world[held_out].double())
    for label, (aside, up, degrees) in MOVES.items():
        lens = rec.cameras[[0]].drawn(LONG_SIDE)
        views = [moved(replace(lens, cam2world=pose[None]), aside * unit, up * unit, degrees) for pose in poses]
        cells = np.mean([shares(scene, view, frames) for view in views], axis=0)
        yield f"| {sfm.folder.name}, {label} | {' | '.join(f'{cell:.2%}' for cell in cells)} |"


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("runs", nargs="+", type=dive_run, metavar="RUN[:TRUTH]")
    options = parser.parse_args()
    print("| views | seen | missed | in water | claimed | in water |")
    print("| --- | --- | --- | --- | --- | --- |")
    for sfm in options.runs:
        for row in rows(sfm):
            print(row, flush=True)


if __name__ == "__main__":
    main()
