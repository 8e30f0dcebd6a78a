"""`swimm3r run`, `prepare` and `sfm`: the pipeline, whole or up to a stage."""

from collections.abc import Callable
from pathlib import Path
from typing import Annotated, Literal

from tyro.conf import Positional, arg

from swimm3r.cli.console import drawn_progress, print_summary
from swimm3r.frame_settings import FrameSettings
from swimm3r.presets import PRESETS, RunSettings
from swimm3r.sfm.settings import ColmapSettings

Preset = Literal["fast", "default", "best"]
_FLAT = arg(name="")  # --fps, not --frames.fps; what lies deeper keeps its prefix: --depth.planes


def commands_for_preset(name: str) -> dict[str, Callable]:
    """The commands that share the pipeline's settings, with the defaults of a preset."""
    defaults = PRESETS[name]

    def prepare(
        source: Positional[Path],
        /,
        out: Path,
        preset: Preset = "default",
        frames: Annotated[FrameSettings, _FLAT] = defaults.frames,
    ) -> None:
        """Sample a video or check a folder of stills into RUN/prepare.

        Args:
            source: a video, or a folder of pictures.
            out: the run folder.
            preset: what the other defaults aim at.
            frames: which frames to take.
        """
        _pipeline(source, out, RunSettings(frames=frames, sfm=defaults.sfm), None, "prepare")

    def sfm(
        source: Positional[Path],
        /,
        out: Path,
        preset: Preset = "default",
        reference: Path | None = None,
        frames: Annotated[FrameSettings, _FLAT] = defaults.frames,
        sfm: Annotated[ColmapSettings, _FLAT] = defaults.sfm,
    ) -> None:
        """Poses, dense depth, water, restored pictures and the restored cloud, without the scores.

        Args:
            source: a video, or a folder of pictures.
            out: the run folder.
            preset: what the other defaults aim at.
            reference: a cameras.json with poses to compare with.
            frames: which frames to take.
            sfm: how poses, depth and water are found.
        """
        _pipeline(source, out, RunSettings(frames=frames, sfm=sfm), reference, "sfm")

    def run(
        source: Positional[Path],
        /,
        out: Path,
        preset: Preset = "default",
        reference: Path | None = None,
        frames: Annotated[FrameSettings, _FLAT] = defaults.frames,
        sfm: Annotated[ColmapSettings, _FLAT] = defaults.sfm,
    ) -> None:
        """Everything, from a clip to the report page. The same command again goes on where it was interrupted.

        Args:
            source: a video, or a folder of pictures.
            out: the run folder.
            preset: what the other defaults aim at.
            reference: a cameras.json with poses to compare with.
            frames: which frames to take.
            sfm: how poses, depth and water are found.
        """
        _pipeline(source, out, RunSettings(frames=frames, sfm=sfm), reference, "eval")

    return {"run": run, "prepare": prepare, "sfm": sfm}


def _pipeline(source: Path, out: Path, settings: RunSettings, reference: Path | None, last: str) -> None:
    from swimm3r.run import run_pipeline

    with drawn_progress() as progress:
        summary = run_pipeline(source, out, settings, reference=reference, last_stage=last, progress=progress)
    print_summary(summary, out)
