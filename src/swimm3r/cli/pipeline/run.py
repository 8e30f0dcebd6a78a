"""`swimm3r run`: every stage, from a clip to the report page."""

from collections.abc import Callable
from typing import Annotated

from swimm3r.cli.pipeline.options import (
    HERE,
    Engine,
    FolderOptions,
    MapOptions,
    PoseOptions,
    ProductOptions,
    ViewOptions,
)
from swimm3r.cli.pipeline.stages import require_adapter, run_stages
from swimm3r.cli.survey.products import make_products
from swimm3r.cli.terminal.options import FLAT, Source
from swimm3r.pipeline.presets import RunSettings
from swimm3r.products.packages import require_packages
from swimm3r.scale.settings import ScaleSettings, resolved
from swimm3r.scene.run_folder import input_and_folder
from swimm3r.scene.settings import FrameSettings
from swimm3r.splat.settings import PoseRefinementSettings


def run_command(defaults: RunSettings) -> Callable:
    """The command, with these settings as the defaults of its options."""

    def run(
        source: Source,
        /,
        folder: Annotated[FolderOptions, FLAT] = FolderOptions(),  # noqa: B008 - records are frozen
        poses: Annotated[PoseOptions, FLAT] = PoseOptions(defaults.sfm.backend),  # noqa: B008
        map: Annotated[MapOptions, FLAT] = MapOptions(defaults.splat.recipe),  # noqa: B008
        page: Annotated[ViewOptions, FLAT] = ViewOptions(),  # noqa: B008
        products: Annotated[ProductOptions, FLAT] = ProductOptions(),  # noqa: B008
        engine: Engine = HERE,
        frames: Annotated[FrameSettings, FLAT] = defaults.frames,
        sfm: Annotated[type(defaults.sfm), FLAT] = defaults.sfm,
        splat: type(defaults.splat) = defaults.splat,
        test: PoseRefinementSettings = defaults.test,
        scale: Annotated[ScaleSettings, FLAT] = defaults.scale,
    ) -> None:
        """Everything, from a clip to the report page. Re-run the same command to resume, or swimm3r run RUN.

        Args:
            source: Video, or folder of images; or a run folder, to resume with its own input and settings.
        """
        require_adapter(poses.backend, sfm)
        if products.products:
            require_packages()
        settings = RunSettings(frames, sfm, splat, test, resolved(scale))
        run_stages(source, folder, settings, "eval", poses.reference, map.map_device, page, engine)
        if products.products:
            make_products(input_and_folder(source, folder.out)[1])

    return run
