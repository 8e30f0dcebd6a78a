"""Exit codes and messages, as a user meets them."""

import json
import shlex
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from swimm3r.cli.main import main
from swimm3r.errors import InputError
from swimm3r.io.images import write_mask, write_rgb
from swimm3r.localization.batch import localize_run
from swimm3r.splat.settings import RECIPES


def outcome(capsys: pytest.CaptureFixture[str], *arguments: str) -> tuple[int, str]:
    with pytest.raises(SystemExit) as stop:
        main(arguments)
    assert isinstance(stop.value.code, int)
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


LENS = "1 PINHOLE 96 64 80 80 48 32"


@pytest.mark.parametrize(
    ("lens", "options", "code", "message"),
    [
        ("1 PINHOLE 64 64 80 80 32 32", (), 3, "64x64, and the prepared frames are 96x64"),
        ("1 PINHOLE 96 64 -80 80 48 32", (), 3, "focal lengths of -80"),
        ("1 FOV 96 64 80 80 48 32 0.9", (), 3, "the model FOV"),
        ("PINHOLE 80,80,48,32", (), 2, "--calibration-size WIDTH HEIGHT"),
        (f"{LENS}\n2 PINHOLE 96 64 81 81 48 32", (), 2, "--calibration-camera 1"),
        (LENS, ("--focal", "80"), 2, "--calibration and --focal exclude each other"),
        (LENS, ("--calibration-size", "960", "640"), 2, "--calibration-size says 960x640"),
    ],
)
def test_a_calibration_that_does_not_fit_is_told_with_its_exit_code(
    lens: str, options: tuple[str, ...], code: int, message: str, capsys: pytest.CaptureFixture[str], tmp_path: Path
):
    (tmp_path / "dive").mkdir()
    for i in range(3):
        image = np.random.default_rng(i).random((64, 96, 3)).astype(np.float32)
        write_rgb(tmp_path / "dive" / f"{i}.png", image)
    (tmp_path / "lens.txt").write_text(lens)
    command = ("sfm", str(tmp_path / "dive"), "--out", str(tmp_path / "run"))
    found, said = outcome(capsys, *command, "--calibration", str(tmp_path / "lens.txt"), *options)
    assert (found, message in said) == (code, True), said


def test_chunks_that_share_all_their_frames_are_exit_2(capsys: pytest.CaptureFixture[str], tmp_path: Path):
    command = ("run", str(tmp_path / "dive"), "--out", str(tmp_path / "run"), "--mapping.chunk-frames", "8")
    code, message = outcome(capsys, *command, "--mapping.chunk-overlap", "8")
    assert code == 2
    assert "chunks of 8 frames cannot share 8" in message


def test_half_a_colmap_model_is_exit_2(capsys: pytest.CaptureFixture[str], tmp_path: Path):
    code, message = outcome(capsys, "splat", "--colmap", str(tmp_path), "--out", str(tmp_path / "run"))
    assert code == 2
    assert "--images" in message


@pytest.mark.parametrize("command", ["eval", "render", "export", "localize", "report"])
def test_a_folder_without_a_run_is_exit_3(command: str, capsys: pytest.CaptureFixture[str], tmp_path: Path):
    code, message = outcome(capsys, command, str(tmp_path))
    assert code == 3
    assert "Try:" in message


def test_ctrl_c_is_exit_130_and_says_that_nothing_is_lost(
    capsys: pytest.CaptureFixture[str], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
):
    def interrupted(*_: object, **__: object) -> None:
        raise KeyboardInterrupt

    monkeypatch.setattr("swimm3r.pipeline.run.run_pipeline", interrupted)
    code, message = outcome(capsys, "run", str(tmp_path), "--out", str(tmp_path / "run"))
    assert code == 130
    assert "resumes from here" in message


def test_ctrl_c_of_a_command_that_starts_over_does_not_say_that_it_resumes(
    capsys: pytest.CaptureFixture[str], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
):
    def interrupted(*_: object, **__: object) -> None:
        raise KeyboardInterrupt

    monkeypatch.setattr("swimm3r.scene.run_folder.open_run", interrupted)
    code, message = outcome(capsys, "localize", str(tmp_path), "--stream", str(tmp_path))
    assert code == 130
    assert "Interrupted." in message
    assert "resumes" not in message


@pytest.mark.parametrize(
    ("words", "refused"),
    [
        ("--follow", "--follow"),
        ("a.png --fps 2 --tum", "--fps, --tum"),
        ("--tracking.keypoints 500", "--tracking.keypoints"),
        ("--stream in --candidates 3", "--candidates"),
        ("--stream in --idle 3 --latest", "--idle, --latest"),
        ("--lens a.json --rig-camera left", "both --lens and --rig-camera"),
    ],
)
def test_options_of_localize_that_would_change_nothing_are_exit_2(
    words: str, refused: str, capsys: pytest.CaptureFixture[str], tmp_path: Path
):
    code, message = outcome(capsys, "localize", str(tmp_path), *words.split())
    assert code == 2
    assert refused in message


