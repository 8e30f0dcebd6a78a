"""Every setting declares what it may be, and nothing else gets in: from the command line, a file, or Python."""

import ast
import importlib
import math
import pickle
import re
import subprocess
import sys
from collections.abc import Iterator
from dataclasses import MISSING, Field, dataclass, fields
from pathlib import Path
from typing import Annotated, Any, Literal, cast, get_args, get_origin

import numpy as np
import pytest

import swimm3r
from swimm3r.bench.protocols.ablation_uwbs import ablate
from swimm3r.bench.protocols.render import compare_renderers
from swimm3r.cli.main import main
from swimm3r.errors import InputError, UsageError
from swimm3r.pipeline.presets import PRESETS, RunSettings, from_yaml, to_yaml
from swimm3r.pipeline.renders import render_run
from swimm3r.pipeline.view_settings import ViewSettings
from swimm3r.scale.settings import ScaleSettings
from swimm3r.scene.settings import FrameSettings
from swimm3r.settings import NotEmpty, Positive, Range, SettingError, Settings, declarations, ranges_of
from swimm3r.settings_document import from_document, to_document
from swimm3r.sfm.colmap.settings import MappingSettings
from swimm3r.sfm.features.settings import FeatureSettings
from swimm3r.sfm.settings import ColmapSettings
from swimm3r.splat.settings import LearningRates, UwbsSettings

PACKAGE = Path(swimm3r.__file__).parent
FILES = sorted({*PACKAGE.rglob("*settings.py"), *PACKAGE.rglob("presets.py")} - {PACKAGE / "settings.py"})
ELSEWHERE = tuple(PACKAGE.rglob("asmk.py"))


def settings_classes() -> list[type[Settings]]:
    """Every settings record of the package."""
    for path in (*FILES, *ELSEWHERE):
        importlib.import_module(".".join(["swimm3r", *path.relative_to(PACKAGE).with_suffix("").parts]))

    def below(kind: type[Settings]) -> Iterator[type[Settings]]:
        for one in kind.__subclasses__():
            yield one
            yield from below(one)

    return sorted(
        {kind for kind in below(Settings) if kind.__module__.startswith("swimm3r.")}, key=lambda k: k.__name__
    )


CLASSES = settings_classes()


def filled(kind: type[Any], **changes: Any) -> Any:
    """A record whose fields are set and then checked, as its __init__ does; the suite's type checks stay out of it."""

    def default(field: Field) -> Any:
        if field.default_factory is not MISSING:
            return field.default_factory()
        return Path("model") if field.default is MISSING else field.default

    record = object.__new__(kind)
    for field in fields(kind):
        object.__setattr__(record, field.name, changes[field.name] if field.name in changes else default(field))
    record.__post_init__()
    return record


def bare_numbers(hint: Any) -> Iterator[Any]:
    """Numbers in a type hint that stand outside every declared range."""
    origin, parts = get_origin(hint), get_args(hint)
    if hint in (int, float):
        yield hint
    elif origin is Annotated and parts[0] in (int, float) and any(ranges_of(hint)):
        return
    elif origin is not Literal:
        for part in parts:
            yield from bare_numbers(part)


def ranges_of_class(kind: type[Settings]) -> list[tuple[str, Any, Range]]:
    return [(name, hint, rule) for name, hint in declarations(kind).items() for rule in ranges_of(hint)]


def shaped(hint: Any, number: float) -> Any:
    """A value of a hint's shape that holds the number: itself, or tuples of it."""
    if get_origin(hint) is tuple:
        kinds = get_args(hint)
        return (number,) * (1 if Ellipsis in kinds else len(kinds))
    tuples = [part for part in get_args(hint) if get_origin(part) is tuple]
    return shaped(tuples[0], number) if tuples else number


