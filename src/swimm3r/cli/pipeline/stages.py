"""The pipeline run from the command line: starting settings, progress, outcome, and the next command.

The defaults of the options are those of a preset or a settings file that is named, else the settings that the run
folder holds: a command without settings resumes with them, and one with a few changes those alone.
"""

from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from swimm3r.cli.pipeline.options import FolderOptions, ViewOptions
from swimm3r.cli.terminal.arguments import named, values_of
from swimm3r.cli.terminal.console import Drawn, drawn_progress, print_line, print_next, print_results
from swimm3r.cli.terminal.summary import print_summary
from swimm3r.errors import UsageError
from swimm3r.pipeline.presets import PRESETS, RunSettings, from_yaml, read_config
from swimm3r.pipeline.run_settings import starting_settings
from swimm3r.progress import Progress
from swimm3r.scene.run_folder import input_and_folder, is_run
from swimm3r.sfm.settings import BackendName, Mast3rSettings, SfmSettings
from swimm3r.splat.settings import RECIPES, MapDevice
from swimm3r.tasks.settings import EngineSettings
from swimm3r.viewer.settings import ViewerSettings

RESULTS = {  # of the stages, as far as the folder holds them
    "report.html": "all results on one page",
    "summary.json": "every number of the run, for scripts",
    "prepare": "frames as they are used",
    "sfm/points.ply": "restored point cloud, white-balanced; as filmed and physical beside it",
    "sfm/cameras.json": "camera poses; also as a COLMAP model in sfm/sparse",
    "sfm/medium.json": "parameters of the water",
    "sfm/restored": "frames with the water removed",
    "splat/map.safetensors": "splatting map",
    "renders/test": "test frames as the map renders them",
    "renders/flythrough.mp4": "flight along the path of the camera",
}
_OF_STAGE = {"prepare": ("prepare",), "sfm": ("sfm", "summary.json"), "eval": ("",)}  # beginnings of the above


def starting_point(arguments: Sequence[str]) -> RunSettings:
    """The defaults of the options of a command line. Raises InputError and UsageError for files that it names."""
    preset = named("--preset", arguments, PRESETS)
    files = values_of("--config", arguments)
    if preset is not None and files:
        raise UsageError(
            "--preset and --config exclude each other",
            cause="each supplies the defaults of all other options",
            hint="one of them, and single settings as options beside it",
        )
    held = read_config(Path(files[-1])) if files else None if preset else _held_settings(arguments)
    return starting_settings(
        preset,
        named("--backend", arguments, ("colmap", "mast3r", "swimm3r")),
        named("--recipe", arguments, RECIPES),
        held,
    )


def _held_settings(arguments: Sequence[str]) -> RunSettings | None:
    """The settings in the run folder that a command line names: after --out, else as its source."""
    folders = values_of("--out", arguments, "-o") or [word for word in arguments[1:] if not word.startswith("-")]
    path = next((Path(folder) / "settings.yaml" for folder in folders if is_run(Path(folder))), None)
    return from_yaml(path) if path is not None and path.is_file() else None


def require_adapter(backend: BackendName, settings: SfmSettings) -> None:
    """Raise UsageError where the back end that was named needs an adapter, and none was."""
    if backend == "swimm3r" and isinstance(settings, Mast3rSettings) and settings.adapter is None:
        raise UsageError(
            "--backend swimm3r needs --adapter FILE",
            cause="medium-aware structure from motion is MASt3R with a trained adapter, and none is published",
            hint="train one with swimm3r train-sfm; or --backend mast3r, which does without",
        )


def run_stages(
    source: Path,
    given: FolderOptions,
    settings: RunSettings,
    last: str,
    reference: Path | None = None,
    map_device: MapDevice = "cpu",  # stages before the map ask for no GPU
    page: ViewOptions | None = None,
    engine: EngineSettings = EngineSettings(),  # noqa: B008 - records are frozen
) -> None:
    """Run the stages up to the last one, then print the outcome, the files that hold it and the next command."""
    source, out = input_and_folder(source, given.out)
    from swimm3r.pipeline.run import run_pipeline

    with drawn_progress() as progress, _watched(out, page, progress) as (told, observer):
        summary = run_pipeline(
            source,
            out,
            settings,
            redo=given.redo,
            reference=reference,
            last_stage=last,
            map_device=map_device,
            progress=told,
            on_stage=progress.begin_stage,
            observer=observer,
            engine=engine,
        )
    print_summary(summary)
    print_results(out, {name: what for name, what in RESULTS.items() if name.startswith(_OF_STAGE[last])})
    match last:
        case "prepare":
            print_next("poses, depth and water", "sfm", source, "--out", out)
        case "sfm":
            print_next("the map, scores and report", "run", source, "--out", out)
        case _:
            print_next("fly through the map", "view", out)


@contextmanager
def _watched(
    out: Path, page: ViewOptions | None, progress: Drawn
) -> Iterator[tuple[Progress, Callable[[Any], None] | None]]:
    """The progress of a run and the observer of its training; with --view, those of a page in the browser."""
    if page is None or not page.view:
        yield progress, None
        return
    from swimm3r.viewer.live import live_view

    with live_view(out, ViewerSettings(host=page.host, port=page.port), progress, print_line) as live:
        yield live.progress, live.observe
