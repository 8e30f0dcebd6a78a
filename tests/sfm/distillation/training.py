"""Small pairs, a small training, and what it wrote: what the tests of distillation share."""

import json
from pathlib import Path

import torch

from swimm3r.datasets import PairSettings, make_pairs, read_tree
from swimm3r.sfm.distillation.pairs import PairData, split_data
from swimm3r.sfm.distillation.settings import TrainSettings
from swimm3r.sfm.student.adapter_file import Base
from swimm3r.sfm.student.student import Student

BASE = Base("small.safetensors", "0" * 64, "made in a test")
SETTINGS = TrainSettings(
    pairs=PairSettings(min_overlap=0.1, max_overlap=1.0), learning_rate=5e-3, epochs=2, size=64, log_every=1,
    checkpoint_every=1, validation=0, precision="float32",
)  # fmt: skip


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
