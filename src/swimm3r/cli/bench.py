"""`swimm3r bench`: the paper's protocols over finished runs."""

from collections.abc import Callable
from pathlib import Path
from typing import Literal

from tyro.conf import Positional

from swimm3r.cli.console import drawn_progress
from swimm3r.presets import PRESETS
from swimm3r.splat.settings import PoseRefinementSettings, UwbsSettings


def command_for_preset(name: str) -> Callable:
    """The command, with the map settings of a preset as defaults."""
    defaults = PRESETS[name]

    def bench(
        protocol: Positional[Literal["ablation-uwbs"]],
        runs: Positional[tuple[Path, ...]],
        /,
        out: Path,
        seeds: int = 3,
        preset: Literal["fast", "default", "best"] = "fast",
        splat: UwbsSettings = defaults.splat,
        test: PoseRefinementSettings = defaults.test,
    ) -> None:
        """Train variants of the map on finished runs, several seeds each, and compare. The same command goes on.

        Args:
            protocol: ablation-uwbs trains baseline, + SGG, + depth and full.
            runs: run folders with finished structure from motion; they are only read.
            out: where maps, scores and the tables go: ablation.md, .csv and .json.
            seeds: trainings of each variant on each run.
            preset: what the other defaults aim at.
            splat: how the full variant is trained; the others are it without a part.
            test: how the test frames' poses are refined.
        """
        from swimm3r.bench import statistics
        from swimm3r.bench.ablation import ablate

        with drawn_progress() as progress:
            cells = ablate(runs, out, splat, seeds, test, progress)
        statistics.write_tables(out, cells)
        print(statistics.table(cells))

    return bench
