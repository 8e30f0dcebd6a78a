"""`swimm3r bench render`: recipes compared on the same structure from motion."""

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

from tyro.conf import Positional, arg

from swimm3r.bench.settings import Seeds
from swimm3r.cli.bench.table import ONE_BY_ONE, Defaults, Frames, Jobs, show_table
from swimm3r.cli.terminal.options import FLAT, Out
from swimm3r.pipeline.presets import Preset, RunSettings
from swimm3r.sfm.settings import ColmapSettings
from swimm3r.splat.settings import RECIPES, PoseRefinementSettings, RecipeName, UwbsSettings


@dataclass(frozen=True)
class Comparison:
    """The renderers that are compared, and the poses that they start from."""

    recipes: tuple[RecipeName, ...] = RECIPES
    """Renderers to compare."""
    poses: bool = False
    """Add every recipe again with the training poses refined along with the map."""
    given_poses: bool = False
    """Clips are folders of images with a COLMAP model, whose poses are used."""
    against: RecipeName | None = None
    """Recipe that differences are taken from; the first one by default."""
    references: Path | None = None
    """Folder with CLIP.json (a cameras.json) of all frames of each clip, test frames included. By default COLMAP
    finds their poses."""


def render_command(defaults: Defaults) -> Callable:
    """The command, with the settings of a preset as defaults."""

    def render(
        inputs: Positional[
            Annotated[tuple[Path, ...], arg(metavar="INPUT [INPUT ...]", help_behavior_hint="(one or more)")]
        ],
        /,
        out: Out,
        seeds: Seeds = 1,
        preset: Preset = defaults.preset,
        comparison: Annotated[Comparison, FLAT] = Comparison(),
        frames: Frames = defaults.frames,
        sfm: Annotated[ColmapSettings, FLAT] = defaults.colmap,
        splat: UwbsSettings = defaults.splat,
        test: PoseRefinementSettings = defaults.test,
        jobs: Jobs = ONE_BY_ONE,
    ) -> None:
        """Train every recipe on every clip's structure from motion and compare how they show the test frames.

        Args:
            inputs: Run folders with finished structure from motion, which are only read; or clips, of which runs are
                made in OUT/runs. Runs of one clip whose poses were found in different ways are rows of one table.
            out: Folder for maps, scores, images side by side and the tables render.md, .csv, .json and .tex.
            seeds: Number of trainings of each recipe on each run.
            preset: Preset that supplies the other defaults.
            frames: Frames taken of clips; the paper's are evenly spaced.
            sfm: Poses, depth and water of clips.
            splat: Size and length of the maps; a recipe changes what makes it another method.
            test: Refinement of the test frames' poses.
            jobs: Scenes computed in parallel.
        """
        from swimm3r.bench.protocols.render import compare_on_clips

        settings, c = RunSettings(frames, sfm, splat, test), comparison
        show_table(
            out,
            lambda progress: compare_on_clips(
                inputs,
                out,
                settings,
                c.recipes,
                seeds=seeds,
                poses=c.poses,
                given_poses=c.given_poses,
                against=c.against,
                references=c.references,
                how=jobs,
                progress=progress,
            ),
            defaults.label(preset, frames, sfm, splat, test),
        )

    return render
