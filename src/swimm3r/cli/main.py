"""`swimm3r COMMAND ...`: parses, runs one command and turns what users can mend into messages and exit codes."""

import errno
import logging
import os
import sys
from collections.abc import Collection, Sequence
from io import TextIOWrapper
from itertools import pairwise
from pathlib import Path
from typing import TypeVar

import tyro

from swimm3r.cli import bench
from swimm3r.cli.datasets import datasets
from swimm3r.cli.demo import demo
from swimm3r.cli.doctor import doctor
from swimm3r.cli.evaluate import evaluate
from swimm3r.cli.export import export
from swimm3r.cli.localize import localize
from swimm3r.cli.render import render
from swimm3r.cli.report import report
from swimm3r.cli.run import commands_for_settings, held_settings
from swimm3r.cli.terminal.console import MessagePrinter
from swimm3r.cli.terminal.ranges import settings_with_ranges, with_ranges
from swimm3r.cli.train_sfm import command_for_recipe
from swimm3r.cli.weights import weights
from swimm3r.errors import InputError, StorageError, Swimm3rError, UsageError
from swimm3r.memory import out_of_memory
from swimm3r.pipeline.presets import PRESETS
from swimm3r.pipeline.run_settings import starting_settings
from swimm3r.sfm.distillation.settings import RECIPES as SFM_RECIPES
from swimm3r.splat.settings import RECIPES as MAP_RECIPES
from swimm3r.weights.store import cache_folder

Name = TypeVar("Name", bound=str)
_INTERRUPTED, _UNREAD = 130, 141  # 128 + SIGINT, SIGPIPE
_STORAGE_ERRORS = {errno.ENOSPC, errno.EDQUOT, errno.EROFS, errno.EACCES, errno.EPERM, errno.EFBIG}


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
    logging.basicConfig(level=logging.WARNING, format="%(message)s", handlers=[MessagePrinter()])
    logging.getLogger("swimm3r").setLevel(logging.INFO)
    try:
        _run_command(arguments)
    except SystemExit:
        if not arguments:
            raise SystemExit(UsageError.exit_code) from None
        raise
    except Swimm3rError as error:
        _fail(error)
    except KeyboardInterrupt:
        print("\nInterrupted. What is finished is kept: the same command goes on from here.", file=sys.stderr)
        raise SystemExit(_INTERRUPTED) from None
    except BrokenPipeError:  # of `swimm3r ... | head`: nobody reads on
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        raise SystemExit(_UNREAD) from None
    except Exception as error:
        told = out_of_memory(error) or _file_failure(error)
        if told is None:
            raise
        _fail(told)


def _run_command(arguments: Sequence[str]) -> None:
    if "" in arguments or any(word.startswith("--") and word.endswith("=") for word in arguments):
        raise UsageError(
            "an argument is empty", cause="a variable of the shell that is not set", hint="a name in its place"
        )
    named_preset = _named("--preset", arguments, PRESETS)
    is_pipeline = arguments[:1] and arguments[0] in ("run", "prepare", "sfm", "splat")
    defaults = starting_settings(
        named_preset,
        _named("--backend", arguments, ("colmap", "mast3r", "swimm3r")),
        _named("--recipe", arguments, MAP_RECIPES),
        held_settings(arguments) if is_pipeline and named_preset is None else None,
    )
    commands = {
        **commands_for_settings(defaults),
        "bench": bench.command_for_preset(named_preset or "fast"),
        "demo": demo,
        "doctor": doctor,
        "eval": evaluate,
        "export": export,
        "render": render,
        "localize": localize,
        "report": report,
        "datasets": datasets,
        "train-sfm": command_for_recipe(_named("--recipe", arguments, SFM_RECIPES) or "swimm3r"),
        "weights": weights,
    }
    with settings_with_ranges():
        tyro.extras.subcommand_cli_from_dict(
            {name: with_ranges(command) for name, command in commands.items()},
            prog="swimm3r",
            description="Underwater video in; camera poses, water, a restored cloud and a map that renders out.",
            args=arguments or ["--help"],
        )


def _file_failure(error: Exception) -> Swimm3rError | None:
    """The failure in the user's words where the system refused a file; None where that is not what happened."""
    if not isinstance(error, OSError) or error.errno not in _STORAGE_ERRORS:
        return None
    if error.errno in (errno.EACCES, errno.EPERM) and error.filename and not _readable(Path(error.filename)):
        return InputError(
            f"cannot read {error.filename}: {error.strerror}",
            cause="it belongs to another user, or lies in a folder that may not be entered",
            hint="change the permissions (chmod -R u+rX FOLDER), or copy it to a folder of your own",
        )
    return StorageError(
        f"cannot write {error.filename or 'to the run folder'}: {error.strerror}",
        cause="the disk is full, over quota or read-only",
        hint="free some space or choose another --out; the same command then goes on from here",
    )


def _readable(path: Path) -> bool:
    """Whether a path, or the nearest folder above it that is known to exist, may be read."""
    there = next((one for one in (path, *path.absolute().parents) if os.path.lexists(one)), path)
    effective = os.access in os.supports_effective_ids
    return os.access(there, os.R_OK | (os.X_OK if there.is_dir() else 0), effective_ids=effective)


def _fail(error: Swimm3rError) -> None:
    print(f"swimm3r: {error}", file=sys.stderr)
    raise SystemExit(error.exit_code)


def _named(option: str, arguments: Sequence[str], known: Collection[Name]) -> Name | None:
    """What decides the defaults that --help shows is found before tyro parses; tyro checks the name."""
    for here, after in pairwise([*arguments, ""]):
        name = after if here == option else here.removeprefix(f"{option}=")
        if name != here:
            for one in known:
                if one == name:
                    return one
    return None
