"""The light of a dive's lamp: laws of light, and closed forms of what the water scatters back."""

import json
import math
from dataclasses import replace

import numpy as np
import pytest
import torch

from swimm3r.cameras import image_directions
from swimm3r.errors import UsageError
from swimm3r.lamp import Lamp, scattered
from swimm3r.medium import Medium, transmittances
from swimm3r.synthetic import DiveSettings, make_dive, write_dive
from swimm3r.synthetic.lamp_light import lamp_backscatter, lamp_of, light_on
from swimm3r.synthetic.settings import LampSettings

DIVE = DiveSettings(frames=24, width=60, height=40, noise=0.0, lit_by="lamp")
WATER = Medium(torch.tensor([0.1, 0.3, 0.3]), torch.tensor([0.8, 0.2, 0.1]), torch.ones(3))
AXIS = torch.tensor([[[0.0, 0.0, 1.0]]])
EVEN = Lamp(torch.zeros(3), 1.0, 0.0, 1.0, torch.zeros(6), torch.zeros(6))


@pytest.fixture(scope="module")
def dive():
    return make_dive(DIVE)


def test_images_are_the_evenly_lit_scene_under_the_lamp_and_its_backscatter(dive):
    frame = dive.frame(4)
    T_D, _ = transmittances(frame.ray_depth, dive.medium)
    hit = frame.z_depth > 0
    torch.testing.assert_close(frame.raw[hit], (frame.clear * frame.light * T_D + frame.backscatter)[hit])
    torch.testing.assert_close(frame.raw[~hit], frame.backscatter[~hit])


def test_the_scene_itself_is_the_one_that_the_sun_lights(dive):
    sunlit = make_dive(replace(DIVE, lit_by="sun")).frame(4)
    assert torch.equal(dive.frame(4).clear, sunlit.clear)


def test_even_light_from_the_camera_scatters_back_as_in_closed_form():
    z = torch.tensor([[0.3, 2.0, 9.0]])
    expected = -torch.expm1(-2 * WATER.beta_D * z[..., None]) / (2 * WATER.beta_D)
    torch.testing.assert_close(scattered(AXIS.expand(1, 3, 3), z, EVEN, WATER.beta_D), expected, rtol=1e-4, atol=0)


def test_inverse_square_light_beside_the_camera_scatters_back_as_in_closed_form():
    a, z = 0.4, torch.tensor([[0.3, 2.0, 9.0]])
    lamp = replace(EVEN, position=torch.tensor([a, 0.0, 0.0]), fall_off=2.0)
    clear = replace(WATER, beta_D=torch.zeros(3))
    expected = (1 + a * a) * torch.atan(z / a) / a
    torch.testing.assert_close(
        scattered(AXIS.expand(1, 3, 3), z, lamp, clear.beta_D)[..., 0], expected, rtol=1e-3, atol=0
    )


def test_the_open_water_of_the_middle_has_the_veiling_light(dive):
    lamp = dive.lamp
    found = lamp_backscatter(AXIS, torch.zeros(1, 1), lamp, dive.medium)
    torch.testing.assert_close(found[0, 0], dive.medium.Binf)
    assert (lamp_backscatter(AXIS, torch.full((1, 1), 1.5), lamp, dive.medium) < found).all()


def test_water_takes_light_on_both_ways(dive):
    rays = image_directions(dive.cameras[0]).float()
    z = torch.full(rays.shape[:2], 2.0)
    lamp = replace(dive.lamp, position=torch.zeros(3))
    lit, unlit = (light_on(rays, z, lamp, replace(WATER, beta_D=s * WATER.beta_D)) for s in (1.0, 0.0))
    torch.testing.assert_close(lit / unlit, transmittances(z, WATER)[0])


def test_light_halves_at_the_border_of_the_beam():
    lamp = replace(lamp_of(LampSettings(beam=60.0)), position=torch.zeros(3))
    clear = replace(WATER, beta_D=torch.zeros(3))
    edge = torch.tensor([[[math.tan(math.radians(30)), 0.0, 1.0]]])
    z = torch.ones(1, 1)
    # half in linear light is 2^(-1 / 2.2) as stored
    share = light_on(edge, z, lamp, clear) / light_on(AXIS, z, lamp, clear)
    torch.testing.assert_close(share, torch.full_like(share, 0.5 ** (1 / 2.2)))


def test_the_truth_on_disk_has_the_lamp_and_its_light(tmp_path, dive):
    write_dive(replace(DIVE, frames=2), tmp_path)
    assert json.loads((tmp_path / "truth" / "lamp.json").read_text())["fall_off"] == DIVE.lamp.fall_off
    stored = np.load(tmp_path / "truth" / "lamp" / "0000.png.npz")
    assert stored["light"].shape == stored["backscatter"].shape == (40, 60, 3)


def test_a_fish_under_a_lamp_is_refused():
    with pytest.raises(UsageError, match="daylight"):
        DiveSettings(lit_by="lamp", moving_object=True)
