"""`swimm3r sfm`: poses, depth, medium and the restored cloud, without a map."""

from collections.abc import Callable
from dataclasses import replace
from typing import Annotated

from swimm3r.cli.pipeline.options import HERE, Engine, FolderOptions, PoseOptions
from swimm3r.cli.pipeline.stages import require_adapter, run_stages
from swimm3r.cli.terminal.options import FLAT, Source
from swimm3r.pipeline.presets import RunSettings
from swimm3r.scale.settings import ScaleSettings, resolved
from swimm3r.scene.settings import FrameSettings


def sfm_command(defaults: RunSettings) -> Callable:
    """The command, with these settings as the defaults of its options."""

    def sfm(
        source: Source,
        /,
        folder: Annotated[FolderOptions, FLAT] = FolderOptions(),  # noqa: B008 - records are frozen
        poses: Annotated[PoseOptions, FLAT] = PoseOptions(defaults.sfm.backend),  # noqa: B008
        engine: Engine = HERE,
        frames: Annotated[FrameSettings, FLAT] = defaults.frames,
        sfm: Annotated[type(defaults.sfm), FLAT] = defaults.sfm,
        scale: Annotated[ScaleSettings, FLAT] = defaults.scale,
    ) -> None:
        """Poses, dense depth, water, restored images and the restored cloud, without map and scores.

        Args:
            source: Video, or folder of images; or a run folder, to resume with its own input and settings.
        """
        require_adapter(poses.backend, sfm)
        settings = replace(defaults, frames=frames, sfm=sfm, scale=resolved(scale))
        run_stages(source, folder, settings, "sfm", poses.reference, engine=engine)

    return sfm
