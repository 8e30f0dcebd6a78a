"""`swimm3r train-sfm`: distils the frozen network into a low-rank student that sees through water."""

import os
import sys
from collections.abc import Callable
from contextlib import nullcontext
from pathlib import Path
from typing import Annotated, Literal

from tyro.conf import Positional, arg

from swimm3r.cli.terminal.console import drawn_progress, print_next
from swimm3r.sfm.distillation.settings import RECIPES, TrainSettings

TrainingRecipeName = Literal[
    "swimm3r",
    "without-forward",
    "without-inverse",
    "without-saturation",
    "without-augmentation",
    "distillation-only",
    "dark3r",
]


def command_for_recipe(name: str) -> Callable:
    """The command, with the defaults of a recipe."""

    def train_sfm(
        data: Positional[Path],
        /,
        out: Path,
        weights: Path | None = None,
        base_license: str | None = None,
        recipe: TrainingRecipeName = "swimm3r",
        device: Literal["auto", "cpu", "cuda"] = "auto",
        settings: Annotated[TrainSettings, arg(name="")] = RECIPES[name],
    ) -> None:
        """Train adapters and physics head on pairs of raw and clean images. The same command again goes on.

        Under torchrun every process takes its share of each batch.

        Args:
            data: a folder of data sets (swimm3r datasets shows what it holds).
            out: the training's folder; OUT/adapter.safetensors is the result.
            weights: the base checkpoint; by default the MASt3R weights of this computer.
            base_license: the base checkpoint's license, where it is not one that Swimm3R knows.
            recipe: what the other defaults aim at: the paper's system, one of its ablations, or Dark3R.
            device: where the network runs.
            settings: every number of the training.
        """
        from swimm3r.io.files.folder_lock import folder_lock
        from swimm3r.io.files.outputs import output_folder
        from swimm3r.sfm.distillation.loop import Estimate
        from swimm3r.sfm.distillation.train import train_sfm as run

        def announce(e: Estimate) -> None:
            memory = "" if e.peak_mb is None else f", {e.peak_mb:.0f} MB"
            print(
                f"{e.pairs} pairs, {e.steps} steps, {e.trained:,} trained numbers; "
                f"about {e.seconds_per_step:.3g} s per step, {e.hours:.2g} h in all{memory}",
                file=sys.stderr,
            )

        # of torchrun's processes the first holds the folder for all
        hold = folder_lock(out) if os.environ.get("RANK", "0") == "0" else nullcontext()
        with output_folder(out), hold, drawn_progress() as progress:
            adapter = run(data, out, settings, weights, base_license, device, announce, progress)
        if os.environ.get("RANK", "0") == "0":  # torchrun's other processes have the same to say
            print(f"Adapter: {adapter}")
            print_next("poses with it", "sfm", "dive.mp4", "--out", "RUN", "--backend", "swimm3r", "--adapter", adapter)

    return train_sfm