def edges(rule: Range, whole: bool) -> tuple[list[float], list[float]]:
    """Numbers just inside a range, and just outside."""

    def beside(x: float, to: float) -> float:
        return x + int(math.copysign(1, to)) if whole else math.nextafter(x, to)

    low, high = (-(10**9) if rule.least is None else rule.least), (10**9 if rule.most is None else rule.most)
    inside, outside = [low, high], [beside(low, -math.inf), beside(high, math.inf)]
    if rule.above is not None:
        inside[0], outside[0] = beside(rule.above, math.inf), rule.above
    if rule.below is not None:
        inside[1], outside[1] = beside(rule.below, -math.inf), rule.below
    return inside, [x for x in outside if not (rule.or_zero and x == 0)]


def test_every_record_of_settings_checks_itself():
    """A dataclass called settings, or in a file of settings, is one of those that the tests below walk."""
    named = [
        node.name
        for path in PACKAGE.rglob("*.py")
        for node in ast.walk(ast.parse(path.read_text()))
        if isinstance(node, ast.ClassDef)
        and any("dataclass" in ast.unparse(decorator) for decorator in node.decorator_list)
        and (path in FILES or re.fullmatch(r"[A-Z]\w+Settings", node.name))
    ]
    assert set(named) <= {kind.__name__ for kind in CLASSES}
    assert len(named) > 40


@pytest.mark.parametrize("kind", CLASSES)
def test_every_number_declares_its_range(kind: type[Settings]):
    assert [name for name, hint in declarations(kind).items() if any(bare_numbers(hint))] == []


def test_a_number_without_range_is_noticed():
    assert list(bare_numbers(int)) == [int]
    assert list(bare_numbers(float | None)) == [float]
    assert list(bare_numbers(Annotated[tuple[float, ...], NotEmpty()])) == [float]
    assert not list(bare_numbers(Annotated[tuple[Positive, ...], NotEmpty()]))


@pytest.mark.parametrize("kind", CLASSES)
def test_the_ends_of_a_range_are_taken_and_what_lies_beyond_is_refused(kind: type[Settings]):
    for name, hint, rule in ranges_of_class(kind):
        inside, outside = edges(rule, whole=int in _kinds(hint))
        for number in inside:
            with_others = {
                (FrameSettings, "end"),
                (ScaleSettings, "marker_size"),
                (ColmapSettings, "readout"),
                (MappingSettings, "chunk_frames"),
                (MappingSettings, "chunk_overlap"),
            }
            if (kind, name) not in with_others:
                filled(kind, **{name: shaped(hint, number)})
        for number in (*outside, 1e300, -1e300, 10**400):
            with pytest.raises(SettingError, match=rf"{kind.__name__}\.{name} must be"):
                filled(kind, **{name: shaped(hint, number)})


def _kinds(hint: Any) -> set[Any]:
    return {hint} if hint in (int, float) else set().union(*(_kinds(part) for part in get_args(hint)))


@pytest.mark.parametrize("kind", CLASSES)
def test_what_is_no_number_is_refused(kind: type[Settings]):
    for name, hint, _ in ranges_of_class(kind):
        for other in (math.nan, math.inf, -math.inf, "1", True, [], {}, b"1", 1j, object()):
            with pytest.raises(SettingError):
                filled(kind, **{name: shaped(hint, cast(Any, other))})
        if int in _kinds(hint):
            with pytest.raises(SettingError):
                filled(kind, **{name: shaped(hint, 1.5)})


@pytest.mark.parametrize("kind", CLASSES)
def test_a_word_that_is_no_option_a_text_for_a_flag_and_a_foreign_record_are_refused(kind: type[Settings]):
    for name, hint in declarations(kind).items():
        wrong = [object(), 7.5 if not any(ranges_of(hint)) else "x"]
        wrong += ["nonsense"] if get_origin(hint) is Literal else ["False", 1] if hint is bool else []
        for value in wrong:
            with pytest.raises(SettingError, match=name):
                filled(kind, **{name: value})


def test_whole_numbers_stand_for_floats_lists_for_tuples_and_text_for_paths():
    rates = filled(LearningRates, xyz=1, rgb=np.float32(0.5))
    assert (type(rates.xyz), type(rates.rgb)) == (float, float)
    assert type(filled(FeatureSettings, count=np.int64(7)).count) is int
    assert filled(MappingSettings, focal_ladder=[1, 2]).focal_ladder == (1.0, 2.0)
    assert filled(FrameSettings, masks="masks").masks == Path("masks")


