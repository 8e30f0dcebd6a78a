"""Moving objects found in finished runs, against truth where a dive has masks of them.

    python benchmarks/moving_masks.py RUN [RUN ...]

Runs are of `swimm3r sfm SOURCE --moving none --out RUN`, so that their depth is as it was before masks. A synthetic
dive brings its truth; without moving objects in it, all that is found is false.
"""

import argparse
import time
from pathlib import Path

import numpy as np

from swimm3r.pipeline.inputs import truth_of
from swimm3r.scene.ground_truth import GroundTruth
from swimm3r.scene.reconstruction_io import load_reconstruction
from swimm3r.scene.run_folder import open_run
from swimm3r.sfm.moving.still_scene import enlarged, still_scene
from swimm3r.sfm.rectified.run import run_frames


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("runs", nargs="+", type=Path)
    print("| run | frames | with objects | pixels found | recall | precision | false | CPU s |")
    print("| --- | --- | --- | --- | --- | --- | --- | --- |")
    for folder in parser.parse_args().runs:
        print(row(folder), flush=True)


def row(folder: Path) -> str:
    """The table's line of a run."""
    run = open_run(folder, "sfm")
    frames = run_frames(folder)
    rec = load_reconstruction(folder / "sfm", frames)
    started = time.process_time()
    scene = still_scene(rec, frames)
    found = [enlarged(moving, frames.height, frames.width).numpy() for moving in scene.moving_in_frames()]
    seconds = time.process_time() - started
    truth = truth_of(Path(run.input.path), None)
    scores = "- | - | -" if truth is None else compared(found, [true_mask(truth, name) for name in rec.names])
    share = np.mean([mask.mean() for mask in found])
    some = sum(bool(mask.any()) for mask in found)
    return f"| {folder.name} | {len(found)} | {some} | {share:.2%} | {scores} | {seconds:.1f} |"


def true_mask(truth: GroundTruth, name: str) -> np.ndarray:
    """The pixels of a frame of known truth at which something moves."""
    moving = truth.moving(name)
    return np.zeros((truth.cameras.height, truth.cameras.width), bool) if moving is None else moving.numpy()


def compared(found: list[np.ndarray], true: list[np.ndarray]) -> str:
    """Recall, precision, and the share of all pixels that are found and do not move."""
    hits = sum(int((a & b).sum()) for a, b in zip(found, true, strict=True))
    claimed, moving = sum(int(a.sum()) for a in found), sum(int(b.sum()) for b in true)
    recall = f"{hits / moving:.2f}" if moving else "-"
    precision = f"{hits / claimed:.2f}" if claimed and moving else "-"
    return f"{recall} | {precision} | {(claimed - hits) / sum(a.size for a in found):.2%}"


if __name__ == "__main__":
    main()
