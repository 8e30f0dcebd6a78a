"""`swimm3r run`, `prepare`, `sfm` and `splat`: the pipeline, whole or up to a stage.

The defaults of the options are those of a preset that is named, else the settings that the run folder holds: a command
without settings goes on with them, and one with a few changes those alone.
"""

from collections.abc import Callable, Sequence
from itertools import pairwise
from pathlib import Path
from typing import Annotated, Literal

from tyro.conf import Positional, arg

from swimm3r.cli.terminal.console import drawn_progress, print_next, print_summary
from swimm3r.errors import UsageError
from swimm3r.pipeline.presets import Preset, RunSettings, from_yaml
from swimm3r.scene.run_folder import is_run, read_run
from swimm3r.scene.settings import FrameSettings
from swimm3r.sfm.settings import ColmapModelSettings, Mast3rSettings, SfmSettings
from swimm3r.splat.settings import MapDevice, PoseRefinementSettings, RecipeName, recipe_of

Backend = Literal["colmap", "mast3r", "swimm3r"]
_FLAT = arg(name="")  # --fps, not --frames.fps; what lies deeper keeps its prefix: --depth.planes


def held_settings(arguments: Sequence[str]) -> RunSettings | None:
    """The settings in the run folder that a command line names: after --out, else as its source. Raises InputError."""
    after_out = [after for option, after in pairwise(arguments) if option == "--out"]
    after_out += [word.removeprefix("--out=") for word in arguments if word.startswith("--out=")]
    folders = after_out or [word for word in arguments[1:] if not word.startswith("-")]
    path = next((Path(folder) / "settings.yaml" for folder in folders if is_run(Path(folder))), None)
    return from_yaml(path) if path is not None and path.is_file() else None


def commands_for_settings(defaults: RunSettings) -> dict[str, Callable]:
    """The commands that share the pipeline's settings, with these as the defaults of their options."""
    sfm_defaults, default_recipe = defaults.sfm, recipe_of(defaults.splat)
    default_backend: Backend = "mast3r" if isinstance(sfm_defaults, Mast3rSettings) else "colmap"
    sfm_settings = Annotated[type(sfm_defaults), _FLAT]
    map_settings = type(defaults.splat)

    def prepare(
        source: Positional[Path],
        /,
        out: Path | None = None,
        preset: Preset | None = None,
        redo: bool = False,
        frames: Annotated[FrameSettings, _FLAT] = defaults.frames,
    ) -> None:
        """Sample a video or check a folder of stills into RUN/prepare.

        Args:
            source: a video, or a folder of images; or a run folder, to go on with its own input and settings.
            out: the run folder; not needed where SOURCE is one.
            preset: preset that supplies the other defaults; otherwise the run folder's own settings do, where it has
                any, else `default`.
            redo: make stages again that were made with other settings; what is there moves to RUN/old.
            frames: which frames to take.
        """
        _pipeline(source, out, RunSettings(frames, defaults.sfm, defaults.splat, defaults.test), None, "prepare", redo)

    def sfm(
        source: Positional[Path],
        /,
        out: Path | None = None,
        preset: Preset | None = None,
        redo: bool = False,
        backend: Backend = default_backend,
        reference: Path | None = None,
        frames: Annotated[FrameSettings, _FLAT] = defaults.frames,
        sfm: sfm_settings = sfm_defaults,
    ) -> None:
        """Poses, dense depth, water, restored images and the restored cloud, without map and scores.

        Args:
            source: a video, or a folder of images; or a run folder, to go on with its own input and settings.
            out: the run folder; not needed where SOURCE is one.
            preset: preset that supplies the other defaults; otherwise the run folder's own settings do, where it has
                any, else `default`.
            redo: make stages again that were made with other settings; what is there moves to RUN/old.
            backend: how poses and depth are found; mast3r needs weights, swimm3r an adapter, too. `--backend mast3r
                --help` shows its options.
            reference: a cameras.json with poses to compare with.
            frames: which frames to take.
            sfm: how poses, depth and water are found.
        """
        _require_adapter(backend, sfm)
        _pipeline(source, out, RunSettings(frames, sfm, defaults.splat, defaults.test), reference, "sfm", redo)

    def splat(
        source: Positional[Path | None] = None,
        /,
        *,
        out: Path | None = None,
        colmap: Path | None = None,
        transforms: Path | None = None,
        images: Path | None = None,
        preset: Preset | None = None,
        redo: bool = False,
        recipe: RecipeName = default_recipe,
        map_device: MapDevice = "auto",
        reference: Path | None = None,
        frames: Annotated[FrameSettings, _FLAT] = defaults.frames,
        sfm: sfm_settings = sfm_defaults,
        splat: map_settings = defaults.splat,
        test: PoseRefinementSettings = defaults.test,
    ) -> None:
        """A map of a dive, or of any COLMAP model: swimm3r splat --colmap sparse/0 --images images/ --out RUN.

        Args:
            source: a video, or a folder of images; or a run folder, to go on with its own input and settings; or
                give --colmap and --images, or --transforms.
            out: the run folder; not needed where SOURCE is one.
            colmap: a COLMAP model (or cameras.xml, sfm_data.json, predictions.npz) taken as it is.
            transforms: nerfstudio's transforms.json, taken as it is.
            images: the images it was made of; its names are relative to this folder. Those that a transforms.json
                names are found without.
            preset: preset that supplies the other defaults; otherwise the run folder's own settings do, where it has
                any, else `default`.
            redo: make stages again that were made with other settings; what is there moves to RUN/old.
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
            from swimm3r.io.imports.nerfstudio import images_folder

            images = images_folder(transforms)
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
            poses = _on_model(models[0].resolve(), sfm)
        _pipeline(given, out, RunSettings(frames, poses, splat, test), reference, "eval", redo, map_device)

    def run(
        source: Positional[Path],
        /,
        out: Path | None = None,
        preset: Preset | None = None,
        redo: bool = False,
        backend: Backend = default_backend,
        recipe: RecipeName = default_recipe,
        map_device: MapDevice = "auto",
        reference: Path | None = None,
        frames: Annotated[FrameSettings, _FLAT] = defaults.frames,
        sfm: sfm_settings = sfm_defaults,
        splat: map_settings = defaults.splat,
        test: PoseRefinementSettings = defaults.test,
    ) -> None:
        """Everything, from a clip to the report page. Re-run the same command to resume, or swimm3r run RUN.

        Args:
            source: a video, or a folder of images; or a run folder, to go on with its own input and settings.
            out: the run folder; not needed where SOURCE is one.
            preset: preset that supplies the other defaults; otherwise the run folder's own settings do, where it has
                any, else `default`.
            redo: make stages again that were made with other settings; what is there moves to RUN/old.
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
        _pipeline(source, out, RunSettings(frames, sfm, splat, test), reference, "eval", redo, map_device)

    return {"run": run, "prepare": prepare, "sfm": sfm, "splat": splat}


