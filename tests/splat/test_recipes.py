"""The methods that one training can follow."""

from dataclasses import replace

import pytest
import torch

from swimm3r.splat import train
from swimm3r.splat.checkpoint import load_map, read
from swimm3r.splat.settings import RECIPES, DensifySettings, InitialSettings, UwbsSettings, recipe_of, ubs, with_recipe

FEW = UwbsSettings(
    iterations=60,
    initial=InitialSettings(primitives=500, scale=2.0),
    densify=DensifySettings(max_primitives=600, min_every=10),
)


@pytest.mark.parametrize("recipe", RECIPES)
def test_settings_know_their_recipe(recipe):
    assert recipe_of(with_recipe(FEW, recipe)) == recipe
    assert with_recipe(FEW, recipe).iterations == 60


def test_ubs_as_the_python_api_has_it():
    assert recipe_of(ubs(iterations=7)) == "ubs"
    assert ubs(iterations=7).iterations == 7
    assert not ubs().poses.enabled
    assert not ubs().sgg.enabled


def test_ubs_paints_the_water_onto_the_scene(tiny_dive, tmp_path):
    """Nothing is known of the water afterwards: the clear picture is the filmed one."""
    scene = train(tiny_dive.rec, tiny_dive.frames, with_recipe(FEW, "ubs"), tmp_path)
    assert read(tmp_path / "map.safetensors").about["recipe"] == "ubs"
    view = tiny_dive.cameras[4]
    out = load_map(tmp_path / "map.safetensors").render(view)
    assert torch.equal(out.rgb, scene.render(view).rgb)
    assert not out.veil.any()
    covered = out.alpha > 0.5
    torch.testing.assert_close(out.rgb[covered], out.clear[covered] * out.alpha[covered][:, None])


def test_ubs_begins_with_the_colours_as_filmed(tiny_dive, tmp_path):
    raw = replace(tiny_dive.rec.cloud, raw=torch.full_like(tiny_dive.rec.cloud.raw, 0.25))
    none = replace(with_recipe(FEW, "ubs"), iterations=1)
    scene = train(replace(tiny_dive.rec, cloud=raw), tiny_dive.frames, none, tmp_path)
    assert (scene.primitives.rgb - 0.25).abs().max() < 0.01
