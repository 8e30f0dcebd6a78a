"""`swimm3r COMMAND ...`: parses, runs one command and turns what users can mend into messages and exit codes."""

import os
import sys
from collections.abc import Callable, Mapping, Sequence
from io import TextIOWrapper
from typing import Annotated, Any, Union

import tyro
from tyro.conf import arg, subcommand

from swimm3r.cli.batch import batch_command
from swimm3r.cli.bench.ablation_uwbs import ablation_uwbs_command
from swimm3r.cli.bench.flsea import ablation_sfm_command, flsea_command
from swimm3r.cli.bench.on_runs import localization, restoration
from swimm3r.cli.bench.render import render_command
from swimm3r.cli.bench.revisits import revisits_command
from swimm3r.cli.bench.scale import scale_command
from swimm3r.cli.bench.sfm import sfm_command as bench_sfm_command
from swimm3r.cli.bench.table import defaults_of
from swimm3r.cli.brief import BRIEF
from swimm3r.cli.datasets import datasets
from swimm3r.cli.demo import demo
from swimm3r.cli.doctor import doctor
from swimm3r.cli.evaluate import evaluate
from swimm3r.cli.export import export_command
from swimm3r.cli.localize import localize
from swimm3r.cli.pipeline.prepare import prepare_command
from swimm3r.cli.pipeline.run import run_command
from swimm3r.cli.pipeline.sfm import sfm_command
from swimm3r.cli.pipeline.splat import splat_command
from swimm3r.cli.pipeline.stages import starting_point
from swimm3r.cli.render import render
from swimm3r.cli.report import report
from swimm3r.cli.survey.measure import measure
from swimm3r.cli.survey.products import products
from swimm3r.cli.survey.scale import scale
from swimm3r.cli.survey.telemetry import telemetry
from swimm3r.cli.survey.topics import topics
from swimm3r.cli.survey.visits import visits
from swimm3r.cli.terminal.arguments import named
from swimm3r.cli.terminal.help_views import View, brief_help, group_help
from swimm3r.cli.terminal.output_level import FLAGS, begin_messages, with_output_level
from swimm3r.cli.terminal.ranges import settings_with_ranges, with_ranges
from swimm3r.cli.train_sfm import train_sfm_command
from swimm3r.cli.view import view
from swimm3r.cli.weights import WEIGHTS
from swimm3r.errors import Swimm3rError, UsageError
from swimm3r.export.settings import FORMATS
from swimm3r.io.files.refusals import refusal
from swimm3r.memory import out_of_memory
from swimm3r.pipeline.presets import PRESETS
from swimm3r.sfm.distillation.settings import RECIPES
from swimm3r.weights.store import cache_folder

_INTERRUPTED, _UNREAD = 130, 141  # 128 + SIGINT, SIGPIPE
_RESUMED = ("run", "prepare", "sfm", "splat", "batch", "bench", "demo", "train-sfm", "weights")
_DESCRIPTION = (
    "Underwater video in; camera poses, water, a restored cloud and a map that renders out. "
    "Options of a command: swimm3r COMMAND --help. Version: swimm3r --version."
)

Commands = Mapping[str, "Callable | Family"]


class Family:
    """Commands that follow another word: swimm3r bench render."""

    def __init__(self, about: str, commands: Mapping[str, Callable]) -> None:
        self.about, self.commands = about, commands


def main(arguments: Sequence[str] | None = None) -> None:
    """Run one command; leaves through SystemExit with the documented code. Without a command the help is shown."""
    arguments = list(sys.argv[1:] if arguments is None else arguments)
    for stream in (sys.stdout, sys.stderr):
        if isinstance(stream, TextIOWrapper):
            stream.reconfigure(errors="backslashreplace")  # names of files may hold what no encoding shows
    # before torch loads OpenMP: waiting threads that spin cost a busy machine more time than the work they wait for
    os.environ.setdefault("OMP_WAIT_POLICY", "PASSIVE")
    # before torch makes one among the temporary files
    os.environ.setdefault("TORCHINDUCTOR_CACHE_DIR", str(cache_folder() / "torchinductor"))
    begin_messages()
    try:
        _run_command(arguments)
    except Swimm3rError as error:
        _fail(error)
    except KeyboardInterrupt:
        resumes = any(word in _RESUMED for word in arguments[:1])
        kept = " Finished work is kept: the same command resumes from here." if resumes else ""
        print(f"\nInterrupted.{kept}", file=sys.stderr)
        raise SystemExit(_INTERRUPTED) from None
    except BrokenPipeError:  # of `swimm3r ... | head`: nobody reads on
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        raise SystemExit(_UNREAD) from None
    except Exception as error:
        told = out_of_memory(error) or refusal(error)
        if told is None:
            raise
        _fail(told)


def _run_command(arguments: list[str]) -> None:
    if "" in arguments or any(word.startswith("--") and word.endswith("=") for word in arguments):
        raise UsageError(
            "an argument is empty", cause="a variable of the shell that is not set", hint="a name in its place"
        )
    if arguments[:1] == ["--version"]:
        from importlib.metadata import version

        print(f"swimm3r {version('swimm3r')}")
        return
    while arguments and arguments[0] in FLAGS and len(arguments) > 1:  # swimm3r -q run ...
        arguments = [*arguments[1:], arguments[0]]
    with settings_with_ranges():
        _parse_and_run(commands_for(arguments), arguments)


