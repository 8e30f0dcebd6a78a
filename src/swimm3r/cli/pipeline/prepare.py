"""`swimm3r prepare`: the frames that a run works on."""

from collections.abc import Callable
from dataclasses import replace
from typing import Annotated

from swimm3r.cli.pipeline.options import FolderOptions
from swimm3r.cli.pipeline.stages import run_stages
from swimm3r.cli.terminal.options import FLAT, Source
from swimm3r.pipeline.presets import RunSettings
from swimm3r.scene.settings import FrameSettings


def prepare_command(defaults: RunSettings) -> Callable:
    """The command, with these settings as the defaults of its options."""

    def prepare(
        source: Source,
        /,
        folder: Annotated[FolderOptions, FLAT] = FolderOptions(),  # noqa: B008 - records are frozen
        frames: Annotated[FrameSettings, FLAT] = defaults.frames,
    ) -> None:
        """Sample a video or check a folder of images into RUN/prepare.

        Args:
            source: Video, or folder of images; or a run folder, to resume with its own input and settings.
        """
        run_stages(source, folder, replace(defaults, frames=frames), "prepare")

    return prepare
