"""Training: that it learns, that it goes on after a kill with the same bits, and that two processes are as one."""

import copy
import json
import os
import signal
import subprocess
import sys
from collections.abc import Callable
from dataclasses import astuple, replace
from pathlib import Path
from types import ModuleType, SimpleNamespace
from typing import Any

import numpy as np
import pytest
import tifffile
import torch

from swimm3r.cli.train_sfm import TrainingRecipeName
from swimm3r.datasets import PairSettings, make_pairs, read_tree
from swimm3r.errors import InputError, UsageError, WeightsError
from swimm3r.io.images import write_rgb
from swimm3r.medium import Medium
from swimm3r.sfm.distillation.loop import Workers, batch_size, learning_rate, pairs_of_step, train
from swimm3r.sfm.distillation.pairs import PairData, split_data
from swimm3r.sfm.distillation.settings import RECIPES, TrainSettings
from swimm3r.sfm.distillation.state import MetricsSums
from swimm3r.sfm.distillation.teacher_cache import TeacherCache
from swimm3r.sfm.distillation.train import retrieved_pairs, train_sfm
from swimm3r.sfm.distillation.validation import score, water_error
from swimm3r.sfm.mast3r import checkpoint
from swimm3r.sfm.mast3r.network import Mast3r
from swimm3r.sfm.mast3r.settings import ObjectiveSettings
from swimm3r.sfm.student import adapter_file
from swimm3r.sfm.student.adapter_file import Base, fingerprint
from swimm3r.sfm.student.student import Student, new_student
from swimm3r.synthetic import DiveSettings, write_dive

BASE = Base("small.safetensors", "0" * 64, "made in a test")
SETTINGS = TrainSettings(
    pairs=PairSettings(min_overlap=0.1, max_overlap=1.0), learning_rate=5e-3, epochs=2, size=64, log_every=1,
    checkpoint_every=1, validation=0, precision="float32",
)  # fmt: skip


@pytest.fixture(scope="module")
def network(make_small_network: Callable[[], Mast3r]) -> Mast3r:
    return make_small_network()


