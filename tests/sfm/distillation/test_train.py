"""A whole training from its command: recipes, trees of pairs, and what it writes."""

import sys
from dataclasses import replace
from pathlib import Path
from types import ModuleType
from typing import Any

import numpy as np
import pytest
import tifffile
import torch
from tests.sfm.distillation.training import BASE, SETTINGS, learned, nothing, rows

from swimm3r.cli.train_sfm import TrainingRecipeName
from swimm3r.datasets import PairSettings, make_pairs, read_tree
from swimm3r.errors import InputError, UsageError
from swimm3r.io.images import write_rgb
from swimm3r.sfm.distillation.loop import train
from swimm3r.sfm.distillation.pairs import PairData, split_data
from swimm3r.sfm.distillation.settings import RECIPES
from swimm3r.sfm.distillation.state import MetricsSums
from swimm3r.sfm.distillation.train import retrieved_pairs
from swimm3r.sfm.mast3r import checkpoint
from swimm3r.sfm.mast3r.network import Mast3r
from swimm3r.sfm.mast3r.settings import ObjectiveSettings
from swimm3r.sfm.student import adapter_file
from swimm3r.sfm.student.adapter_file import fingerprint
from swimm3r.sfm.student.student import new_student


def test_the_recipes_are_the_papers_system_its_ablations_and_dark3r():
    assert set(RECIPES) == set(TrainingRecipeName.__args__)
    full = RECIPES["swimm3r"]
    assert (full.learning_rate, full.weight_decay, full.epochs, full.batch, full.water_probability) == (
        5e-4, 1e-4, 20, 4, 0.5,
    )  # fmt: skip
    for name in ("forward", "inverse", "saturation"):
        ablated = RECIPES[f"without-{name}"].objective
        assert ablated == replace(full.objective, **{name: 0.0})
    assert RECIPES["without-augmentation"] == replace(full, water_probability=0.0)
    alone = RECIPES["distillation-only"]
    assert not alone.objective.physics
    assert alone == replace(full, objective=alone.objective, water_probability=0.0)
    dark = RECIPES["dark3r"].objective
    assert (dark.clean, dark.physics) == (0.3, False)


@pytest.mark.parametrize("recipe", ["distillation-only", "dark3r"])
def test_without_physics_there_is_no_head(
    network: Mast3r, eight: PairData, none: PairData, tmp_path: Path, recipe: str
):
    settings = replace(SETTINGS, objective=RECIPES[recipe].objective, epochs=1)
    path = train(network, BASE, eight, none, settings, tmp_path, nothing)
    assert not [name for name in learned(path) if name.startswith("head.")]
    last = rows(tmp_path)[-1]
    assert last["forward"] == last["inverse"] == last["anchor"] == 0
    assert last["encoder"] > 0
    assert (last["clean"] == 0) == (recipe == "distillation-only")


def test_before_its_first_step_the_student_is_the_teacher(network: Mast3r, eight: PairData):
    student = new_student(network, SETTINGS.lora, ObjectiveSettings(), 0)
    item = eight.item(0, 0.0, torch.Generator())
    batch = {name: getattr(item, name)[None] for name in ("clean", "ray_depth", "valid", "sampled_medium")}
    same = student(raw=item.clean[None], **batch)
    assert same["encoder"] == same["decoder"] == same["descriptors"] == 0
    assert student(raw=item.raw[None], **batch)["encoder"] > 0
    student.adapters.detach()


