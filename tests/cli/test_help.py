"""Help in three sizes: the options most users touch, all of them, and those of one group; and its words."""

import importlib
import re
from collections.abc import Callable, Iterator
from functools import cache
from pathlib import Path

import pytest

import swimm3r
from swimm3r.cli.brief import BRIEF
from swimm3r.cli.main import Family, commands_for, main
from swimm3r.cli.terminal.help_views import Option, groups_of, options_of
from swimm3r.cli.terminal.output_level import with_output_level
from swimm3r.cli.terminal.ranges import settings_with_ranges, with_ranges
from swimm3r.export.settings import FORMATS
from swimm3r.settings import Settings, description
from swimm3r.splat.settings import RECIPES

PACKAGE = Path(swimm3r.__file__).parent
MOST = 15  # options that a short help shows; --quiet and --verbose aside


def commands(*options: str) -> Iterator[tuple[tuple[str, ...], Callable]]:
    """Every command by the words that name it, as options of `run` set the defaults."""
    for name, one in commands_for(("run", *options)).items():
        if isinstance(one, Family):
            yield from (((name, below), command) for below, command in one.commands.items())
        else:
            yield (name,), one


@cache
def all_options() -> dict[tuple[str, ...], dict[str, Option]]:
    """The options of every command, whatever the back end and the recipe."""
    found: dict[tuple[str, ...], dict[str, Option]] = {}
    with settings_with_ranges():
        for options in (
            (),
            ("--backend", "mast3r"),
            *(("--recipe", name) for name in RECIPES),
            *(("--format", name) for name in FORMATS),
        ):
            for path, command in commands(*options):
                if path[0] not in ("run", "sfm", "splat", "export") and options:
                    continue
                listed = options_of(with_ranges(with_output_level(command)))
                found.setdefault(path, {}).update((one.name, one) for one in listed)
    return found


def shown(capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch, *arguments: str) -> str:
    monkeypatch.setenv("COLUMNS", "200")
    with pytest.raises(SystemExit) as stop:
        main(arguments)
    assert stop.value.code == 0
    return capsys.readouterr().out


def test_every_option_of_a_short_help_exists():
    for path, groups in BRIEF.items():
        for names in groups.values():
            assert set(names) <= all_options()[path].keys(), path


def test_a_short_help_is_short_and_a_long_one_has_a_short_form():
    of_mast3r = {"--adapter", "--weights"}  # in the place of COLMAP's --focal and --housing
    for path, options in all_options().items():
        names = [name for group in BRIEF[path].values() for name in group] if path in BRIEF else list(options)
        counted = [name for name in names if name.startswith("--") and name not in ("--quiet", "--verbose")]
        assert len(set(counted) - of_mast3r) <= MOST, path
        assert len(set(counted)) == len(counted), path


def test_the_short_help_has_groups_by_purpose_and_says_where_the_rest_is(
    capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
):
    brief = shown(capsys, monkeypatch, "run", "--help")
    assert "speed and quality options" in brief
    assert "-o PATH, --out PATH" in brief
    assert "--splat.iterations" not in brief
    assert "more options: swimm3r run --help-all" in brief.splitlines()[-2]
    assert brief.splitlines()[-1].startswith("Options of one group: swimm3r run --help GROUP")
    whole = shown(capsys, monkeypatch, "run", "--help-all")
    assert "--splat.iterations" in whole
    for name in (name for names in BRIEF[("run",)].values() for name in names if name in all_options()[("run",)]):
        assert name in brief or name in ("--adapter", "--weights")
        assert name in whole or name in ("--adapter", "--weights")


@pytest.mark.parametrize("group", ["splat.densify", "densify"])
def test_help_of_one_group_shows_its_options_alone(
    group: str, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
):
    told = shown(capsys, monkeypatch, "run", "--help", group)
    assert "--splat.densify.growth" in told
    assert "--splat.rates.xyz" not in told
    assert "--fps" not in told


def test_the_short_help_shows_defaults_and_choices_of_the_whole(
    capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
):
    for preset, steps in (("fast", "2000"), ("paper", "20000")):
        told = shown(capsys, monkeypatch, "bench", "render", "--preset", preset, "--help")
        assert f"(default: {steps})" in told
    assert "--weights" in shown(capsys, monkeypatch, "sfm", "--backend", "mast3r", "--help")


