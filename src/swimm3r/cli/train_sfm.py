"""`swimm3r train-sfm`: distils the frozen network into a low-rank student that sees through water."""

import os
import sys
from collections.abc import Callable
from contextlib import nullcontext
from pathlib import Path
from typing import Annotated, Literal

from swimm3r.cli.terminal.console import drawn_progress, print_next
from swimm3r.cli.terminal.options import FLAT, DataRoot, Out
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


def train_sfm_command(name: str) -> Callable:
    """The command, with the defaults of a recipe."""

    def train_sfm(
        data: DataRoot,
        /,
        out: Out,
        weights: Path | None = None,
        base_license: str | None = None,
        recipe: TrainingRecipeName = "swimm3r",
        device: Literal["auto", "cpu", "cuda"] = "auto",
        settings: Annotated[TrainSettings, FLAT] = RECIPES[name],
    ) -> None:
        """Train adapters and physics head on pairs of raw and clean images. Re-run the same command to resume.

        Under torchrun every process takes its share of each batch.

        Args:
            data: Folder of data sets; `swimm3r datasets` lists its contents.
            out: Folder of the training; the result is OUT/adapter.safetensors.
            weights: Base checkpoint (.pth or .safetensors); by default the one `swimm3r weights path mast3r` prints.
            base_license: License of the base checkpoint, if Swimm3R does not know it.
            recipe: Recipe that supplies the other defaults: the paper's system, one of its ablations, or Dark3R.
            device: Device that the network runs on; auto uses CUDA if a GPU is present.
            settings: Settings of the training.
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