@pytest.mark.parametrize(
    "error", [MemoryError(), RuntimeError("can't start new thread"), OSError(12, "Cannot allocate")]
)
def test_running_out_of_memory_is_exit_5_with_advice(
    error: Exception, capsys: pytest.CaptureFixture[str], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
):
    def exhausted(*_: object, **__: object) -> None:
        raise error

    monkeypatch.setattr("swimm3r.pipeline.run.run_pipeline", exhausted)
    code, message = outcome(capsys, "run", str(tmp_path), "--out", str(tmp_path / "run"))
    assert code == 5
    assert "memory" in message
    assert "Try:" in message


def test_output_that_nobody_reads_on_is_no_fault():
    """As of `swimm3r run --help | head`."""
    command = [sys.executable, "-m", "swimm3r", "run", "--help"]
    with subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True) as process:
        process.stdout.close()
        assert process.stderr.read() == ""
    assert process.returncode == 141


def test_a_folder_that_cannot_be_written_is_exit_7(capsys: pytest.CaptureFixture[str], tmp_path: Path):
    (tmp_path / "images").mkdir()
    (tmp_path / "images" / "a.png").write_bytes(b"")
    code, message = outcome(capsys, "run", str(tmp_path / "images"), "--out", "/sys/run")
    assert code == 7
    assert "/sys" in message


def test_the_preset_sets_the_defaults(capsys: pytest.CaptureFixture[str]):
    shown = {}
    for preset in ("fast", "best"):
        with pytest.raises(SystemExit):
            main(["run", "--preset", preset, "--help-all"])
        shown[preset] = capsys.readouterr().out
    assert shown["fast"] != shown["best"]


