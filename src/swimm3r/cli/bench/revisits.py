"""`swimm3r bench revisits`: changes between repeat visits, against the truth."""

from collections.abc import Callable
from typing import Annotated

from swimm3r.bench.settings import RevisitSettings
from swimm3r.cli.bench.table import Defaults, Frames, show_table
from swimm3r.cli.terminal.options import FLAT, Out
from swimm3r.pipeline.presets import Preset, RunSettings
from swimm3r.sfm.settings import ColmapSettings


def revisits_command(defaults: Defaults) -> Callable:
    """The command, with the settings of a preset as defaults."""

    def revisits(
        out: Out,
        visits: Annotated[RevisitSettings, FLAT] = RevisitSettings(),  # noqa: B008 - records are frozen
        preset: Preset = defaults.preset,
        frames: Frames = defaults.frames,
        colmap: ColmapSettings = defaults.colmap,
    ) -> None:
        """Compare synthetic repeat visits, in pairs of waters, with the truth: alignment, changes, volume, bleaching.

        Args:
            out: Folder for dives, runs and the table.
            visits: Number and size of the visits.
            preset: Preset that supplies the other defaults.
            frames: Frames taken of a dive.
            colmap: Poses, depth and water.
        """
        from swimm3r.bench.protocols.revisits import revisit_table

        settings = RunSettings(frames, colmap, defaults.splat, defaults.test)
        show_table(
            out,
            lambda progress: revisit_table(out, visits, settings, progress),
            defaults.label(preset, frames, colmap),
        )

    return revisits
