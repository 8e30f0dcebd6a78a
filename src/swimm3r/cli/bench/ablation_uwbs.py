"""`swimm3r bench ablation-uwbs`: the map without its parts."""

from collections.abc import Callable

from swimm3r.bench.settings import Seeds
from swimm3r.cli.bench.table import ONE_BY_ONE, Defaults, Jobs, show_table
from swimm3r.cli.terminal.options import Out, Runs
from swimm3r.pipeline.presets import Preset
from swimm3r.splat.settings import PoseRefinementSettings, UwbsSettings


def ablation_uwbs_command(defaults: Defaults) -> Callable:
    """The command, with the map settings of a preset as defaults."""

    def ablation_uwbs(
        runs: Runs,
        /,
        out: Out,
        seeds: Seeds = 3,
        preset: Preset = defaults.preset,
        splat: UwbsSettings = defaults.splat,
        test: PoseRefinementSettings = defaults.test,
        jobs: Jobs = ONE_BY_ONE,
    ) -> None:
        """Train the map without its parts, several seeds each: baseline, + SGG, + depth, full.

        Args:
            runs: Run folders with finished structure from motion; they are only read.
            out: Folder for maps, scores and the tables ablation.md, .csv, .json and .tex.
            seeds: Number of trainings of each variant on each run.
            preset: Preset that supplies the other defaults.
            splat: Training of the full variant; each other variant leaves a part out.
            test: Refinement of the test frames' poses.
            jobs: Scenes computed in parallel.
        """
        from swimm3r.bench.protocols.ablation_uwbs import ablate

        label = defaults.label(preset, splat, test)
        show_table(out, lambda progress: ablate(runs, out, splat, seeds, test, jobs, progress), label)

    return ablation_uwbs
