"""Reconstruct a folder of images and train a map of it, step by step.

    python examples/reconstruct_and_train.py FOLDER --out WORK [--steps 2000] [--primitives 50000] [--long-side 480]

WORK receives prepare/, sfm/ and splat/ as a run folder has them, and a test frame as the map renders it. The same
command resumes. `swimm3r run FOLDER --out RUN` does all of this and more: scores, a report, checks of the settings.
"""

import argparse
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import swimm3r
from swimm3r.io.images import write_rgb


def main(arguments: Sequence[str] | None = None) -> None:
    """Run the steps; results are in the folder WORK."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("folder", type=Path, help="images of one dive, or a video")
    parser.add_argument("--out", type=Path, required=True, help="folder for the results")
    parser.add_argument("--steps", type=int, default=2000, help="steps of the map's training")
    parser.add_argument("--primitives", type=int, default=50_000, help="largest number of primitives")
    parser.add_argument("--long-side", type=int, default=480, help="longer side of the training images, pixels")
    given = parser.parse_args(arguments)
    preset = swimm3r.PRESETS["fast"]

    frames = swimm3r.read_frames(given.folder, preset.frames, folder=given.out / "prepare")
    print(f"{len(frames.train)} training frames and {len(frames.test)} test frames of {frames.width}x{frames.height}")

    while True:  # once as filmed, and once after each of the two rectifications
        try:
            rec = swimm3r.reconstruct(swimm3r.run_frames(given.out), preset.sfm, folder=given.out / "sfm")
            break
        except swimm3r.RectifiableError as error:
            swimm3r.rectify_run(given.out, error.rectification)
    frames = swimm3r.run_frames(given.out)
    print(f"{len(rec.names)} frames registered, {len(rec.points.xyz)} points")
    for warning in rec.warnings:
        print(f"Warning: {warning.what} {warning.advice}")
    if rec.medium is not None:
        print(f"beta_D {rec.medium.beta_D.tolist()}, determined: {rec.medium.identifiable['beta_D'].tolist()}")

    assert isinstance(preset.splat, swimm3r.UwbsSettings)
    settings = smaller(preset.splat, given.steps, given.primitives, given.long_side)
    scene = swimm3r.train(rec, frames, settings, folder=given.out / "splat")

    camera = rec.cameras[0].pinhole()
    view = scene.render(camera, time=frames.train.frames[0].time)
    write_rgb(given.out / "with_water.png", view.rgb.numpy())
    write_rgb(given.out / "without_water.png", view.clear.numpy())
    print(f"Map: {given.out / 'splat' / 'map.safetensors'}; views: with_water.png, without_water.png")


def smaller(settings: swimm3r.UwbsSettings, steps: int, primitives: int, long_side: int) -> swimm3r.UwbsSettings:
    """The settings at another length and size; half of the primitives are there from the start."""
    return replace(
        settings,
        iterations=steps,
        long_side=long_side,
        initial=replace(settings.initial, primitives=primitives // 2),
        densify=replace(settings.densify, cap_max=primitives),
    )


if __name__ == "__main__":
    main()
