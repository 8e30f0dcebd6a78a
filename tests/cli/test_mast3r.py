"""`--backend mast3r` from the command line: a tiny checkpoint through everything, and files that are no checkpoint."""

import argparse
import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
import torch

from swimm3r.cli.main import main
from swimm3r.scene.reconstruction_io import load_reconstruction
from swimm3r.sfm.mast3r import checkpoint
from swimm3r.sfm.mast3r.network import Architecture, Mast3r
from swimm3r.synthetic import DiveSettings, write_dive

TINY = Architecture(
    encoder_dim=32, encoder_depth=2, encoder_heads=1, decoder_dim=32, decoder_depth=4, decoder_heads=1,
    dpt_layer_dims=(4, 4, 4, 4), dpt_feature_dim=4, dpt_last_dims=(4, 4), local_hidden_dim=32, descriptor_dim=6,
)  # fmt: skip
LENIENT = (  # random weights agree with nothing: what is wrong everywhere must not be thrown away
    *("--size", "64", "--max-error", "1e9", "--min-confidence", "0", "--min-matches", "1"),
    *("--alignment.coarse-iterations", "20", "--alignment.fine-iterations", "20"),
)


@pytest.fixture(scope="module")
def clip(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("clip") / "dive"
    write_dive(DiveSettings(frames=5, width=64, height=48), folder)
    return folder


@pytest.fixture(scope="module")
def weights(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Random weights of the published shape."""
    path = tmp_path_factory.mktemp("weights") / "tiny.safetensors"
    with torch.random.fork_rng():
        torch.manual_seed(0)
        checkpoint.save(Mast3r(TINY), path)
    return path


def outcome(capsys: pytest.CaptureFixture[str], *arguments: object) -> tuple[int, str]:
    code = 0
    try:
        main([str(argument) for argument in arguments])
    except SystemExit as stop:
        code = int(stop.code or 0)
    return code, capsys.readouterr().err


def test_a_checkpoint_goes_from_the_clip_to_the_record(
    clip: Path,
    weights: Path,
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
    caplog: pytest.LogCaptureFixture,
):
    run = tmp_path / "run"
    command = ("sfm", clip, "--out", run, "--backend", "mast3r", "--weights", weights, "--graph", "video-2-1", *LENIENT)
    code, said = outcome(capsys, *command)
    assert code == 0, said
    assert "Plan: 4 frames, up to 6 pairs" in caplog.text
    assert "two-view network" in said
    summary = json.loads((run / "summary.json").read_text())
    assert summary["sfm"]["backend"] == "mast3r"
    assert summary["sfm"]["registered"] == summary["sfm"]["frames"] == 4
    rec = load_reconstruction(run / "sfm")
    assert len(rec.matches.i) > 0
    assert (rec.cameras.width, rec.cameras.height) == (64, 48)
    assert "graph: video-2-1" in (run / "settings.yaml").read_text()
    assert not (run / "sfm" / "mast3r").exists()


def not_there(folder: Path, good: Path) -> Path:
    return folder / "missing.pth"


def truncated(folder: Path, good: Path) -> Path:
    path = folder / "half.safetensors"
    path.write_bytes(good.read_bytes()[: good.stat().st_size // 2])
    return path


def cut_archive(folder: Path, good: Path) -> Path:
    whole = folder / "whole.pth"
    checkpoint.save(checkpoint.load(good), whole)
    path = folder / "half.pth"
    path.write_bytes(whole.read_bytes()[: whole.stat().st_size // 2])
    return path


class _Code:
    def __reduce__(self) -> tuple:
        return print, ("this must never run",)


def carries_code(folder: Path, good: Path) -> Path:
    path = folder / "code.pth"
    torch.save({"args": argparse.Namespace(model="x"), "model": {"a": torch.zeros(1)}, "extra": _Code()}, path)
    return path


def of_another_model(folder: Path, good: Path) -> Path:
    path = folder / "other.pth"
    torch.save({"model": {"conv.weight": torch.zeros(3, 3)}}, path)
    return path


def of_wrong_sizes(folder: Path, good: Path) -> Path:
    state, _ = checkpoint.read(good)
    state["dec_blocks.1.attn.proj.weight"] = torch.zeros(32, 31)
    path = folder / "sizes.pth"
    torch.save({"model": state}, path)
    return path


def not_a_number(folder: Path, good: Path) -> Path:
    model = checkpoint.load(good)
    last: Any = model.downstream_head1.dpt.head[4]
    last.bias.fill_(torch.nan)
    path = folder / "nan.safetensors"
    checkpoint.save(model, path)
    return path


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (not_there, "there are no weights at"),
        (truncated, "half.safetensors cannot be read"),
        (cut_archive, "half.pth cannot be read: it is not a complete torch archive"),
        (carries_code, "holds more than weights, and was not opened"),
        (of_another_model, "not of the DUSt3R family"),
        (of_wrong_sizes, "dec_blocks.1.attn.proj.weight has shape (32, 31), the network needs (32, 32)"),
        (not_a_number, "pointmap is not finite at 3,072 of 3,072 pixels"),
    ],
)
def test_a_checkpoint_that_cannot_be_used_is_exit_4(
    make: Callable[[Path, Path], Path],
    message: str,
    clip: Path,
    weights: Path,
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
):
    bad = make(tmp_path, weights)
    command = ("sfm", clip, "--out", tmp_path / "run", "--backend", "mast3r", "--weights", bad, "--graph", "swin-1")
    code, said = outcome(capsys, *command, *LENIENT)
    assert code == 4
    assert message in said
    assert "Try:" in said
    assert "this must never run" not in said


def test_no_weights_at_all_is_exit_4_before_anything_is_prepared(
    clip: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
):
    monkeypatch.setenv("SWIMM3R_WEIGHTS_DIR", str(tmp_path / "nothing"))
    monkeypatch.setenv("SWIMM3R_CACHE", str(tmp_path / "nothing"))
    code, said = outcome(capsys, "run", clip, "--out", tmp_path / "run", "--backend", "mast3r")
    assert code == 4
    assert "swimm3r weights get mast3r --accept-license" in said
    assert not (tmp_path / "run").exists()


@pytest.mark.parametrize(
    ("options", "message"),
    [
        (("--graph", "vidoe"), "there is no pair graph 'vidoe'"),
        (("--focal", "2.8"), "a focal length of 2.8 px does not fit"),
        (("--camera", "OPENCV"), "must be known before the network sees its images"),
        (("--alignment.intrinsics", "fixed"), "none are known"),
    ],
    ids=lambda value: value[0] if isinstance(value, tuple) else "",
)
def test_options_that_contradict_each_other_are_exit_2(
    options: tuple[str, str],
    message: str,
    clip: Path,
    weights: Path,
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
):
    command = ("sfm", clip, "--out", tmp_path / "run", "--backend", "mast3r", "--weights", weights, *LENIENT)
    code, said = outcome(capsys, *command, *options)
    assert code == 2
    assert message in said


def test_the_back_end_decides_which_options_there_are(capsys: pytest.CaptureFixture[str]):
    shown = {}
    for backend in ("colmap", "mast3r"):
        with pytest.raises(SystemExit):
            main(["sfm", f"--backend={backend}", "--help-all"])
        shown[backend] = capsys.readouterr().out
    assert "--graph" in shown["mast3r"]
    assert "--graph" not in shown["colmap"]
    assert "--depth.planes" in shown["colmap"]
    assert "--depth.planes" not in shown["mast3r"]