def test_out_has_one_short_form_and_messages_have_two_options_in_every_command():
    with_out = [path for path, options in all_options().items() if "--out" in options]
    assert len(with_out) >= 15
    for path, options in all_options().items():
        assert {"--quiet", "--verbose"} <= options.keys(), path
        assert "--out" not in options or "'-o'" in str(options["--out"].hint), path


def test_options_of_one_name_take_the_same_values():
    apart = {  # the same meaning, but not the same choices
        "--out", "--preset",  # may be left out where a run folder says it
        "--recipe",  # of maps, and of trainings
        "--device", "--precision",  # training has no MPS and no float16
        "--frames", "--seed",
        "--fps",  # 0 takes every frame of a video; a synthetic dive has no such rate
        "--path",  # of a synthetic dive, and of the views of a map
        "--readout",  # of a synthetic camera, and of one that may be upside down or not known
    }  # fmt: skip
    kinds: dict[str, set[str]] = {}
    for options in all_options().values():
        for name, one in options.items():
            kinds.setdefault(name, set()).add(description(one.hint))
    differing = {name: found for name, found in kinds.items() if len(found) > 1 and name.startswith("--")}
    assert differing.keys() <= apart, differing


def test_the_version_is_printed(capsys: pytest.CaptureFixture[str]):
    main(["--version"])
    assert capsys.readouterr().out.startswith("swimm3r ")


def test_short_forms_name_the_run_folder_as_the_long_one_does(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
):
    asked = []
    monkeypatch.setattr("swimm3r.pipeline.run.run_pipeline", lambda *given, **_: asked.append(given) or {})
    for words in (("-o", "x"), ("-o=x",), ("-ox",), ("--out", "x"), ("--out=x",)):
        main(["run", str(tmp_path), *words])
        assert asked[-1][1] == Path("x")


DATA_SETS = re.compile("flsea|ruie|dolphin|skerki|gopro|curasao|panama|uieb|squid|sparus|subvo|d5|seathru-nerf", re.I)


def settings_options() -> Iterator[Option]:
    """Every setting of every record, whether a command has it or not."""
    for path in sorted({*PACKAGE.rglob("*settings.py"), PACKAGE / "sfm" / "features" / "asmk.py"}):
        importlib.import_module(".".join(("swimm3r", *path.relative_to(PACKAGE).with_suffix("").parts)))

    def below(kind: type[Settings]) -> Iterator[type[Settings]]:
        for one in kind.__subclasses__():
            yield one
            yield from below(one)

    for kind in below(Settings):
        if kind.__module__.startswith("swimm3r."):

            def command(record: object = None) -> None:
                pass

            command.__annotations__ = {"record": kind}
            vars(command).pop("__wrapped__", None)
            with settings_with_ranges():
                yield from options_of(command)


def test_every_setting_has_a_help_string_that_stands_alone():
    options = {(one.name, one.help): one for one in settings_options()}
    assert len(options) > 250
    for name, text in options:
        assert text, f"{name} has no help string"
        assert len(text.split()) >= 3, f"{name}: {text}"
        assert not DATA_SETS.search(text), f"{name}: {text}"


def test_every_help_string_is_a_sentence_of_its_own():
    texts = {(one.name, one.help) for options in all_options().values() for one in options.values()}
    texts |= {(one.name, one.help) for one in settings_options()}
    for name, text in texts:
        assert text, name
        assert len(text.split()) >= 3, f"{name}: {text}"
        assert not re.match(r"(What|Who|Where|How|Whether)\b", text), f"{name}: {text}"
        assert re.match(r"[A-Z`]", text), f"{name}: {text}"
        assert text.endswith((".", "...")), f"{name}: {text}"


def test_groups_of_options_are_described_in_one_line():
    for path, command in commands():
        told = shown_groups(command)
        assert all(text and not re.match(r"(What|Who|Where|How)\b", text) for text in told.values()), (path, told)


def shown_groups(command: Callable) -> dict[str, str]:
    with settings_with_ranges():
        return groups_of(with_ranges(with_output_level(command)))
