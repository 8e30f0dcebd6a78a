"""`swimm3r bench scale`: cost and accuracy by the length of a survey."""

from collections.abc import Callable
from typing import Annotated

from swimm3r.bench.settings import SurveySettings
from swimm3r.cli.bench.table import Defaults, Frames, show_table
from swimm3r.cli.terminal.options import FLAT, Out
from swimm3r.pipeline.presets import Preset, RunSettings
from swimm3r.sfm.settings import ColmapSettings
from swimm3r.splat.settings import PoseRefinementSettings, UwbsSettings


def scale_command(defaults: Defaults) -> Callable:
    """The command, with the settings of a preset as defaults."""

    def scale(
        out: Out,
        surveys: Annotated[SurveySettings, FLAT] = SurveySettings(),  # noqa: B008 - records are frozen
        preset: Preset = defaults.preset,
        frames: Frames = defaults.frames,
        colmap: ColmapSettings = defaults.colmap,
        splat: UwbsSettings = defaults.splat,
        test: PoseRefinementSettings = defaults.test,
    ) -> None:
        """Run synthetic surveys of growing length: errors, processor seconds per frame of every part, memory.

        Args:
            out: Folder for surveys, runs and the tables scale.md, .csv, .json and .tex.
            surveys: Lengths and size of the surveys, and the last part to run.
            preset: Preset that supplies the other defaults.
            frames: Frames taken of a survey.
            colmap: Poses, depth and water.
            splat: Size and length of the maps.
            test: Refinement of the test frames' poses.
        """
        from swimm3r.bench.protocols.scale import scale_table

        settings = RunSettings(frames, colmap, splat, test)
        show_table(
            out,
            lambda progress: scale_table(out, surveys, settings, progress),
            defaults.label(preset, frames, colmap, splat, test),
        )

    return scale