def test_an_empty_list_is_refused_where_there_must_be_something():
    with pytest.raises(SettingError, match=r"focal_ladder must be a list .* that is not empty"):
        MappingSettings(focal_ladder=())


def test_what_several_fields_say_together_is_checked_after_each_alone():
    with pytest.raises(UsageError, match="is not after start"):
        FrameSettings(start=5.0, end=5.0)
    with pytest.raises(SettingError, match="end must be"):
        FrameSettings(start=5.0, end=math.inf)


def test_a_refusal_is_a_value_error_and_a_usage_error_and_crosses_processes():
    with pytest.raises(ValueError, match="above 0 and at most 1, got nan") as caught:
        LearningRates(xyz=math.nan)
    assert isinstance(caught.value, UsageError)
    assert caught.value.exit_code == 2
    assert str(pickle.loads(pickle.dumps(caught.value))) == str(caught.value)


def test_python_calls_without_the_suites_type_checks_are_refused_too():
    code = """
from swimm3r.sfm.features.settings import FeatureSettings
try:
    FeatureSettings(count="3")
except ValueError as error:
    print(error)
"""
    said = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True).stdout
    assert said.startswith("FeatureSettings.count must be a whole number at least 1 and at most 1000000, got '3'")


# ----- files


@pytest.mark.parametrize(
    ("before", "after", "says"),
    [
        ("xyz: 0.00016", "xyz: .nan", "splat.rates.xyz must be a number above 0 and at most 1, got nan"),
        ("count: 2048", "count: '2048'", "sfm.features.count must be a whole number"),
        ("count: 2048", "count: 0", "sfm.features.count must be"),
        ("method: auto", "method: guess", "sfm.mapping.method must be one of auto, incremental, global, got 'guess'"),
        ("white_balance: true", "white_balance: 1", "sfm.restore.white_balance must be True or False"),
        ("kind: ColmapSettings", "kind: Colmap", "sfm.kind must be one of ColmapSettings, "),
        ("count: 2048", "cuont: 2048", "there is no setting sfm.features.cuont"),
        ("frames:\n", "frames: 3\nfarmes:\n", "farmes"),
        ("frames:\n", "\tframes:\n", "no YAML"),
        ("pick: sharpest", "pick: !!python/object:os.system x", "no YAML"),
    ],
)
def test_a_file_of_settings_that_says_something_else_is_named_with_the_key(
    before: str, after: str, says: str, tmp_path: Path
):
    path, text = tmp_path / "settings.yaml", to_yaml(RunSettings())
    assert text.count(before) >= 1
    path.write_text(text.replace(before, after))
    with pytest.raises(InputError, match=r"settings\.yaml") as caught:
        from_yaml(path)
    assert says in str(caught.value)
    assert caught.value.exit_code == 3


@pytest.mark.parametrize("text", ["", "3", "[1, 2]", "frames: [1]", "splat: null"])
def test_a_file_that_holds_no_settings_is_input_that_cannot_be_used(text: str, tmp_path: Path):
    (tmp_path / "settings.yaml").write_text(text)
    with pytest.raises(InputError, match=r"settings\.yaml"):
        from_yaml(tmp_path / "settings.yaml")


def test_a_document_holds_plain_values_and_comes_back():
    document = to_document(PRESETS["fast"])
    assert document["sfm"]["kind"] == "ColmapSettings"
    assert document["sfm"]["mapping"]["focal_ladder"] == list(MappingSettings().focal_ladder)
    assert from_document(document, RunSettings) == PRESETS["fast"]
    assert from_document({}, UwbsSettings) == UwbsSettings()


# ----- the command line


def refused(capsys: pytest.CaptureFixture[str], *arguments: str) -> str:
    with pytest.raises(SystemExit) as stop:
        main(arguments)
    assert stop.value.code == 2
    return " ".join(capsys.readouterr().err.split())


