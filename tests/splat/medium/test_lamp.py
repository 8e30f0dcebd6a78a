"""A map's lamp: it moves with the camera, lights primitives as the water's fit says, and leaves clear images even."""

from dataclasses import replace

import pytest
import torch

from swimm3r.lamp import Lamp, log_light, veil_pattern
from swimm3r.splat.map_file import load_map
from swimm3r.splat.medium.field import MediumField, grid_of, in_unit, initial_field, medium_at_pixels
from swimm3r.splat.medium.lamp import CameraLamp
from swimm3r.splat.projection.view_camera import view_camera
from swimm3r.splat.rendering import draw
from swimm3r.splat.settings import UwbsSettings

LAMP = Lamp(
    torch.tensor([0.2, -0.1, 0.0]), 2.0, 0.9, 1.2, torch.tensor([0.2, 0.1, -2.0, 0, 0, 0]), torch.tensor([0.3] * 6)
)
BETA = torch.tensor([0.3, 0.2, 0.1])


@pytest.fixture
def scene(wall):
    return wall(400)


@pytest.fixture
def camera(camera):
    return camera()


@pytest.fixture
def lit(scene):
    field = initial_field(None, scene.settings.medium, torch.Generator().manual_seed(0), lamp=LAMP)
    return replace(scene, field=field.requires_grad_(False))


def test_light_on_the_world_is_that_of_the_camera_it_is_seen_from(camera):
    view = view_camera(camera)
    in_camera = torch.tensor([[0.3, 0.2, 2.0], [-0.5, 0.1, 4.0]])
    world = (in_camera - view.t) @ view.R
    found = CameraLamp(LAMP).light(world, view, BETA, torch.ones(()))
    way = (in_camera - LAMP.position).norm(dim=-1, keepdim=True)
    torch.testing.assert_close(found, (log_light(in_camera, LAMP)[:, None] - BETA * way).exp(), rtol=1e-4, atol=0)


def test_light_is_the_same_in_any_unit(camera):
    view, world = view_camera(camera), torch.tensor([[0.1, 0.2, 0.3]])
    stretched = replace(view, t=4 * view.t, center=4 * view.center)
    near = CameraLamp(LAMP).light(world, view, BETA, torch.ones(()))
    far = CameraLamp(LAMP).light(4 * world, stretched, BETA / 4, torch.tensor(4.0))
    torch.testing.assert_close(near, far)


def test_backscatter_stays_with_the_camera_and_has_the_lamps_pattern(camera):
    field = initial_field(None, UwbsSettings().medium, torch.Generator().manual_seed(0), lamp=LAMP)
    view = view_camera(camera)
    turned = replace(view, R=view.R @ torch.tensor([[0.0, -1, 0], [1, 0, 0], [0, 0, 1]]))
    here, there = (medium_at_pixels(grid_of(field, v, 1), view.height, view.width).Binf for v in (view, turned))
    torch.testing.assert_close(here, there)
    grid = grid_of(field, view, 1)
    assert grid.veil is not None
    torch.testing.assert_close(here, grid.values[:3] * grid.veil)
    assert veil_pattern(torch.tensor([0.0, 0.0, 1.0]), LAMP) == 1


def test_clear_images_are_evenly_lit(scene, lit, camera):
    even, shown = scene.render(camera), lit.render(camera)
    torch.testing.assert_close(shown.clear, even.clear, rtol=0, atol=2e-3)
    assert (shown.rgb - even.rgb).abs().max() > 0.05


def test_beam_and_pattern_of_the_backscatter_are_trained(lit, camera):
    field = lit.field.requires_grad_(True)
    drawing = draw(lit.primitives, field, view_camera(camera), lit.settings)
    drawing.images.rgb.square().sum().backward()
    assert field.lamp.beam.grad.abs().sum() > 0
    assert field.lamp.veil.grad.abs().sum() > 0


def test_a_lamp_is_kept_in_the_maps_file(lit, camera, tmp_path):
    kept = replace(lit, field=in_unit(lit.field, 2.0))
    kept.save(tmp_path / "map.safetensors")
    again = load_map(tmp_path / "map.safetensors")
    torch.testing.assert_close(again.render(camera).rgb, kept.render(camera).rgb)
    assert isinstance(again.field, MediumField)
    torch.testing.assert_close(again.field.lamp.beam, LAMP.beam)
