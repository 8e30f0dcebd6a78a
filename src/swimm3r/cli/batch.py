"""`swimm3r batch`: many dives, each a run of its own, with one table and one page of results."""

from collections.abc import Callable
from pathlib import Path
from typing import Annotated, Literal

from tyro.conf import Positional, arg

from swimm3r.cli.pipeline.options import HERE, Engine, MapOptions, OriginOptions, PoseOptions
from swimm3r.cli.pipeline.stages import require_adapter
from swimm3r.cli.terminal.console import drawn_progress, outcome_console, print_line, print_results
from swimm3r.cli.terminal.options import FLAT, Out
from swimm3r.pipeline.presets import RunSettings
from swimm3r.scale.settings import ScaleSettings, resolved
from swimm3r.scene.settings import FrameSettings
from swimm3r.splat.settings import PoseRefinementSettings

Dives = Positional[Annotated[tuple[Path, ...], arg(metavar="DIVE [DIVE ...]", help_behavior_hint="(one or more)")]]
LastStage = Literal["prepare", "sfm", "splat", "eval"]
RESULTS = {
    "results.html": "every dive with a frame, its scores and its warnings",
    "results.csv": "the same numbers as a table",
    "logs": "messages of each dive",
}


def batch_command(defaults: RunSettings) -> Callable:
    """The command, with these settings as the defaults of its options."""

    def batch(
        dives: Dives,
        /,
        out: Out,
        last_stage: LastStage = "eval",
        origin: Annotated[OriginOptions, FLAT] = OriginOptions(),  # noqa: B008 - records are frozen
        engine: Engine = HERE,
        poses: Annotated[PoseOptions, FLAT] = PoseOptions(defaults.sfm.backend),  # noqa: B008
        map: Annotated[MapOptions, FLAT] = MapOptions(defaults.splat.recipe),  # noqa: B008
        frames: Annotated[FrameSettings, FLAT] = defaults.frames,
        sfm: Annotated[type(defaults.sfm), FLAT] = defaults.sfm,
        splat: type(defaults.splat) = defaults.splat,
        test: PoseRefinementSettings = defaults.test,
        scale: Annotated[ScaleSettings, FLAT] = defaults.scale,
    ) -> None:
        """Many dives, each with all stages in OUT/NAME. Re-run the same command to resume and to retry what failed.

        Args:
            dives: Videos, folders of images, folders or patterns of such, or a CSV table with a column `dive` and
                settings of each dive in the others.
            out: Folder that receives a run folder per dive, results.csv, results.html and logs.
            last_stage: Stage to stop after: prepare, sfm, splat or eval.
        """
        require_adapter(poses.backend, sfm)
        from swimm3r.batch.dives import find_dives
        from swimm3r.batch.run import check_outcome, run_batch

        found = find_dives(dives, RunSettings(frames, sfm, splat, test, resolved(scale)), out, poses.reference)
        for one in found.skipped:
            print_line(f"left out: {one.path} ({one.reason})")
        with drawn_progress() as progress:
            rows = run_batch(
                found,
                out,
                engine,
                redo=origin.redo,
                last_stage=last_stage,
                map_device=map.map_device,
                progress=progress,
                on_end=lambda row: print_line(f"{row.name}: {row.error or row.status}"),
            )
        console = outcome_console()
        for row in rows:
            score = "" if row.psnr is None else f", {row.psnr:.1f} dB"
            placed = "" if row.registered is None else f", {row.registered} frames placed"
            console.print(f"{row.name}: {row.status}{placed}{score}", soft_wrap=True)
        print_results(out, RESULTS)
        check_outcome(rows, out)

    return batch
