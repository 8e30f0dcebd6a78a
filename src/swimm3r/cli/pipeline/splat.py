"""`swimm3r splat`: a map of a dive, or of poses that another program found."""

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

from tyro.conf import Positional, arg

from swimm3r.cli.pipeline.options import HERE, Engine, FolderOptions, MapOptions, ViewOptions
from swimm3r.cli.pipeline.stages import run_stages
from swimm3r.cli.terminal.options import FLAT
from swimm3r.errors import UsageError
from swimm3r.pipeline.presets import RunSettings
from swimm3r.pipeline.run_settings import with_poses_of
from swimm3r.scene.settings import FrameSettings
from swimm3r.splat.settings import PoseRefinementSettings


@dataclass(frozen=True)
class ModelOptions:
    """Poses that another program found, used as they are."""

    colmap: Path | None = None
    """COLMAP model, or the cameras.xml, sfm_data.json or predictions.npz of another program."""
    transforms: Path | None = None
    """File transforms.json of nerfstudio."""
    images: Path | None = None
    """Folder of the model's images; optional with --transforms, which names them."""
    reference: Path | None = None
    """File cameras.json with known poses to score the result against."""


def splat_command(defaults: RunSettings) -> Callable:
    """The command, with these settings as the defaults of its options."""

    def splat(
        source: Positional[Annotated[Path | None, arg(metavar="[SOURCE]")]] = None,
        /,
        folder: Annotated[FolderOptions, FLAT] = FolderOptions(),  # noqa: B008 - records are frozen
        model: Annotated[ModelOptions, FLAT] = ModelOptions(),
        map: Annotated[MapOptions, FLAT] = MapOptions(defaults.splat.recipe),  # noqa: B008
        page: Annotated[ViewOptions, FLAT] = ViewOptions(),  # noqa: B008
        engine: Engine = HERE,
        frames: Annotated[FrameSettings, FLAT] = defaults.frames,
        sfm: Annotated[type(defaults.sfm), FLAT] = defaults.sfm,
        splat: type(defaults.splat) = defaults.splat,
        test: PoseRefinementSettings = defaults.test,
    ) -> None:
        """A map of a dive, or of any COLMAP model: swimm3r splat --colmap sparse/0 --images DIR --out RUN.

        Args:
            source: Video, folder of images or run folder; instead, give --colmap and --images, or --transforms.
        """
        given, poses = _input(source, model)
        found = sfm if poses is None else with_poses_of(poses, sfm)
        settings = RunSettings(frames, found, splat, test, defaults.scale)
        run_stages(given, folder, settings, "eval", model.reference, map.map_device, page, engine)

    return splat


def _input(source: Path | None, given: ModelOptions) -> tuple[Path, Path | None]:
    """The images and the model of a command line. Raises UsageError where it names none, or more than one."""
    images = given.images
    if given.transforms is not None and images is None:
        from swimm3r.io.imports.nerfstudio import images_folder

        images = images_folder(given.transforms)
    models = [model for model in (given.colmap, given.transforms) if model is not None]
    found = source or images
    if found is None or len(models) > 1 or (source is None) != (len(models) == 1) or (source and images):
        raise UsageError(
            "a map is trained on a source, on --colmap with --images, or on --transforms",
            cause="several of them were given, or one half of the pair is missing",
            hint="swimm3r splat dive.mp4 --out RUN, or swimm3r splat --colmap DIR --images DIR --out RUN",
        )
    return found, models[0] if models else None