@pytest.fixture(scope="module")
def dive(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("data")
    write_dive(DiveSettings(frames=6, width=64, height=48, family="green"), folder / "green")
    return folder


@pytest.fixture(scope="module")
def eight(dive: Path) -> PairData:
    return pairs_of(dive)


@pytest.fixture(scope="module")
def none(eight: PairData) -> PairData:
    """Nothing to validate on."""
    return replace(eight, pairs=())


def pairs_of(folder: Path, count: int = 8) -> PairData:
    sequences = read_tree(folder).sequences
    pairs = [make_pairs(s, SETTINGS.pairs) for s in sequences]
    data, _ = split_data(sequences, pairs, SETTINGS.size, 0, count)
    assert len(data) == count
    return data


def nothing(student: Student, data: PairData) -> dict[str, float | None]:
    return {}


def rows(folder: Path) -> list[dict]:
    return [json.loads(line) for line in (folder / "metrics.jsonl").read_text().splitlines()]


def learned(path: Path) -> dict[str, torch.Tensor]:
    from safetensors.torch import load_file

    return load_file(path)


def test_eight_pairs_can_be_learned_by_heart(network: Mast3r, eight: PairData, none: PairData, tmp_path: Path):
    settings = replace(SETTINGS, epochs=20, checkpoint_every=1000, water_probability=0.0)
    train(network, BASE, eight, none, settings, tmp_path, nothing)
    per_step = rows(tmp_path)
    assert len(per_step) == 40

    def mean(name: str, part: slice) -> float:
        return float(np.mean([row[name] for row in per_step[part]]))

    first, last = slice(0, 6), slice(-6, None)
    assert mean("loss", last) < 0.6 * mean("loss", first)
    for name in ("forward", "inverse", "overshoot"):
        assert mean(name, last) < mean(name, first), name


def test_the_teacher_is_left_as_it_was(network: Mast3r, eight: PairData, none: PairData, tmp_path: Path):
    before = fingerprint(network.state_dict())
    train(network, BASE, eight, none, SETTINGS, tmp_path, nothing)
    assert fingerprint(network.state_dict()) == before
    image = eight.item(0, 0.0, torch.Generator()).clean
    tokens = network.encode(image).tokens
    again = adapter_file.load(tmp_path / "adapter.safetensors", network)
    with again.adapters.off():
        assert torch.equal(network.encode(image).tokens, tokens)  # the trained adapters no longer hung on it
    assert not torch.allclose(network.encode(image).tokens, tokens)
    again.adapters.detach()


KILLED = """
import os, signal, sys
from pathlib import Path
import torch
torch.set_num_threads(1)
from swimm3r.datasets import make_pairs, read_tree
from swimm3r.sfm.student.adapter_file import Base
from swimm3r.sfm.mast3r import checkpoint
from swimm3r.sfm.distillation.loop import train
from swimm3r.sfm.distillation.pairs import split_data
from swimm3r.datasets.settings import PairSettings
from swimm3r.sfm.distillation.settings import TrainSettings
from swimm3r.sfm.mast3r.settings import LoraSettings, ObjectiveSettings

def watch(what, done, total, /):
    if done == 3:
        os.kill(os.getpid(), signal.SIGKILL)

settings = eval(sys.argv[4])
sequences = read_tree(Path(sys.argv[1])).sequences
data, none = split_data(sequences, [make_pairs(s, settings.pairs) for s in sequences], settings.size, 0, 8)
network, base = checkpoint.load(Path(sys.argv[2])), Base(*eval(sys.argv[5]))
train(network, base, data, none, settings, Path(sys.argv[3]), lambda student, data: {}, progress=watch)
"""


@pytest.mark.skipif(sys.platform == "win32", reason="Windows has no kill -9")
def test_killed_and_started_again_it_ends_with_the_same_bits(
    network: Mast3r, dive: Path, eight: PairData, none: PairData, tmp_path: Path
):
    whole = train(network, BASE, eight, none, SETTINGS, tmp_path / "whole", nothing)
    settings = replace(SETTINGS, checkpoint_every=2)  # so that step 3 has to be done again
    cut, weights = tmp_path / "cut", tmp_path / "small.safetensors"
    checkpoint.save(network, weights)
    command = [sys.executable, "-c", KILLED, str(dive), str(weights), str(cut), repr(settings), repr(astuple(BASE))]
    died = subprocess.run(command, capture_output=True, text=True, env={**os.environ, "OMP_NUM_THREADS": "1"})
    assert died.returncode == -signal.SIGKILL, died.stderr[-2000:]
    assert [row["step"] for row in rows(cut)] == [1, 2, 3]
    with (cut / "metrics.jsonl").open("a") as torn:
        torn.write('{"step": 3, "validation": {"loss": 0.5}')
    resumed = train(network, BASE, eight, none, settings, cut, nothing)
    expected, found = learned(whole), learned(resumed)
    assert expected.keys() == found.keys()
    assert all(torch.equal(expected[name], found[name]) for name in expected)
    values = [
        [{k: v for k, v in r.items() if k != "seconds_per_step"} for r in rows(p.parent)] for p in (whole, resumed)
    ]
    assert values[0] == values[1]


def test_a_finished_training_is_not_done_again(network: Mast3r, eight: PairData, none: PairData, tmp_path: Path):
    path = train(network, BASE, eight, none, SETTINGS, tmp_path, nothing)
    before = (path.stat().st_mtime_ns, rows(tmp_path))
    train(network, BASE, eight, none, SETTINGS, tmp_path, nothing)
    assert (path.stat().st_mtime_ns, rows(tmp_path)) == before


def test_the_state_of_another_training_is_refused_not_overwritten(
    network: Mast3r, eight: PairData, none: PairData, tmp_path: Path
):
    train(network, BASE, eight, none, replace(SETTINGS, epochs=1), tmp_path, nothing)
    for other in (replace(SETTINGS, epochs=1, seed=1), replace(SETTINGS, epochs=1, water_probability=0.1)):
        with pytest.raises(InputError, match="other settings"):
            train(network, BASE, eight, none, other, tmp_path, nothing)
    (tmp_path / "state.safetensors").write_bytes(b"half a file")
    with pytest.raises(InputError, match="cannot go on"):
        train(network, BASE, eight, none, replace(SETTINGS, epochs=1), tmp_path, nothing)


def test_a_cached_teacher_is_asked_once_per_pair_and_teaches_the_same(
    network: Mast3r, eight: PairData, none: PairData, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
):
    asked = []
    whole = Student.teacher
    monkeypatch.setattr(Student, "teacher", lambda self, clean: asked.append(len(clean)) or whole(self, clean))
    cached = replace(SETTINGS, teacher_cache_mb=100)
    train(network, BASE, eight, none, cached, tmp_path / "cached", nothing)
    assert sum(asked) == len(eight) + SETTINGS.batch  # and once for the estimate
    train(network, BASE, eight, none, SETTINGS, tmp_path / "anew", nothing)
    one, other = (rows(tmp_path / name) for name in ("cached", "anew"))
    np.testing.assert_allclose([r["loss"] for r in one], [r["loss"] for r in other], rtol=1e-3)


def test_a_full_cache_computes_the_rest_and_a_damaged_file_anew(network: Mast3r, eight: PairData, tmp_path: Path):
    student = new_student(network, SETTINGS.lora, SETTINGS.objective, 0)
    clean = torch.stack([eight.item(k, 0.0, torch.Generator()).clean for k in range(2)])
    exact = student.teacher(clean)
    size = sum(value[:1].nbytes for level in vars(exact).values() for value in level) // 2
    cache = TeacherCache(tmp_path, size)
    first = cache.features(student, clean)
    (kept,) = tmp_path.glob("*.safetensors")
    kept.write_bytes(kept.read_bytes()[:100])
    again = TeacherCache(tmp_path, size).features(student, clean)
    student.adapters.detach()
    for level, one, other in zip(vars(exact).values(), vars(first).values(), vars(again).values(), strict=True):
        for e, a, b in zip(level, one, other, strict=True):
            torch.testing.assert_close(a, e, atol=2e-3, rtol=2e-3)
            assert torch.equal(a, b)


def test_accumulated_micro_batches_are_the_batch(network: Mast3r, eight: PairData, none: PairData, tmp_path: Path):
    settings = replace(SETTINGS, epochs=1)
    train(network, BASE, eight, none, settings, tmp_path / "whole", nothing)
    train(network, BASE, eight, none, replace(settings, micro_batch=1), tmp_path / "parts", nothing)
    for one, other in zip(rows(tmp_path / "whole"), rows(tmp_path / "parts"), strict=True):
        assert one["loss"] == pytest.approx(other["loss"], rel=1e-4)


def test_a_trunk_of_low_precision_trains_the_same_parameters(
    network: Mast3r, eight: PairData, none: PairData, tmp_path: Path
):
    low = copy.deepcopy(network).set_precision(torch.bfloat16)
    path = train(low, BASE, eight, none, replace(SETTINGS, epochs=1), tmp_path, nothing)
    assert {v.dtype for v in learned(path).values()} == {torch.float32}
    assert all(np.isfinite(row["loss"]) for row in rows(tmp_path))


def test_a_batch_may_mix_images_of_several_shapes(
    network: Mast3r, dive: Path, eight: PairData, none: PairData, tmp_path: Path
):
    write_dive(DiveSettings(frames=4, width=64, height=32, family="teal"), tmp_path / "data" / "wide")
    wide = pairs_of(tmp_path / "data", 2)
    both = PairData(
        eight.sequences + wide.sequences, eight.pairs[:2] + tuple((1, pair) for _, pair in wide.pairs), SETTINGS.size
    )
    train(network, BASE, both, none, replace(SETTINGS, epochs=1), tmp_path / "out", nothing)
    assert rows(tmp_path / "out")[0]["forward"] > 0


def test_two_processes_of_torchrun_have_the_loss_curve_of_one(network: Mast3r, dive: Path, tmp_path: Path):
    weights = tmp_path / "small.safetensors"
    checkpoint.save(network, weights)
    settings = replace(SETTINGS, epochs=1, max_pairs=8)
    train_sfm(dive, tmp_path / "one", settings, weights, device="cpu")
    options = "--epochs 1 --max-pairs 8 --size 64 --log-every 1 --checkpoint-every 1 --validation 0 --device cpu"
    options += " --precision float32 --learning-rate 0.005 --pairs.min-overlap 0.1 --pairs.max-overlap 1.0"
    command = [
        sys.executable, "-m", "torch.distributed.run", "--standalone", "--nproc-per-node", "2", "-m", "swimm3r",
        "train-sfm", str(dive), "--out", str(tmp_path / "two"), "--weights", str(weights), *options.split(),
    ]  # fmt: skip
    done = subprocess.run(command, capture_output=True, text=True, env={**os.environ, "OMP_NUM_THREADS": "1"})
    assert done.returncode == 0, done.stderr[-2000:]
    one, two = rows(tmp_path / "one"), rows(tmp_path / "two")
    assert [row["step"] for row in two] == [1, 2]
    for a, b in zip(one, two, strict=True):
        for name in ("loss", "encoder", "decoder", "descriptors", "forward", "inverse", "overshoot", "anchor"):
            assert a[name] == pytest.approx(b[name], rel=1e-3, abs=1e-6), name
    expected, found = (learned(tmp_path / k / "adapter.safetensors") for k in ("one", "two"))
    for name in expected:
        torch.testing.assert_close(found[name], expected[name], atol=2e-3, rtol=1e-2)


def test_a_batch_that_does_not_divide_among_the_processes_is_refused():
    assert batch_size(TrainSettings(batch=4), 100, Workers(0, 2)) == 4
    assert batch_size(TrainSettings(batch=4), 3) == 3
    with pytest.raises(UsageError, match="3 processes"):
        batch_size(TrainSettings(batch=4), 100, Workers(0, 3))
    with pytest.raises(InputError, match="too few"):
        batch_size(TrainSettings(batch=4), 1, Workers(0, 2))


def test_the_rate_stays_and_then_falls_along_a_line():
    """Of 9 steps the last 4 cool down; a tenth would have rate 0."""
    settings = TrainSettings(learning_rate=1.0, cool_down=0.5)
    rates = [learning_rate(settings, step, 9) for step in range(1, 10)]
    assert rates == pytest.approx([1, 1, 1, 1, 1, 0.8, 0.6, 0.4, 0.2])
    assert {learning_rate(TrainSettings(), step, 9) for step in range(1, 10)} == {5e-4}


def test_an_epoch_takes_every_pair_once_and_the_next_in_another_order():
    epochs = [[pairs_of_step(1 + e * 3 + k, 12, 4, seed=5) for k in range(3)] for e in range(2)]
    flat = [[i for batch in epoch for i in batch] for epoch in epochs]
    assert sorted(flat[0]) == sorted(flat[1]) == list(range(12))
    assert flat[0] != flat[1]


def test_the_adapter_holds_no_base_weight_and_says_what_it_belongs_to(
    network: Mast3r, eight: PairData, none: PairData, tmp_path: Path
):
    base = Base("x.pth", fingerprint(network.state_dict()), "CC BY-NC-SA 4.0")
    path = train(network, base, eight, none, replace(SETTINGS, epochs=1), tmp_path, nothing)
    header = adapter_file.describe(path)
    assert header["base"] == {"name": "x.pth", "sha256": base.sha256, "license": "CC BY-NC-SA 4.0"}
    assert header["trained"]["settings"]["seed"] == 0
    names = learned(path).keys()
    assert all(".lora_" in name or name.startswith("head.") for name in names)
    assert not names & network.state_dict().keys()
    student = adapter_file.load(path, network, base.sha256)
    student.adapters.detach()
    with pytest.raises(WeightsError, match="trained on"):
        adapter_file.load(path, network, "f" * 64)
    path.write_bytes(path.read_bytes()[:1000])
    with pytest.raises(WeightsError, match="cannot be used"):
        adapter_file.load(path, network)


def test_a_file_of_peft_alone_is_no_adapter_file(network: Mast3r, tmp_path: Path):
    from safetensors.torch import save_file

    save_file({"x": torch.zeros(1)}, tmp_path / "a.safetensors")
    with pytest.raises(WeightsError, match="it has no Swimm3R header"):
        adapter_file.load(tmp_path / "a.safetensors", network)


def test_one_network_has_one_fingerprint_whatever_its_file(network: Mast3r, tmp_path: Path):
    for name in ("a.pth", "a.safetensors"):
        checkpoint.save(network, tmp_path / name)
    marks = {fingerprint(checkpoint.read(tmp_path / name)[0]) for name in ("a.pth", "a.safetensors")}
    assert marks == {fingerprint(network.state_dict())}


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
    network: Mast3r, dive: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
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


def test_validation_knows_pose_depth_and_restoration_of_a_dive(network: Mast3r, eight: PairData):
    student = new_student(network, SETTINGS.lora, ObjectiveSettings(), 0).eval()
    with torch.no_grad():
        scores = score(student, eight)
    error = scores.pop("water_error")
    assert set(scores) == {"depth_absrel", "rotation_deg", "translation_deg", "restored_psnr", "raw_psnr", "loss"}
    assert all(v is not None and np.isfinite(v) for v in scores.values())
    assert set(error) == {"Binf", "beta_D", "beta_B"}
    assert all(len(values) == 3 and min(values) > 0 for values in error.values())
    student.adapters.detach()


def test_the_heads_water_is_held_against_water_that_is_known(
    network: Mast3r, eight: PairData, monkeypatch: pytest.MonkeyPatch
):
    student = new_student(network, SETTINGS.lora, ObjectiveSettings(), 0).eval()
    media = []
    for index in range(len(eight)):
        drawn = eight.item(index, 1.0, torch.Generator().manual_seed(index)).sampled_medium[0]
        off = torch.tensor([1.0, 1.2, 0.5])[:, None] * drawn
        media.append(Medium(*(value.expand(2, 48, 64, 3) for value in off)))
    answers = iter(media)
    monkeypatch.setattr(student, "water", lambda encoded: SimpleNamespace(at=lambda ray_depth: next(answers)))
    with torch.no_grad():
        error = water_error(student, eight)
    assert error is not None
    for name, share in (("Binf", 0.0), ("beta_D", 0.2), ("beta_B", 0.5)):
        assert error[name] == pytest.approx([share] * 3, abs=1e-5)
    student.head = None
    assert water_error(student, eight) is None
    student.adapters.detach()


def test_the_adapter_says_how_far_its_head_was_off_and_what_it_divided_by(
    network: Mast3r, eight: PairData, none: PairData, tmp_path: Path
):
    def validated(student: Student, data: PairData) -> dict:
        return {"loss": 1.0, "water_error": {"Binf": [0.1] * 3, "beta_D": [0.2] * 3, "beta_B": [0.3] * 3}}

    settings = replace(SETTINGS, epochs=1, objective=ObjectiveSettings(min_transmittance=0.2))
    path = train(network, BASE, eight, eight, settings, tmp_path / "held out", validated)
    facts = adapter_file.head_facts(path)
    assert facts.min_transmittance == 0.2
    assert facts.error is not None
    torch.testing.assert_close(facts.error.beta_D, torch.full((3,), 0.2))
    path = train(network, BASE, eight, none, settings, tmp_path / "nothing held out", validated)
    assert adapter_file.head_facts(path).error is None


@pytest.mark.parametrize(
    "header",
    [
        "[" * 100_000 + "]" * 100_000,
        "[]",
        '{"schema": 1, "base": 1}',
        '{"schema": 1, "base": {"name": "x", "sha256": "0", "license": ""}, "peft": {}, '
        '"objective": {"min_transmittance": "x"}, "trained": {}}',
    ],
)
def test_an_adapters_header_that_is_not_ours_is_refused_by_name(network: Mast3r, tmp_path: Path, header: str):
    from safetensors.torch import save_file

    path = tmp_path / "odd.safetensors"
    save_file({"x": torch.zeros(1)}, path, metadata={"swimm3r": header})
    with pytest.raises(WeightsError, match=r"odd\.safetensors cannot be used as an adapter"):
        adapter_file.load(path, network)


def test_training_without_a_clean_image_anywhere_says_so(network: Mast3r, tmp_path: Path):
    for k in range(3):
        write_rgb(
            tmp_path / "flatiron" / "imgs" / f"{16233051861828957 + k * 5_000_000}.png", np.zeros((8, 8, 3), np.uint8)
        )
    sequences = read_tree(tmp_path).sequences
    with pytest.raises(InputError, match="no pair"):
        split_data(sequences, [make_pairs(s, PairSettings()) for s in sequences], 64, 0, 0)
