"""Exit codes and messages, as a user meets them."""

import json
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from swimm3r.cli.main import main
from swimm3r.splat.settings import RECIPES, recipe_of


def outcome(capsys: pytest.CaptureFixture[str], *arguments: str) -> tuple[int, str]:
    with pytest.raises(SystemExit) as stop:
        main(arguments)
    return stop.value.code, capsys.readouterr().err


def test_a_missing_input_is_exit_3_with_cause_and_advice(capsys: pytest.CaptureFixture[str], tmp_path: Path):
    code, message = outcome(capsys, "run", str(tmp_path / "dive.mp4"), "--out", str(tmp_path / "run"))
    assert code == 3
    assert "dive.mp4" in message
    assert "Likely cause:" in message
    assert "Try:" in message
    assert not (tmp_path / "run").exists()


def test_an_unknown_option_is_exit_2(capsys: pytest.CaptureFixture[str], tmp_path: Path):
    assert outcome(capsys, "run", str(tmp_path), "--out", str(tmp_path), "--fsp", "5")[0] == 2


def test_half_a_colmap_model_is_exit_2(capsys: pytest.CaptureFixture[str], tmp_path: Path):
    code, message = outcome(capsys, "splat", "--colmap", str(tmp_path), "--out", str(tmp_path / "run"))
    assert code == 2
    assert "--images" in message


@pytest.mark.parametrize("command", ["eval", "render", "export", "localize"])
def test_a_folder_without_a_map_is_exit_3(command: str, capsys: pytest.CaptureFixture[str], tmp_path: Path):
    code, message = outcome(capsys, command, str(tmp_path))
    assert code == 3
    assert "Try:" in message


def test_ctrl_c_is_exit_130_and_says_that_nothing_is_lost(
    capsys: pytest.CaptureFixture[str], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
):
    def interrupted(*_: object, **__: object) -> None:
        raise KeyboardInterrupt

    monkeypatch.setattr("swimm3r.run.run_pipeline", interrupted)
    code, message = outcome(capsys, "run", str(tmp_path), "--out", str(tmp_path / "run"))
    assert code == 130
    assert "goes on from here" in message


def test_output_that_nobody_reads_on_is_no_fault():
    """As of `swimm3r run --help | head`."""
    command = [sys.executable, "-m", "swimm3r", "run", "--help"]
    with subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True) as process:
        process.stdout.close()
        assert process.stderr.read() == ""
    assert process.returncode == 141


def test_a_folder_that_cannot_be_written_is_exit_7(capsys: pytest.CaptureFixture[str], tmp_path: Path):
    (tmp_path / "pictures").mkdir()
    (tmp_path / "pictures" / "a.png").write_bytes(b"")
    code, message = outcome(capsys, "run", str(tmp_path / "pictures"), "--out", "/sys/run")
    assert code == 7
    assert "/sys" in message


def test_the_preset_sets_the_defaults(capsys: pytest.CaptureFixture[str]):
    shown = {}
    for preset in ("fast", "best"):
        with pytest.raises(SystemExit):
            main(["run", "--preset", preset, "--help"])
        shown[preset] = capsys.readouterr().out
    assert shown["fast"] != shown["best"]


def test_a_recipe_and_a_transforms_json_reach_the_pipeline(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    document = {
        "w": 64, "h": 48, "fl_x": 60,
        "frames": [{"file_path": f"images/{k}.png", "transform_matrix": np.eye(4).tolist()} for k in range(3)],
    }  # fmt: skip
    (tmp_path / "transforms.json").write_text(json.dumps(document))
    asked = []
    monkeypatch.setattr("swimm3r.run.run_pipeline", lambda *given, **_: asked.append(given) or {})
    monkeypatch.setattr("swimm3r.cli.run.print_summary", lambda *_: None)
    for recipe in RECIPES:
        main(["splat", "--transforms", str(tmp_path / "transforms.json"), "--recipe", recipe, "--out", "run"])
        source, _, settings = asked[-1]
        assert source == tmp_path / "images"
        assert settings.sfm.model == tmp_path / "transforms.json"
        assert recipe_of(settings.splat) == recipe


def test_two_models_at_once_are_exit_2(capsys: pytest.CaptureFixture[str], tmp_path: Path):
    models = ("--colmap", str(tmp_path), "--transforms", str(tmp_path / "t.json"), "--images", str(tmp_path))
    assert outcome(capsys, "splat", *models, "--out", str(tmp_path / "run"))[0] == 2
