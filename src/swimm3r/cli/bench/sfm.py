"""`swimm3r bench sfm`: structure from motion by every method."""

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Annotated

from tyro.conf import Positional, arg

from swimm3r.cli.bench.table import ALL_METHODS, ONE_BY_ONE, Defaults, Frames, Jobs, Methods, show_table
from swimm3r.cli.terminal.options import Out
from swimm3r.pipeline.presets import Preset, RunSettings
from swimm3r.sfm.settings import ColmapSettings, Mast3rSettings


def sfm_command(defaults: Defaults) -> Callable:
    """The command, with the settings of a preset as defaults."""

    def sfm(
        clips: Positional[
            Annotated[tuple[Path, ...], arg(metavar="CLIP [CLIP ...]", help_behavior_hint="(one or more)")]
        ],
        /,
        out: Out,
        given: Methods = ALL_METHODS,
        references: Path | None = None,
        preset: Preset = defaults.preset,
        frames: Frames = replace(defaults.frames, long_side=0),  # noqa: B008 - records are frozen
        colmap: ColmapSettings = defaults.colmap,
        mast3r: Mast3rSettings = defaults.mast3r,
        jobs: Jobs = ONE_BY_ONE,
    ) -> None:
        """Structure from motion of clips by every method: registration, epipolar error, inliers, points, clouds.

        Methods whose weights, adapters or models are missing are reported as not run.

        Args:
            clips: Videos or folders of images.
            out: Folder for the methods' runs, images of the clouds and the tables sfm.md, .csv, .json and .tex.
            given: Methods to compare, and their files.
            references: Folder with NAME.json (a cameras.json) of clips whose poses are known; synthetic dives bring
                their own.
            preset: Preset that supplies the other defaults.
            frames: Frames taken of clips; the paper's are evenly spaced and of their own size.
            colmap: COLMAP's settings, and depth, water and cloud of all methods without a network.
            mast3r: Settings of the methods that use the network.
            jobs: Clips computed in parallel.
        """
        from swimm3r.bench.protocols.sfm import compare_sfm

        settings = RunSettings(frames, colmap, defaults.splat, defaults.test)
        show_table(
            out,
            lambda progress: compare_sfm(clips, out, given, settings, mast3r, references, jobs, progress),
            defaults.label(preset, frames, colmap, mast3r),
        )

    return sfm
