"""`swimm3r COMMAND ...`: parses, runs one command and turns what users can mend into messages and exit codes."""

import errno
import logging
import os
import sys
from collections.abc import Collection, Sequence
from typing import TypeVar

import tyro

from swimm3r.cli import bench
from swimm3r.cli.console import MessagePrinter
from swimm3r.cli.datasets import datasets
from swimm3r.cli.demo import demo
from swimm3r.cli.doctor import doctor
from swimm3r.cli.evaluate import evaluate
from swimm3r.cli.export import export
from swimm3r.cli.localize import localize
from swimm3r.cli.render import render
from swimm3r.cli.report import report
from swimm3r.cli.run import commands_for_preset
from swimm3r.cli.train_sfm import command_for_recipe
from swimm3r.cli.weights import weights
from swimm3r.errors import StorageError, Swimm3rError
from swimm3r.presets import PRESETS
from swimm3r.sfm.training.settings import RECIPES as SFM_RECIPES
from swimm3r.splat.settings import RECIPES as MAP_RECIPES

Name = TypeVar("Name", bound=str)
_INTERRUPTED, _UNREAD = 130, 141  # 128 + SIGINT, SIGPIPE
_STORAGE_ERRORS = {errno.ENOSPC, errno.EDQUOT, errno.EROFS, errno.EACCES, errno.EPERM, errno.EFBIG}


def main(arguments: Sequence[str] | None = None) -> None:
    """Run one command; leaves through SystemExit with the documented code."""
    arguments = list(sys.argv[1:] if arguments is None else arguments)
    # before torch loads OpenMP: waiting threads that spin cost a busy machine more time than the work they wait for
    os.environ.setdefault("OMP_WAIT_POLICY", "PASSIVE")
    logging.basicConfig(level=logging.WARNING, format="%(message)s", handlers=[MessagePrinter()])
    logging.getLogger("swimm3r").setLevel(logging.INFO)
    commands = {
        **commands_for_preset(
            _named("--preset", arguments, PRESETS, "default"),
            _named("--backend", arguments, ("colmap", "mast3r", "swimm3r"), "colmap"),
            _named("--recipe", arguments, MAP_RECIPES, "uwbs-static"),
        ),
        "bench": bench.command_for_preset(_named("--preset", arguments, PRESETS, "fast")),
        "demo": demo,
        "doctor": doctor,
        "eval": evaluate,
        "export": export,
        "render": render,
        "localize": localize,
        "report": report,
        "datasets": datasets,
        "train-sfm": command_for_recipe(_named("--recipe", arguments, SFM_RECIPES, "swimm3r")),
        "weights": weights,
    }
    try:
        tyro.extras.subcommand_cli_from_dict(
            commands,
            prog="swimm3r",
            description="Underwater video in; camera poses, water, a restored cloud and a map that renders out.",
            args=arguments,
        )
    except Swimm3rError as error:
        _fail(error)
    except KeyboardInterrupt:
        print("\nInterrupted. What is finished is kept: the same command goes on from here.", file=sys.stderr)
        raise SystemExit(_INTERRUPTED) from None
    except BrokenPipeError:  # of `swimm3r ... | head`: nobody reads on
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        raise SystemExit(_UNREAD) from None
    except OSError as error:
        if error.errno not in _STORAGE_ERRORS:
            raise
        _fail(
            StorageError(
                f"cannot write {error.filename or 'to the run folder'}: {error.strerror}",
                cause="the disk is full, over quota or read-only",
                hint="free some space or choose another --out; the same command then goes on from here",
            )
        )


def _fail(error: Swimm3rError) -> None:
    print(f"swimm3r: {error}", file=sys.stderr)
    raise SystemExit(error.exit_code)


def _named(option: str, arguments: Sequence[str], known: Collection[Name], default: Name) -> Name:
    """What decides the defaults that --help shows is found before tyro parses; tyro checks the name."""
    for here, after in zip(arguments, [*arguments[1:], ""], strict=True):
        name = after if here == option else here.removeprefix(f"{option}=")
        if name != here:
            for one in known:
                if one == name:
                    return one
    return default