def _require_adapter(backend: Backend, settings: SfmSettings) -> None:
    if backend == "swimm3r" and isinstance(settings, Mast3rSettings) and settings.adapter is None:
        raise UsageError(
            "--backend swimm3r needs --adapter FILE",
            cause="medium-aware structure from motion is MASt3R with a trained adapter, and none is published",
            hint="train one with swimm3r train-sfm; or --backend mast3r, which does without",
        )


def _on_model(model: Path, like: SfmSettings) -> ColmapModelSettings:
    """The poses of a model, with depth and water as settings have them."""
    kept = {name: getattr(like, name) for name in ("features", "depth", "water", "restore") if hasattr(like, name)}
    return ColmapModelSettings(model, **kept)


def _pipeline(
    source: Path,
    out: Path | None,
    settings: RunSettings,
    reference: Path | None,
    last: str,
    redo: bool,
    map_device: MapDevice = "cpu",  # stages before the map ask for no GPU
) -> None:
    if out is None:
        if not is_run(source):
            raise UsageError(
                "--out RUN is missing",
                cause=f"{source} is no run folder, which could go on without it",
                hint="--out with a folder that does not exist yet",
            )
        source, out = Path(read_run(source).input.path), source
    from swimm3r.pipeline.run import run_pipeline

    with drawn_progress() as progress:
        summary = run_pipeline(
            source,
            out,
            settings,
            redo=redo,
            reference=reference,
            last_stage=last,
            map_device=map_device,
            progress=progress,
        )
    print_summary(summary, out)
    match last:
        case "prepare":
            print(f"Frames: {out / 'prepare'}")
            print_next("poses, depth and water", "sfm", source, "--out", out)
        case "sfm":
            print(f"Results: {out / 'sfm'}: points.ply (restored cloud), cameras.json (poses), medium.json, restored/")
            print_next("the map, scores and report", "run", source, "--out", out)
        case _:
            print_next("other views of the map", "render", out)
