"""Validation: pose, depth and restoration of a dive, and the head's water beside water that is known."""

from types import SimpleNamespace

import numpy as np
import pytest
import torch
from tests.sfm.distillation.training import SETTINGS

from swimm3r.medium import Medium
from swimm3r.sfm.distillation.pairs import PairData
from swimm3r.sfm.distillation.validation import score, water_error
from swimm3r.sfm.mast3r.network import Mast3r
from swimm3r.sfm.mast3r.settings import ObjectiveSettings
from swimm3r.sfm.student.student import new_student


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