def commands_for(arguments: Sequence[str]) -> dict[str, Callable | Family]:
    """Every command, with the defaults that its command line decides."""
    is_pipeline = arguments[:1] and arguments[0] in ("run", "prepare", "sfm", "splat", "batch")
    start = starting_point(arguments if is_pipeline else ())
    tables = defaults_of(named("--preset", arguments, PRESETS) or "fast")
    protocols = {
        "flsea": flsea_command(tables),
        "sfm": bench_sfm_command(tables),
        "restoration": restoration,
        "render": render_command(tables),
        "localization": localization,
        "scale": scale_command(tables),
        "revisits": revisits_command(tables),
        "ablation-sfm": ablation_sfm_command(tables),
        "ablation-uwbs": ablation_uwbs_command(tables),
    }
    return {
        "run": run_command(start),
        "prepare": prepare_command(start),
        "sfm": sfm_command(start),
        "splat": splat_command(start),
        "batch": batch_command(start),
        "bench": Family(
            "The paper's tables on your own dives. Results stay in --out; re-run the same command to resume.", protocols
        ),
        "view": view,
        "demo": demo,
        "doctor": doctor,
        "eval": evaluate,
        "export": export_command(named("--format", arguments, FORMATS) or "ply"),
        "render": render,
        "scale": scale,
        "products": products,
        "measure": measure,
        "telemetry": telemetry,
        "topics": topics,
        "visits": visits,
        "localize": localize,
        "report": report,
        "datasets": datasets,
        "train-sfm": train_sfm_command(named("--recipe", arguments, RECIPES) or "swimm3r"),
        "weights": Family(
            "List, download, check and find model weights. Nothing but --backend mast3r and some scores needs any.",
            WEIGHTS,
        ),
    }


def _parse_and_run(commands: Commands, arguments: list[str]) -> None:
    """Parse the command line and run its command, or print the part of its help that is asked for."""
    path = _command_path(commands, arguments)
    view = _help_view(commands, path, arguments)
    if view is None:
        given = ["--help" if word == "--help-all" else word for word in arguments]
        is_missing = not given or (len(given) == 1 and isinstance(commands.get(given[0]), Family))
        try:
            given += ["--help"] if is_missing else []
            tyro.cli(_parser(commands, path), prog="swimm3r", description=_DESCRIPTION, args=given)
        except SystemExit:
            if is_missing:
                raise SystemExit(UsageError.exit_code) from None
            raise
        return
    try:
        tyro.cli(_parser(commands, path, view), prog="swimm3r", args=[*path, "--help"])
    except SystemExit:
        print(view.footer)
        raise


def _command_path(commands: Commands, arguments: Sequence[str]) -> tuple[str, ...]:
    """The words that name the command: ("bench", "render"); none where there is no such command."""
    first = commands.get(arguments[0]) if arguments else None
    if isinstance(first, Family):
        return tuple(arguments[:2]) if len(arguments) > 1 and arguments[1] in first.commands else ()
    return () if first is None else (arguments[0],)


def _help_view(commands: Commands, path: tuple[str, ...], arguments: Sequence[str]) -> View | None:
    """The part of a command's help that is asked for; None for the whole help, or none."""
    asked = next((number for number, word in enumerate(arguments) if word in ("-h", "--help")), None)
    if asked is None or not path or "--help-all" in arguments:
        return None
    first = commands[path[0]]
    command = _ready(first.commands[path[1]] if isinstance(first, Family) else first)
    usage = " ".join(("swimm3r", *path))
    after = arguments[asked + 1 :]
    view = group_help(command, usage, after[0]) if after else None
    if view is None and path in BRIEF:
        view = brief_help(command, usage, BRIEF[path])
    return view


def _parser(commands: Commands, path: tuple[str, ...] = (), view: View | None = None) -> Any:
    """The commands as tyro takes them: a union of constructors; the one at `path` is replaced by the view.

    Where a command is named, the others only stand in the list: making them ready would take longer than the parsing.
    """

    def union(members: Commands, above: tuple[str, ...]) -> Any:
        kinds = []
        for name, member in members.items():
            here = (*above, name)
            if isinstance(member, Family):
                made = _family(member.about, union(member.commands, here))
            elif here == path and view is not None:
                made = view.command
            else:
                made = _ready(member) if path in (here, ()) else member
            kinds.append(Annotated[Any, subcommand(name=name, constructor=made)])
        return Union[tuple(kinds)]  # noqa: UP007 - of as many as there are

    return union(commands, ())


def _family(about: str, members: Any) -> Callable:
    def family(action: Annotated[members, arg(name="")]) -> None:
        pass

    family.__doc__ = about
    return family


def _ready(command: Callable) -> Callable:
    return with_ranges(with_output_level(command))


def _fail(error: Swimm3rError) -> None:
    print(f"swimm3r: {error}", file=sys.stderr)
    raise SystemExit(error.exit_code)
