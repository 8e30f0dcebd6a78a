"""Every back end makes the same lens of the same numbers, and refuses the same slips."""

from dataclasses import replace
from typing import Any

import pytest
import torch

from swimm3r.errors import UsageError
from swimm3r.sfm.lens import check_lens_settings, lens_of
from swimm3r.sfm.settings import ColmapSettings, LensSettings, Mast3rSettings

GIVEN: dict[str, Any] = {"focal": 900.0, "k1": -0.1, "p2": 0.002}


@pytest.mark.parametrize("settings", [ColmapSettings(**GIVEN), Mast3rSettings(**GIVEN)])
def test_a_lens_has_the_numbers_that_are_given_in_the_order_of_its_model(settings: LensSettings):
    lens = lens_of(settings, "OPENCV", 1280, 720, 900.0, k1=0.03)
    assert lens.distortion.tolist() == [[-0.1, 0.0, 0.0, 0.002]]
    assert lens.K[0].tolist() == [[900, 0, 640], [0, 900, 360], [0, 0, 1]]
    assert torch.equal(lens.cam2world[0], torch.eye(4, dtype=torch.float64))


def test_the_assumed_distortion_gives_way_to_one_that_is_given():
    assert lens_of(LensSettings(), "SIMPLE_RADIAL", 640, 480, 500.0, k1=0.03).distortion.tolist() == [[0.03]]
    assert lens_of(LensSettings(k1=0.0), "SIMPLE_RADIAL", 640, 480, 500.0, k1=0.03).distortion.tolist() == [[0.0]]


@pytest.mark.parametrize(
    ("change", "model", "message"),
    [
        ({"k3": 0.1}, "OPENCV", "OPENCV has no k3"),
        ({"k1": 0.1}, "PINHOLE", "PINHOLE has no k1"),
        ({"focal": 4.2}, "OPENCV", "does not fit images 640 px wide"),
    ],
)
def test_numbers_of_another_lens_are_refused(change: dict[str, float], model: str, message: str):
    with pytest.raises(UsageError, match=message):
        check_lens_settings(replace(LensSettings(), **change), model, 640)
