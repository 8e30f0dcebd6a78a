"""The water in one sentence."""

import math

import pytest
import torch
from tests.report.conftest import Asked, fit

from swimm3r.report.verdict import half_distances, water_verdict


def test_one_channel_is_named_with_the_distance_at_which_half_of_its_light_is_lost():
    verdict = water_verdict(fit(Asked(determined=(True, False, False))), metric=True)
    assert verdict == "Attenuation is determined in red only; red loses half of its light in 1.39 \u00b1 0.06 m."


def test_two_and_three_channels_are_listed():
    two = water_verdict(fit(Asked(determined=(True, True, False), attenuation_std=0.005)), metric=True)
    assert two.startswith("Attenuation is determined in red and green only; red loses half of its light in 1.39")
    assert ", green in 4.33 \u00b1 0.14 m." in two
    three = water_verdict(fit(Asked(determined=(True, True, True), attenuation_std=0.005)), metric=True)
    assert three.startswith("Attenuation is determined in red, green and blue; red")
    assert ", blue in 6.93 \u00b1 0.35 m." in three


def test_without_a_scale_there_are_no_metres():
    verdict = water_verdict(fit(Asked()), metric=False)
    assert verdict.endswith("1.39 \u00b1 0.06 scene units.")
    assert " m." not in verdict


@pytest.mark.parametrize("gray", [False, True])
def test_nothing_determined_is_said_without_a_number(gray: bool):
    verdict = water_verdict(fit(Asked(determined=(False, False, False))), metric=True, gray=gray)
    assert "not determined" in verdict
    assert not any(character.isdigit() for character in verdict)


def test_no_water_is_said():
    assert water_verdict(None, metric=True) == "The water was not estimated."


def test_gray_frames_have_one_band_and_no_colors():
    verdict = water_verdict(fit(Asked(determined=(True, True, True))), metric=True, gray=True)
    assert "whole band" in verdict
    assert not any(channel in verdict for channel in ("red", "green", "blue"))


def test_pixel_values_as_stored_are_not_called_light():
    assert "loses half of its brightness" in water_verdict(fit(Asked(), "srgb"), metric=False)


def test_half_of_the_light_is_left_at_the_half_distance():
    known = fit(Asked(determined=(True, True, True)))
    for each, beta in zip(half_distances(known), known.beta_D.tolist(), strict=True):
        assert math.isclose(math.exp(-beta * each.distance), 0.5)


def test_the_deviation_of_a_half_distance_is_that_of_a_small_change():
    known = fit(Asked(determined=(True, True, True), attenuation_std=1e-4))
    for each, beta in zip(half_distances(known), known.beta_D.tolist(), strict=True):
        assert math.isclose(each.std, abs(math.log(2) / (beta + 1e-4) - each.distance), rel_tol=2e-3)


def test_a_channel_that_loses_nothing_has_no_half_distance():
    known = fit(Asked(determined=(True, True, True)))
    known.beta_D[1] = 0.0
    assert [each.channel for each in half_distances(known)] == ["red", "blue"]
    assert torch.isfinite(torch.tensor([each.distance for each in half_distances(known)])).all()
