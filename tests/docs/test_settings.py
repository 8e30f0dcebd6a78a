"""Options and settings that documents name exist under that name."""

import contextlib
import io
import re
from pathlib import Path
from typing import Any, get_args

import pytest
from tests.docs.documents import DOCUMENTS, ROOT
from tests.test_architecture import PACKAGE

from swimm3r.cli.main import main
from swimm3r.export.settings import FORMATS
from swimm3r.pipeline.presets import RunSettings
from swimm3r.settings import Settings, declarations
from swimm3r.sfm.distillation.settings import TrainSettings
from swimm3r.splat.settings import RECIPES

COMMANDS = (
    *("run", "prepare", "sfm", "splat", "render", "export", "eval", "localize", "report", "view", "demo", "doctor"),
    *("products", "measure", "scale", "datasets", "train-sfm", "batch", "weights get", "bench render", "bench sfm"),
    *("telemetry", "topics", "visits", "bench flsea", "bench revisits"),
    *("bench restoration", "bench localization", "bench scale", "bench ablation-uwbs", "bench ablation-sfm"),
    "run --backend mast3r",
    *(f"run --recipe {recipe}" for recipe in RECIPES),
    *(f"export --format {name}" for name in FORMATS),
)
OTHER_PROGRAMS = {"--extra-index-url", "--rm", "--junitxml", "--timeout", "--nproc-per-node", "--prefix"}
"""Of pip, docker, pytest, torchrun and npm."""
OPTION = re.compile(r"(?<![\w-])--[a-z][\w.-]*\w")


@pytest.fixture(scope="module")
def options() -> set[str]:
    """Every option of the command line, and of the repository's scripts."""
    shown = io.StringIO()
    for command in ("--help", *(f"{command} --help-all" for command in COMMANDS)):
        with contextlib.redirect_stdout(shown), contextlib.suppress(SystemExit):
            main(command.split())
    scripts = [*ROOT.glob("benchmarks/**/*.py"), *ROOT.glob("examples/*.py"), ROOT / "tests" / "processors.py"]
    declared = [name for script in scripts for name in re.findall(r'"(--[a-z][\w-]*)"', script.read_text("utf-8"))]
    declared.append("--waters")  # of veil_anchor, whose options are the parameters of a function
    return {*OPTION.findall(shown.getvalue()), *declared}


@pytest.mark.parametrize("document", DOCUMENTS, ids=lambda path: str(path.relative_to(ROOT)))
def test_every_option_that_a_document_names_exists(document: Path, options: set[str]):
    assert len(options) > 300
    text = document.read_text(encoding="utf-8")
    renamed = r"^- Options mean the same.*\n(?:  .*\n)*"  # in the changelog, old names beside the new ones
    text = re.sub(renamed, "", text, flags=re.MULTILINE)
    assert set(OPTION.findall(text)) - options - OTHER_PROGRAMS == set()


def groups(kind: Any, found: dict[str, set[str]]) -> dict[str, set[str]]:
    """The settings below a record, by the name of the group that they are in."""
    for name, hint in declarations(kind).items():
        for part in records(hint):
            found.setdefault(name, set()).update(declarations(part))
            groups(part, found)
    return found


def records(hint: Any) -> list[type[Settings]]:
    """The records of settings that a field may hold."""
    return [part for part in get_args(hint) or (hint,) if isinstance(part, type) and issubclass(part, Settings)]


def is_setting(path: str, kind: type[Settings] = RunSettings) -> bool:
    """Return whether a dotted path leads to a setting below a record, of any back end or recipe."""
    name, _, rest = path.partition(".")
    hint = declarations(kind).get(name)
    return hint is not None and (not rest or any(is_setting(rest, part) for part in records(hint)))


def is_module(path: str) -> bool:
    """Return whether a dotted path below the package is a module of it."""
    place = PACKAGE.joinpath(*path.split("."))
    return place.is_dir() or place.with_suffix(".py").is_file()


@pytest.mark.parametrize("document", DOCUMENTS, ids=lambda path: str(path.relative_to(ROOT)))
def test_every_setting_that_a_document_names_exists(document: Path):
    known = groups(TrainSettings, groups(RunSettings, {}))
    for other_thing in ("frames", "medium", "poses", "scale", "sfm", "splat", "test"):  # rooms, files, sections
        del known[other_thing]
    assert {"weights", "densify", "sgg", "alignment", "restore", "objective"} < known.keys()
    named = re.findall(r"`(?:splat\.)?([a-z_]+)\.([a-z_]+)`", document.read_text(encoding="utf-8"))
    wrong = {f"{group}.{name}" for group, name in named if group in known and name not in known[group]}
    assert wrong == set()


@pytest.mark.parametrize("document", DOCUMENTS, ids=lambda path: str(path.relative_to(ROOT)))
def test_every_path_of_a_setting_in_a_document_leads_to_one(document: Path):
    named = re.findall(r"`((?:sfm|splat)(?:\.[a-z_]\w*){2,})`", document.read_text(encoding="utf-8"))
    assert [path for path in named if not is_setting(path) and not is_module(path)] == []


def test_a_path_through_the_wrong_group_is_seen():
    assert is_setting("sfm.water.gain_std")
    assert is_setting("splat.densify.cap_max")
    assert is_module("sfm.colmap.shutter.turning")
    assert not is_setting("sfm.medium.gain_std")
    assert not is_module("sfm.medium.gain_std")
