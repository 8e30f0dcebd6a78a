"""Displacement and PSNR of test frames by the pixels that their poses are refined on.

    python benchmarks/held_out_poses.py RUN...

RUN is a finished run. Printed are means over its test frames, on measured ground: the median displacement between
rendering and frame, and the PSNR after an affine map of colors; "-" where they have none. Poses are those that
refinement starts from; refined on edges, whatever they gain, as in 3R-GS; and as the run's settings have it on all
pixels.
"""

import argparse
import tempfile
from dataclasses import replace
from pathlib import Path

from swimm3r.evaluate import NotComputed
from swimm3r.pipeline.finished_sfm import open_finished_sfm
from swimm3r.pipeline.scores import held_out
from swimm3r.splat.map_file import load_map


def _number(value: float | NotComputed, digits: int) -> str:
    return "-" if isinstance(value, NotComputed) else f"{value:.{digits}f}"


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("runs", nargs="+", type=Path)
    args = parser.parse_args()
    print("| run | first poses: px, dB | edges, every gain: px, dB | all pixels: px, dB |")
    print("| --- | --- | --- | --- |", flush=True)
    for folder in args.runs:
        run = open_finished_sfm(folder)
        scene = load_map(folder / "splat" / "map.safetensors")
        poses = held_out.in_axes_of(scene, run.rec, run.first_poses())
        test = run.settings.test
        cells = []
        for settings in (
            replace(test, steps=0),
            replace(test, pixels="edges", min_gain=0.0),
            replace(test, pixels="all"),
        ):
            with tempfile.TemporaryDirectory() as views:
                scored = held_out.score_views(scene, run.rec, run.frames, poses, Path(views), settings)
            means = held_out.mean_scores(scored)
            cells.append(f"{_number(means['flow_px'], 3)}, {_number(means['psnr_affine'], 2)}")
        print(f"| {folder.name} | {' | '.join(cells)} |", flush=True)


if __name__ == "__main__":
    main()
