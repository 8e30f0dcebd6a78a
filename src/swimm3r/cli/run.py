"""`swimm3r run`, `prepare`, `sfm` and `splat`: the pipeline, whole or up to a stage."""

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Annotated, Literal

from tyro.conf import Positional, arg

from swimm3r import weights
from swimm3r.cli.console import drawn_progress, print_summary
from swimm3r.errors import UsageError
from swimm3r.frame_settings import FrameSettings
from swimm3r.presets import MAST3R_PRESETS, PRESETS, RunSettings
from swimm3r.sfm.settings import ColmapModelSettings, ColmapSettings, Mast3rSettings, SfmSettings
from swimm3r.splat.settings import MapDevice, PoseRefinementSettings, Recipe, UwbsSettings, with_recipe

Preset = Literal["fast", "default", "best"]
Backend = Literal["colmap", "mast3r", "swimm3r"]
_FLAT = arg(name="")  # --fps, not --frames.fps; what lies deeper keeps its prefix: --depth.planes


def commands_for_preset(name: str, backend: str = "colmap", recipe: Recipe = "uwbs-static") -> dict[str, Callable]:
    """The commands that share the pipeline's settings, with the defaults of a preset, a back end and a recipe."""
    defaults = PRESETS[name]
    assert isinstance(defaults.splat, UwbsSettings)
    defaults = replace(defaults, splat=with_recipe(defaults.splat, recipe))
    assert isinstance(defaults.sfm, ColmapSettings)
    sfm_defaults = MAST3R_PRESETS[name] if backend != "colmap" else defaults.sfm
    sfm_settings = Annotated[type(sfm_defaults), _FLAT]
    map_settings = type(defaults.splat)

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
        _pipeline(source, out, RunSettings(frames, defaults.sfm, defaults.splat, defaults.test), None, "prepare")

    def sfm(
        source: Positional[Path],
        /,
        out: Path,
        preset: Preset = "default",
        backend: Backend = "colmap",
        reference: Path | None = None,
        frames: Annotated[FrameSettings, _FLAT] = defaults.frames,
        sfm: sfm_settings = sfm_defaults,
    ) -> None:
        """Poses, dense depth, water, restored pictures and the restored cloud, without map and scores.

        Args:
            source: a video, or a folder of pictures.
            out: the run folder.
            preset: what the other defaults aim at.
            backend: how poses and depth are found; mast3r needs weights, swimm3r an adapter, too. `--backend mast3r
                --help` shows its options.
            reference: a cameras.json with poses to compare with.
            frames: which frames to take.
            sfm: how poses, depth and water are found.
        """
        _require_adapter(backend, sfm)
        _pipeline(source, out, RunSettings(frames, sfm, defaults.splat, defaults.test), reference, "sfm")

    def splat(
        source: Positional[Path | None] = None,
        /,
        *,
        out: Path,
        colmap: Path | None = None,
        transforms: Path | None = None,
        images: Path | None = None,
        preset: Preset = "default",
        recipe: Recipe = "uwbs-static",
        map_device: MapDevice = "auto",
        reference: Path | None = None,
        frames: Annotated[FrameSettings, _FLAT] = defaults.frames,
        sfm: Annotated[ColmapSettings, _FLAT] = defaults.sfm,
        splat: map_settings = defaults.splat,
        test: PoseRefinementSettings = defaults.test,
    ) -> None:
        """A map of a dive, or of any COLMAP model: swimm3r splat --colmap sparse/0 --images pictures/ --out RUN.

        Args:
            source: a video, or a folder of pictures; or give --colmap and --images, or --transforms.
            out: the run folder.
            colmap: a COLMAP model (or cameras.xml, sfm_data.json, predictions.npz) taken as it is.
            transforms: nerfstudio's transforms.json, taken as it is.
            images: the pictures it was made of; its names are relative to this folder. Those that a transforms.json
                names are found without.
            preset: what the other defaults aim at.
            recipe: uwbs-static; uwbs-dynamic, whose map changes with time; or another method on the same start.
                `--recipe NAME --help` shows its options.
            map_device: where the map is trained and rendered; auto takes CUDA where there is a GPU and NVIDIA Warp.
            reference: a cameras.json with poses to compare with.
            frames: which frames to take.
            sfm: how poses, depth and water are found; with --colmap, depth and water alone.
            splat: how the map is trained.
            test: how the test frames' poses are refined.
        """
        if transforms is not None and images is None:
            from swimm3r.io.foreign.nerfstudio import pictures_folder

            images = pictures_folder(transforms)
        models = [model for model in (colmap, transforms) if model is not None]
        given = source or images
        if given is None or len(models) > 1 or (source is None) != (len(models) == 1) or (source and images):
            raise UsageError(
                "a map is trained on a source, on --colmap with --images, or on --transforms",
                cause="several of them were given, or one half of the pair is missing",
                hint="swimm3r splat dive.mp4 --out RUN, or swimm3r splat --colmap DIR --images DIR --out RUN",
            )
        poses = sfm
        if models:
            poses = ColmapModelSettings(
                models[0].resolve(), features=sfm.features, depth=sfm.depth, water=sfm.water, restore=sfm.restore
            )
        _pipeline(given, out, RunSettings(frames, poses, splat, test), reference, "eval", map_device)

    def run(
        source: Positional[Path],
        /,
        out: Path,
        preset: Preset = "default",
        backend: Backend = "colmap",
        recipe: Recipe = "uwbs-static",
        map_device: MapDevice = "auto",
        reference: Path | None = None,
        frames: Annotated[FrameSettings, _FLAT] = defaults.frames,
        sfm: sfm_settings = sfm_defaults,
        splat: map_settings = defaults.splat,
        test: PoseRefinementSettings = defaults.test,
    ) -> None:
        """Everything, from a clip to the report page. The same command again goes on where it was interrupted.

        Args:
            source: a video, or a folder of pictures.
            out: the run folder.
            preset: what the other defaults aim at.
            backend: how poses and depth are found; mast3r needs weights, swimm3r an adapter, too. `--backend mast3r
                --help` shows its options.
            recipe: uwbs-static; uwbs-dynamic, whose map changes with time; or another method on the same start.
                `--recipe NAME --help` shows its options.
            map_device: where the map is trained and rendered; auto takes CUDA where there is a GPU and NVIDIA Warp.
            reference: a cameras.json with poses to compare with.
            frames: which frames to take.
            sfm: how poses, depth and water are found.
            splat: how the map is trained.
            test: how the test frames' poses are refined.
        """
        _require_adapter(backend, sfm)
        _pipeline(source, out, RunSettings(frames, sfm, splat, test), reference, "eval", map_device)

    return {"run": run, "prepare": prepare, "sfm": sfm, "splat": splat}


def _require_adapter(backend: Backend, settings: SfmSettings) -> None:
    if backend == "swimm3r" and isinstance(settings, Mast3rSettings) and settings.adapter is None:
        raise UsageError(
            "--backend swimm3r needs --adapter FILE",
            cause="medium-aware structure from motion is MASt3R with a trained adapter, and none is published",
            hint="train one with swimm3r train-sfm; or --backend mast3r, which does without",
        )


def _pipeline(
    source: Path,
    out: Path,
    settings: RunSettings,
    reference: Path | None,
    last: str,
    map_device: MapDevice = "cpu",  # stages before the map ask for no GPU
) -> None:
    if isinstance(settings.sfm, Mast3rSettings):  # before minutes of preparing frames
        from swimm3r.sfm.pairs import parse_graph

        parse_graph(settings.sfm.graph)
        weights.require("mast3r", settings.sfm.weights)
        if settings.sfm.adapter is not None:
            from swimm3r.sfm import adapter_file

            adapter_file.describe(settings.sfm.adapter)
    from swimm3r.run import run_pipeline

    with drawn_progress() as progress:
        summary = run_pipeline(
            source, out, settings, reference=reference, last_stage=last, map_device=map_device, progress=progress
        )
    print_summary(summary, out)