def test_a_recipe_and_a_transforms_json_reach_the_pipeline(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    document = {
        "w": 64, "h": 48, "fl_x": 60,
        "frames": [{"file_path": f"images/{k}.png", "transform_matrix": np.eye(4).tolist()} for k in range(3)],
    }  # fmt: skip
    (tmp_path / "transforms.json").write_text(json.dumps(document))
    write_rgb(tmp_path / "images" / "0.png", np.zeros((48, 64, 3)))
    asked = []
    monkeypatch.setattr("swimm3r.pipeline.run.run_pipeline", lambda *given, **_: asked.append(given) or {})
    monkeypatch.setattr("swimm3r.cli.pipeline.stages.print_summary", lambda *_: None)
    for recipe in RECIPES:
        main(["splat", "--transforms", str(tmp_path / "transforms.json"), "--recipe", recipe, "--out", "run"])
        source, _, settings = asked[-1]
        assert source == tmp_path / "images"
        assert settings.sfm.model == tmp_path / "transforms.json"
        assert settings.splat.recipe == recipe


def test_two_models_at_once_are_exit_2(capsys: pytest.CaptureFixture[str], tmp_path: Path):
    models = ("--colmap", str(tmp_path), "--transforms", str(tmp_path / "t.json"), "--images", str(tmp_path))
    assert outcome(capsys, "splat", *models, "--out", str(tmp_path / "run"))[0] == 2


@pytest.mark.parametrize(("words", "shows"), [([], "localize"), (["bench"], "ablation-uwbs"), (["weights"], "verify")])
def test_without_a_command_the_help_is_shown_and_it_is_exit_2(
    words: list[str], shows: str, capsys: pytest.CaptureFixture[str]
):
    with pytest.raises(SystemExit) as stop:
        main(words)
    assert stop.value.code == 2
    assert shows in capsys.readouterr().out


def test_what_may_not_be_read_is_exit_3_and_what_may_not_be_written_7(
    capsys: pytest.CaptureFixture[str], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
):
    (tmp_path / "closed").mkdir(0o000)
    for where, readable, expected in ((tmp_path / "closed", False, 3), (tmp_path, True, 7)):

        def refused(*_: object, where: Path = where) -> None:
            raise PermissionError(13, "Permission denied", str(where / "file"))

        monkeypatch.setattr("swimm3r.report.write_report", refused)
        monkeypatch.setattr("os.access", lambda *_, readable=readable, **__: readable)  # root may read everything
        code, message = outcome(capsys, "report", str(tmp_path))
        assert code == expected
        assert f"cannot {'write' if readable else 'read'}" in message


WRONG_PATHS = {
    "colmap": (("splat", "--images", "{dive}", "--colmap", "{nowhere}"), 3),
    "transforms": (("splat", "--images", "{dive}", "--transforms", "{nowhere}"), 3),
    "transforms alone": (("splat", "--transforms", "{nowhere}"), 3),
    "images": (("splat", "--images", "{nowhere}", "--colmap", "{dive}"), 3),
    "weights": (("sfm", "{dive}", "--backend", "mast3r", "--weights", "{nowhere}"), 4),
    "reference": (("sfm", "{dive}", "--reference", "{nowhere}"), 3),
    "masks": (("sfm", "{dive}", "--masks", "{nowhere}"), 3),
}


@pytest.mark.parametrize("wrong", WRONG_PATHS)
def test_a_wrong_path_is_noticed_before_frames_are_prepared(
    wrong: str, capsys: pytest.CaptureFixture[str], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
):
    (tmp_path / "dive").mkdir()
    for i in range(3):
        write_rgb(tmp_path / "dive" / f"{i}.png", np.random.default_rng(i).random((24, 32, 3)))
    monkeypatch.setattr("swimm3r.pipeline.stages.read_frames", lambda *_, **__: pytest.fail("frames were prepared"))
    command, expected = WRONG_PATHS[wrong]
    given = [word.format(dive=tmp_path / "dive", nowhere=tmp_path / "nowhere.json") for word in command]
    code, message = outcome(capsys, *given, "--out", str(tmp_path / "run"))
    assert code == expected, message
    assert "nowhere.json" in message
    assert not (tmp_path / "run").exists()


def test_a_wrong_lens_or_image_is_noticed_before_the_map_is_read(tmp_path: Path):
    with pytest.raises(InputError, match=r"lens\.json"):
        localize_run(tmp_path, lens=tmp_path / "lens.json")
    with pytest.raises(InputError, match=r"none\.png"):
        localize_run(tmp_path, [tmp_path / "none.png"])


def test_prepare_says_what_it_used_where_it_is_and_what_comes_next(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], caplog: pytest.LogCaptureFixture
):
    dive = tmp_path / "a dive [of] many words whose path is longer than eighty columns would take on one line"
    for i in range(4):
        write_rgb(dive / f"{i}.png", np.random.default_rng(i).random((24, 32, 3)))
        write_mask(dive / "masks" / f"{i}.png", np.ones((24, 32), bool))
    write_mask(dive / "masks" / "[stranger].png", np.ones((24, 32), bool))
    main(["prepare", str(dive), "--out", str(tmp_path / "run")])
    assert any(told.startswith("Rough estimate for 4 frames of 32x24: frames ") for told in caplog.messages)
    assert any(told.startswith("Stage 1 of 1: frames (about ") for told in caplog.messages)
    told = capsys.readouterr().out.splitlines()
    assert told[0] == "4 frames of 32x24 (3 for training, 1 for testing, 4 with a mask)"
    assert told[1] == "! Masks: 4 of 4 frames have one; 1 masks match no frame ([stranger].png)."
    assert told[2] == f"Results in {tmp_path / 'run'}:"
    assert told[3].split() == ["prepare", "frames", "as", "they", "are", "used"]
    assert shlex.split(told[4].split(": ", 1)[1]) == ["swimm3r", "sfm", str(dive), "--out", str(tmp_path / "run")]


def test_the_doctor_tells_of_memory_disk_driver_and_weights(
    capsys: pytest.CaptureFixture[str], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
):
    monkeypatch.setenv("SWIMM3R_WEIGHTS_DIR", str(tmp_path / "weights"))
    monkeypatch.setenv("PATH", str(tmp_path))
    (tmp_path / "nvidia-smi").write_text("#!/bin/sh\necho '550.54, A GPU, 100 MiB, 90 MiB'\n")
    (tmp_path / "nvidia-smi").chmod(0o755)
    main(["doctor"])
    rows = {line[:24].strip(): line[25:] for line in capsys.readouterr().out.splitlines()}
    assert "free for this program" in rows["memory"]
    assert "GB free" in rows["disk here"]
    assert rows["GPU driver"] == "550.54, A GPU, 100 MiB, 90 MiB"
    assert rows["CUDA"]
    assert rows["warp-lang"]
    assert {name: rows[f"weights {name}"] for name in ("mast3r", "lpips-vgg")} == {
        "mast3r": "not here",
        "lpips-vgg": "not here",
    }


def test_weights_that_may_not_be_looked_at_are_listed_as_unknown(
    capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
):
    def refused(*_: object) -> None:
        raise PermissionError(13, "Permission denied", "/closed/weights")

    monkeypatch.setattr("swimm3r.weights.find", refused)
    main(["weights", "list"])
    assert "/closed/weights cannot be read" in capsys.readouterr().out
