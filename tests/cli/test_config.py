"""--config: settings from a file, options over them, and mistakes named with the file."""

import logging
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from swimm3r.cli.main import main
from swimm3r.io.images import write_rgb
from swimm3r.pipeline.presets import MAST3R_PRESETS, PRESETS, RunSettings, to_yaml
from swimm3r.scene.settings import FrameSettings
from swimm3r.sfm.settings import Mast3rSettings
from swimm3r.splat.settings import WaterSplattingSettings, watersplatting

SETTINGS = RunSettings(FrameSettings(fps=2.0, long_side=480), MAST3R_PRESETS["fast"], watersplatting(iterations=70))


@pytest.fixture(autouse=True)
def level() -> Iterator[None]:
    """The package's logging level as it was."""
    logger = logging.getLogger("swimm3r")
    before = logger.level
    yield
    logger.setLevel(before)


@pytest.fixture
def asked(monkeypatch: pytest.MonkeyPatch) -> list[RunSettings]:
    """The settings of every run that is asked for; none is made."""
    asked: list[RunSettings] = []

    def note(source: Path, folder: Path, settings: RunSettings, **_: Any) -> dict:
        asked.append(settings)
        return {}

    monkeypatch.setattr("swimm3r.pipeline.run.run_pipeline", note)
    return asked


def refused(capsys: pytest.CaptureFixture[str], *arguments: str) -> tuple[int, str]:
    with pytest.raises(SystemExit) as stop:
        main(arguments)
    assert isinstance(stop.value.code, int)
    return stop.value.code, capsys.readouterr().err


def test_the_settings_of_a_run_folder_can_be_given_back(tmp_path: Path, asked: list[RunSettings]):
    (tmp_path / "settings.yaml").write_text(to_yaml(SETTINGS))
    main(["run", "dive", "--out", "run", "--config", str(tmp_path / "settings.yaml")])
    assert asked == [SETTINGS]


def test_options_override_the_file(tmp_path: Path, asked: list[RunSettings]):
    (tmp_path / "settings.yaml").write_text(to_yaml(SETTINGS))
    given = ["dive", "--out", "run", f"--config={tmp_path / 'settings.yaml'}"]
    main(["run", *given, "--fps", "9", "--splat.iterations", "11"])
    assert (asked[-1].frames.fps, asked[-1].frames.long_side, asked[-1].splat.iterations) == (9.0, 480, 11)
    assert isinstance(asked[-1].splat, WaterSplattingSettings)
    main(["run", *given, "--backend", "colmap", "--recipe", "uwbs-static"])
    assert asked[-1].sfm == PRESETS["default"].sfm
    assert asked[-1].frames == SETTINGS.frames
    main(["sfm", *given, "--size", "256"])
    assert isinstance(asked[-1].sfm, Mast3rSettings)
    assert asked[-1].sfm.size == 256


def test_a_part_of_the_settings_is_enough(tmp_path: Path, asked: list[RunSettings]):
    (tmp_path / "some.yaml").write_text("frames:\n  fps: 3\n")
    main(["run", "dive", "--out", "run", "--config", str(tmp_path / "some.yaml")])
    assert asked == [RunSettings(frames=FrameSettings(fps=3.0))]


@pytest.mark.parametrize(
    ("text", "code", "says"),
    [
        ("splat: {iteration: 5}", 2, "there is no setting splat.iteration (similar: splat.iterations)"),
        ("splat: {iterations: 0}", 2, "splat.iterations must be a whole number at least 1"),
        ("frames: {start: 5, end: 2}", 2, "end (2.0 s) is not after start (5.0 s)"),
        ("sfm: {kind: Nothing}", 2, "sfm.kind must be one of"),
        ("frames", 2, "the whole must be a mapping of settings"),
        ("a: [", 3, "no YAML"),
    ],
)
def test_a_mistake_names_the_file_and_the_setting(
    text: str, code: int, says: str, tmp_path: Path, capsys: pytest.CaptureFixture[str], asked: list[RunSettings]
):
    path = tmp_path / "mine.yaml"
    path.write_text(text)
    given, message = refused(capsys, "run", "dive", "--out", "run", "--config", str(path))
    assert given == code, message
    assert str(path) in message
    assert says in message
    assert "Try:" in message
    assert not asked


def test_a_missing_file_is_exit_3_and_a_preset_beside_it_exit_2(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], asked: list[RunSettings]
):
    missing = ("run", "dive", "--out", "run", "--config", str(tmp_path / "none.yaml"))
    code, message = refused(capsys, *missing)
    assert code == 3
    assert "none.yaml is missing" in message
    code, message = refused(capsys, *missing, "--preset", "fast")
    assert code == 2
    assert "--preset and --config exclude each other" in message


@pytest.fixture
def dive(tmp_path: Path) -> Path:
    for i in range(3):
        write_rgb(tmp_path / "dive" / f"{i}.png", np.random.default_rng(i).random((24, 32, 3)))
    return tmp_path / "dive"


def test_quiet_prints_the_results_alone(dive: Path, capsys: pytest.CaptureFixture[str]):
    for words in (["-q", "prepare"], ["prepare", "--quiet"]):
        main([*words, str(dive), "--out", str(dive.parent / words[0])])
        told = capsys.readouterr()
        assert told.err == ""
        assert "Results in" in told.out
        assert "Next" not in told.out


def test_quiet_still_prints_errors(tmp_path: Path, capsys: pytest.CaptureFixture[str]):
    code, message = refused(capsys, "run", str(tmp_path / "none.mp4"), "-q", "-o", str(tmp_path / "run"))
    assert code == 3
    assert "none.mp4" in message


def test_verbose_adds_times_and_modules_and_no_traceback_of_a_mistake(
    dive: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
):
    main(["prepare", str(dive), "-v", "-o", str(dive.parent / "run")])
    assert logging.getLogger("swimm3r").level == logging.DEBUG
    code, message = refused(capsys, "run", str(dive / "none"), "-v", "-o", "run")
    assert code == 3
    assert "Traceback" not in message
    code, message = refused(capsys, "run", str(dive), "-v", "-q", "-o", "run")
    assert code == 2
    assert "--quiet and --verbose exclude each other" in message
