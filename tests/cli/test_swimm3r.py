"""`--backend swimm3r --adapter FILE`: a tiny adapter trained on a dive, then used on it."""

import json
from pathlib import Path

import pytest
import torch

from swimm3r.cli.main import main
from swimm3r.io import medium_json
from swimm3r.io.files.damage import remake
from swimm3r.scene.reconstruction_io import load_reconstruction
from swimm3r.sfm.mast3r import checkpoint
from swimm3r.sfm.mast3r.network import Architecture, Mast3r
from swimm3r.synthetic import DiveSettings, write_dive

TINY = Architecture(
    encoder_dim=32, encoder_depth=2, encoder_heads=1, decoder_dim=32, decoder_depth=4, decoder_heads=1,
    dpt_layer_dims=(4, 4, 4, 4), dpt_feature_dim=4, dpt_last_dims=(4, 4), local_hidden_dim=32, descriptor_dim=6,
)  # fmt: skip
LENIENT = (  # random weights agree with nothing: what is wrong everywhere must not be thrown away
    *("--size", "64", "--max-error", "1e9", "--min-confidence", "0", "--min-matches", "1", "--graph", "video-2-1"),
    *("--alignment.coarse-iterations", "20", "--alignment.fine-iterations", "20"),
)


@pytest.fixture(scope="module")
def place(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A dive, weights of the published shape, another network's, and an adapter of the first."""
    folder = tmp_path_factory.mktemp("swimm3r")
    write_dive(DiveSettings(frames=5, width=64, height=48), folder / "data" / "dive")
    with torch.random.fork_rng():
        for seed, name in enumerate(("tiny", "other")):
            torch.manual_seed(seed)
            checkpoint.save(Mast3r(TINY), folder / f"{name}.safetensors")
    settings = "--size 64 --epochs 1 --validation 0 --pairs.min-overlap 0.1 --device cpu"
    given = [str(folder / "data"), "--out", str(folder / "student"), "--weights", str(folder / "tiny.safetensors")]
    main(["train-sfm", *given, *settings.split()])
    return folder


def outcome(capsys: pytest.CaptureFixture[str], *arguments: object) -> tuple[int, str]:
    code = 0
    try:
        main([str(argument) for argument in arguments])
    except SystemExit as stop:
        code = int(stop.code or 0)
    return code, capsys.readouterr().err


def test_the_students_water_restores_the_dive(place: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]):
    run = tmp_path / "run"
    code, said = outcome(
        capsys, "sfm", place / "data" / "dive", "--out", run, "--backend", "swimm3r", "--device", "cpu",
        "--weights", place / "tiny.safetensors", "--adapter", place / "student" / "adapter.safetensors", *LENIENT,
    )  # fmt: skip
    assert code == 0, said
    summary = json.loads((run / "summary.json").read_text())
    assert summary["sfm"]["backend"] == "swimm3r"
    rec = load_reconstruction(run / "sfm")
    assert len(list((run / "sfm" / "water").glob("*.npz"))) == len(rec.names) == 4
    fit = medium_json.read_fits(run / "sfm" / "medium.json", remake(run / "sfm"))["stored"]
    assert ((fit.Binf > 0) & (fit.Binf < 1)).all()
    assert (fit.beta_D > 0).all()
    assert len(list((run / "sfm" / "restored").glob("*.png"))) == 4
    assert (run / "sfm" / "points.ply").is_file()


@pytest.mark.parametrize(
    ("options", "code", "what"),
    [
        ((), 2, "needs --adapter"),
        (("--adapter", "nowhere.safetensors"), 4, "nowhere.safetensors"),
        (("--adapter", "tiny.safetensors"), 4, "cannot be used as an adapter"),
    ],
)
def test_a_missing_or_foreign_adapter_is_told_before_anything_runs(
    place: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str], options: tuple[str, ...], code: int, what: str
):
    given = [place / o if o.endswith(".safetensors") else o for o in options]
    found, said = outcome(
        capsys, "sfm", place / "data" / "dive", "--out", tmp_path / "run", "--backend", "swimm3r",
        "--weights", place / "tiny.safetensors", *given,
    )  # fmt: skip
    assert (found, what in said) == (code, True), said
    assert not (tmp_path / "run").exists()


def test_an_adapter_of_other_weights_is_refused(place: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]):
    code, said = outcome(
        capsys, "sfm", place / "data" / "dive", "--out", tmp_path / "run", "--backend", "swimm3r", "--device", "cpu",
        "--weights", place / "other.safetensors", "--adapter", place / "student" / "adapter.safetensors", *LENIENT,
    )  # fmt: skip
    assert code == 4
    assert "it was trained on tiny.safetensors" in said
