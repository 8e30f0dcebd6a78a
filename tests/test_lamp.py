import math
from dataclasses import replace

import pytest
import torch
from torch.nn.functional import normalize

from swimm3r.lamp import Lamp, lamp_distance, log_light, pattern, rescaled_lamp, veil_pattern

LAMP = Lamp(
    torch.tensor([0.3, -0.2, 0.1]), 2.0, 2.0, 1.4, torch.tensor([0.1, 0.0, -3.0, 0.0, 0.2, -0.1]), torch.zeros(6)
)
UNIFORM = replace(LAMP, beam=torch.zeros(6))


@pytest.fixture
def points():
    g = torch.Generator().manual_seed(3)
    return torch.randn(200, 3, generator=g, dtype=torch.float64) + torch.tensor([0.0, 0.0, 4.0])


def test_light_falls_with_the_square_of_the_distance_from_the_lamp(points):
    farther = LAMP.position + 3 * (points - LAMP.position)
    torch.testing.assert_close(
        log_light(points, LAMP) - log_light(farther, LAMP), torch.full((200,), 2 * math.log(3)).double()
    )


def test_light_on_the_axis_at_the_reference_distance_is_the_lamps_strength():
    assert log_light(torch.tensor([0.0, 0.0, 2.0]), UNIFORM).exp() == pytest.approx(1.4)


def test_a_lamp_at_infinity_lights_the_scene_evenly(points):
    far = replace(UNIFORM, position=torch.tensor([1e4, -2e4, 1e4]))
    assert (log_light(points, far).exp() / 1.4 - 1).abs().max() < 2e-3


def test_a_beam_about_any_axis_is_a_pattern():
    axis = normalize(torch.tensor([0.2, 0.1, 1.0]), dim=0)
    direction = normalize(torch.randn(50, 3, generator=torch.Generator().manual_seed(1)), dim=-1)
    coefficients = torch.tensor([*(5 * axis[:2]).tolist(), -5 * float(axis[2]), 0, 0, 0])
    expected = 5 * (direction @ axis - axis[2])
    torch.testing.assert_close(pattern(direction, coefficients), expected)


def test_backscatter_has_its_full_color_on_the_axis():
    lamp = replace(LAMP, veil=torch.arange(6.0))
    assert veil_pattern(torch.tensor([0.0, 0.0, 1.0]), lamp) == 1


def test_stretching_the_scene_with_the_lamp_changes_no_light(points):
    longer = rescaled_lamp(LAMP, 7.0)
    torch.testing.assert_close(log_light(7 * points, longer), log_light(points, LAMP))
    torch.testing.assert_close(lamp_distance(7 * points, longer), 7 * lamp_distance(points, LAMP))