@pytest.mark.parametrize(
    ("arguments", "says"),
    [
        ("run x --out o --splat.rates.xyz nan", "--splat.rates.xyz: must be a number above 0 and at most 1, got nan"),
        ("run x --out o --threads -1", "--threads: must be a whole number at least 0 and at most 1024, got -1"),
        ("run x --out o --start inf", "--start: must be a number"),
        ("run x --out o --k1 1e9", "--k1: must be a number at least -1e+06 and at most 1e+06, or None, got"),
        ("run x --out o --mapping.focal-ladder", "--mapping.focal-ladder: must be a list"),
        ("sfm x --out o --backend mast3r --memory-mb 0", "--memory-mb: must be"),
        ("run x --out o --recipe seasplat --splat.water.every 0", "--splat.water.every: must be"),
        ("demo --seed 99999999999999999999999999", "--seed: must be"),
        (
            "demo --coefficients.Binf 0 0 2",
            "--coefficients.Binf: must be 3 values (a number at least 0 and at most 1",
        ),
        ("render x --count -1", "--count: must be a whole number"),
        ("render x --long-side 5", "--long-side: must be a whole number at least 32 and at most 65536, or 0, got 5"),
        ("render x --time nan", "--time: must be"),
        ("export x --time inf", "--time: must be"),
        ("eval x --steps -1", "--steps: must be"),
        ("localize x --max-error -1", "--max-error: must be"),
        ("train-sfm x --out o --learning-rate 0", "--learning-rate: must be"),
        ("bench render x --out o --seeds 0", "--seeds: must be a whole number at least 1 and at most 1000, got 0"),
        ("bench ablation-uwbs x --out o --seeds -1", "--seeds: must be"),
        ("bench flsea x --out o --stride 0", "--stride: must be"),
        ("bench restoration x --out o --jobs 0", "--jobs: must be"),
    ],
)
def test_a_number_out_of_range_is_exit_2_under_the_name_of_its_option(
    arguments: str, says: str, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch, tmp_path: Path
):
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("COLUMNS", "300")
    assert says in refused(capsys, *arguments.split())
    assert not list(tmp_path.iterdir())


def test_help_shows_the_ranges(capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setenv("COLUMNS", "200")
    for _ in range(2):  # commands are made anew by every call
        with pytest.raises(SystemExit):
            main(["run", "--help-all"])
        shown = capsys.readouterr().out
        for option in (
            "--features.count 1..1000000", "--splat.rates.xyz 0<FLOAT<=1", "--splat.long-side 0|32..65536",
            "--mapping.focal-ladder [0.1..20 [0.1..20 ...]]", "--focal FLOAT>0", "--depth.min-ncc 0<=FLOAT<1",
        ):  # fmt: skip
            assert option in shown


@dataclass(frozen=True)
class _Sample(Settings):
    number: Annotated[float, Range(above=0, below=2)] = 1.0


def test_a_range_says_what_it_is():
    assert str(Range(0, 1)) == "at least 0 and at most 1"
    assert str(Range(32, 64, or_zero=True)) == "at least 32 and at most 64, or 0"
    assert [Range(above=0, below=2).allows(x) for x in (0, 1, 2)] == [False, True, False]
    assert Range(32, or_zero=True).allows(0)
    with pytest.raises(SettingError, match=r"_Sample\.number must be a number above 0 and below 2, got 2"):
        _Sample(2.0)


@pytest.mark.parametrize(("long_side", "count", "time"), [(5, 0, None), (0, -1, None), (0, 0, math.nan)])
def test_functions_of_the_python_api_check_their_numbers_before_anything_else(
    long_side: int, count: int, time: float | None, tmp_path: Path
):
    with pytest.raises(SettingError):
        render_run(tmp_path / "nowhere", ViewSettings(count=count, long_side=long_side, time=time))


def test_no_seed_and_no_stride_are_refused_before_anything_is_measured(tmp_path: Path):
    with pytest.raises(SettingError, match="seeds must be"):
        ablate([tmp_path], tmp_path, UwbsSettings(), 0)
    with pytest.raises(SettingError, match="seeds must be"):
        compare_renderers([], tmp_path, ("ubs",), UwbsSettings(), seeds=0)
