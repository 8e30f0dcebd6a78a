"""The teacher's answers, kept on disk: asked once per pair, and not beyond what the disk may hold."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from tests.sfm.distillation.training import BASE, SETTINGS, nothing, rows

from swimm3r.sfm.distillation.loop import train
from swimm3r.sfm.distillation.pairs import PairData
from swimm3r.sfm.distillation.teacher_cache import TeacherCache
from swimm3r.sfm.mast3r.network import Mast3r
from swimm3r.sfm.student.student import Student, new_student


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
