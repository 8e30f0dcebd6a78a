"""The loop: it learns, it goes on after a kill with the same bits, and two processes are as one."""

import copy
import os
import signal
import subprocess
import sys
from dataclasses import astuple, replace
from pathlib import Path

import numpy as np
import pytest
import torch
from tests.sfm.distillation.training import BASE, SETTINGS, learned, nothing, pairs_of, rows

from swimm3r.errors import InputError, UsageError
from swimm3r.sfm.distillation.loop import Workers, batch_size, learning_rate, pairs_of_step, train
from swimm3r.sfm.distillation.pairs import PairData
from swimm3r.sfm.distillation.settings import TrainSettings
from swimm3r.sfm.distillation.train import train_sfm
from swimm3r.sfm.mast3r import checkpoint
from swimm3r.sfm.mast3r.network import Mast3r
from swimm3r.sfm.student import adapter_file
from swimm3r.sfm.student.adapter_file import fingerprint
from swimm3r.synthetic import DiveSettings, write_dive

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


@pytest.mark.long
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


@pytest.mark.skipif(sys.platform == "win32", reason="Windows has no kill -9")
def test_killed_and_started_again_it_ends_with_the_same_bits(
    network: Mast3r, dives: Path, eight: PairData, none: PairData, tmp_path: Path
):
    whole = train(network, BASE, eight, none, SETTINGS, tmp_path / "whole", nothing)
    settings = replace(SETTINGS, checkpoint_every=2)  # so that step 3 has to be done again
    cut, weights = tmp_path / "cut", tmp_path / "small.safetensors"
    checkpoint.save(network, weights)
    command = [sys.executable, "-c", KILLED, str(dives), str(weights), str(cut), repr(settings), repr(astuple(BASE))]
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
    network: Mast3r, dives: Path, eight: PairData, none: PairData, tmp_path: Path
):
    write_dive(DiveSettings(frames=4, width=64, height=32, family="teal"), tmp_path / "data" / "wide")
    wide = pairs_of(tmp_path / "data", 2)
    both = PairData(
        eight.sequences + wide.sequences, eight.pairs[:2] + tuple((1, pair) for _, pair in wide.pairs), SETTINGS.size
    )
    train(network, BASE, both, none, replace(SETTINGS, epochs=1), tmp_path / "out", nothing)
    assert rows(tmp_path / "out")[0]["forward"] > 0


@pytest.mark.long
def test_two_processes_of_torchrun_have_the_loss_curve_of_one(network: Mast3r, dives: Path, tmp_path: Path):
    weights = tmp_path / "small.safetensors"
    checkpoint.save(network, weights)
    settings = replace(SETTINGS, epochs=1, max_pairs=8)
    train_sfm(dives, tmp_path / "one", settings, weights, device="cpu")
    options = "--epochs 1 --max-pairs 8 --size 64 --log-every 1 --checkpoint-every 1 --validation 0 --device cpu"
    options += " --precision float32 --learning-rate 0.005 --pairs.min-overlap 0.1 --pairs.max-overlap 1.0"
    command = [
        sys.executable, "-m", "torch.distributed.run", "--standalone", "--nproc-per-node", "2", "-m", "swimm3r",
        "train-sfm", str(dives), "--out", str(tmp_path / "two"), "--weights", str(weights), *options.split(),
    ]  # fmt: skip
    done = subprocess.run(command, capture_output=True, text=True, env={**os.environ, "OMP_NUM_THREADS": "1"})
    assert done.returncode == 0, done.stderr
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