def test_one_epoch_on_a_tree_in_flseas_layout_runs_from_the_command_line(
    network: Mast3r, dives: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
):
    from swimm3r.cli.main import main

    rng = np.random.default_rng(0)
    for region, name in (("canyons", "flatiron"), ("red_sea", "pier_path"), ("canyons", "tiny_canyon")):
        folder = tmp_path / "archive" / region / name / name
        for k in range(5):
            stamp = 16233051861828957 + k * 5_000_000
            for kind, end in (("imgs", ""), ("seaErra", "_SeaErra")):
                (folder / kind).mkdir(parents=True, exist_ok=True)
                values = rng.integers(0, 255, (38, 60, 3), dtype=np.uint8).repeat(2, 0).repeat(2, 1)
                tifffile.imwrite(folder / kind / f"{stamp}{end}.tiff", values)
            (folder / "depth").mkdir(exist_ok=True)
            depth = rng.uniform(1, 5, (76, 120)).astype(np.float32)
            tifffile.imwrite(folder / "depth" / f"{stamp}_SeaErra_abs_depth.tif", depth)
    weights = tmp_path / "small.safetensors"
    checkpoint.save(network, weights)
    out = tmp_path / "out"
    main(
        ["train-sfm", str(tmp_path / "archive"), "--out", str(out), "--weights", str(weights), "--device", "cpu",
         "--epochs", "1", "--size", "64", "--validation", "2", "--base-license", "made in a test"]
    )  # fmt: skip
    told = capsys.readouterr()
    assert "Adapter:" in told.out
    # two training sequences of five shots half a second apart, 4 + 3 + 1 pairs each; two held back, none of a test dive
    assert "14 pairs, 3 steps" in told.err
    (validation,) = (row["validation"] for row in rows(out) if "validation" in row)
    assert validation["depth_absrel"] > 0
    assert validation["rotation_deg"] is None  # FLSea has no poses
    header = adapter_file.describe(out / "adapter.safetensors")
    assert header["base"]["license"] == "made in a test"
    assert header["base"]["sha256"] == fingerprint(network.state_dict())


def test_shots_that_look_alike_far_apart_are_paired_where_poses_do_not_tell(network: Mast3r, tmp_path: Path):
    rng = np.random.default_rng(0)
    places = [rng.integers(0, 255, (12, 16, 3), dtype=np.uint8).repeat(4, 0).repeat(4, 1) for _ in range(6)]
    for k, place in enumerate([0, 1, 2, 3, 4, 5, 0, 1]):  # the dive comes back to where it began
        for kind in ("raw", "clean"):
            write_rgb(tmp_path / kind / f"{k}.png", places[place])
    (sequence,) = read_tree(tmp_path).sequences
    settings = PairSettings(reach=4, retrieved=1)
    known = make_pairs(sequence, settings)
    found = {(p.i, p.j) for p in retrieved_pairs(network, sequence, known, settings, 64)}
    assert {(0, 6), (1, 7)} <= found
    assert all(j - i >= 4 for i, j in found)
    told = [replace(pair, overlap=0.5) for pair in known]
    assert retrieved_pairs(network, sequence, told, settings, 64) == []


def test_tensorboard_gets_every_number_of_a_row_and_is_asked_for_where_it_is_missing(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
):
    written: list[tuple[str, float, int]] = []

    class Writer:
        def __init__(self, folder: str) -> None:
            assert folder == str(tmp_path / "board")

        def add_scalar(self, name: str, value: float, step: int) -> None:
            written.append((name, value, step))

        def flush(self) -> None:
            pass

    module: Any = ModuleType("torch.utils.tensorboard.writer")
    module.SummaryWriter = Writer
    monkeypatch.setitem(sys.modules, "torch.utils.tensorboard", ModuleType("torch.utils.tensorboard"))
    monkeypatch.setitem(sys.modules, "torch.utils.tensorboard.writer", module)
    MetricsSums(tmp_path / "metrics.jsonl", tmp_path / "board").append(
        {"step": 3, "loss": 0.5, "validation": {"a": 1.0, "b": None}}
    )
    assert written == [("loss", 0.5, 3), ("validation/a", 1.0, 3)]
    monkeypatch.setitem(sys.modules, "torch.utils.tensorboard.writer", None)
    with pytest.raises(UsageError, match="package tensorboard"):
        MetricsSums(tmp_path / "metrics.jsonl", tmp_path / "board")


def test_training_without_a_clean_image_anywhere_says_so(network: Mast3r, tmp_path: Path):
    for k in range(3):
        write_rgb(
            tmp_path / "flatiron" / "imgs" / f"{16233051861828957 + k * 5_000_000}.png", np.zeros((8, 8, 3), np.uint8)
        )
    sequences = read_tree(tmp_path).sequences
    with pytest.raises(InputError, match="no pair"):
        split_data(sequences, [make_pairs(s, PairSettings()) for s in sequences], 64, 0, 0)
