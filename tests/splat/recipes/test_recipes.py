"""The methods that one training can follow, and what all of them promise."""

import json
from dataclasses import replace

import pytest
import torch

from swimm3r.evaluate.images import psnr
from swimm3r.pipeline.presets import RunSettings, from_yaml, to_yaml
from swimm3r.splat import train
from swimm3r.splat.map_file import load_map
from swimm3r.splat.primitives.beta import BetaPrimitives
from swimm3r.splat.settings import (
    RECIPES,
    DensifySettings,
    InitialSettings,
    UwbsSettings,
    mcmc_gs,
    settings_of,
    threers_gs,
    ubs,
    with_primitives,
    with_recipe,
)

FEW = UwbsSettings(
    iterations=60,
    initial=InitialSettings(primitives=500, scale=2.0),
    densify=DensifySettings(cap_max=600, min_refine_every=10),
)


@pytest.mark.parametrize("recipe", RECIPES)
def test_settings_know_their_recipe(recipe):
    settings = with_recipe(FEW, recipe)
    assert settings.recipe == recipe
    assert type(settings) is settings_of(recipe)
    assert (settings.iterations, settings.initial.primitives) == (60, 500)


def test_ubs_as_the_python_api_has_it():
    assert ubs(iterations=7).recipe == "ubs"
    assert ubs(iterations=7).iterations == 7
    assert not ubs().poses.enabled
    assert not ubs().sgg.enabled


def test_ubs_paints_the_water_onto_the_scene(tiny_dive, tmp_path):
    """Nothing is known of the water afterwards: the clear image is the filmed one."""
    scene = train(tiny_dive.rec, tiny_dive.frames, with_recipe(FEW, "ubs"), tmp_path)
    assert load_map(tmp_path / "map.safetensors").settings.recipe == "ubs"
    view = tiny_dive.cameras[4]
    out = load_map(tmp_path / "map.safetensors").render(view)
    assert torch.equal(out.rgb, scene.render(view).rgb)
    assert not out.backscatter.any()
    covered = out.alpha > 0.5
    torch.testing.assert_close(out.rgb[covered], out.clear[covered] * out.alpha[covered][:, None])


def test_ubs_begins_with_the_colors_as_filmed(tiny_dive, tmp_path):
    raw = replace(tiny_dive.rec.cloud, raw=torch.full_like(tiny_dive.rec.cloud.raw, 0.25))
    none = replace(with_recipe(FEW, "ubs"), iterations=1)
    scene = train(replace(tiny_dive.rec, cloud=raw), tiny_dive.frames, none, tmp_path)
    assert isinstance(scene.primitives, BetaPrimitives)
    assert (scene.primitives.rgb - 0.25).abs().max() < 0.01


@pytest.mark.parametrize("recipe", RECIPES)
def test_settings_of_every_recipe_come_back_from_a_runs_file(recipe, tmp_path):
    settings = RunSettings(splat=with_recipe(FEW, recipe))
    (tmp_path / "settings.yaml").write_text(to_yaml(settings))
    assert from_yaml(tmp_path / "settings.yaml") == settings


def test_settings_from_before_there_were_peers_are_uwbs(tmp_path):
    text = to_yaml(RunSettings(splat=FEW))
    (tmp_path / "settings.yaml").write_text(text.replace("  kind: UwbsSettings\n", ""))
    assert "kind: UwbsSettings" in text
    assert from_yaml(tmp_path / "settings.yaml").splat == FEW


def test_the_peers_as_the_python_api_has_them():
    assert threers_gs(iterations=7).recipe == "threers_gs"
    assert mcmc_gs(iterations=7).recipe == "mcmc_gs"
    assert mcmc_gs(iterations=7).iterations == 7


class StoppedError(Exception):
    pass


def stop_at(step: int):
    def progress(what: str, done: int, total: int, /) -> None:
        if done == step:
            raise StoppedError

    return progress


PEERS = [recipe for recipe in RECIPES if settings_of(recipe) is not UwbsSettings]


@pytest.mark.parametrize(
    "recipe", [each if each == "watersplatting" else pytest.param(each, marks=pytest.mark.long) for each in PEERS]
)
def test_every_peer_learns_is_kept_and_goes_on_to_the_bit(recipe, tiny_dive, tmp_path):
    settings = replace(with_recipe(FEW, recipe), iterations=80, checkpoint_every=0.25)
    whole = train(tiny_dive.rec, tiny_dive.frames, settings, tmp_path / "whole")
    rows = [json.loads(line) for line in (tmp_path / "whole/metrics.jsonl").read_text().splitlines()]
    assert sum(row["l1"] for row in rows[-10:]) < 0.6 * sum(row["l1"] for row in rows[:10])
    assert psnr(whole.render(tiny_dive.cameras[4]).rgb, tiny_dive.frames.image(4)) > 18

    with pytest.raises(StoppedError):
        train(tiny_dive.rec, tiny_dive.frames, settings, tmp_path / "cut", stop_at(47))
    resumed = train(tiny_dive.rec, tiny_dive.frames, settings, tmp_path / "cut")
    kept = load_map(tmp_path / "whole/map.safetensors")
    assert kept.settings == settings
    for other in (resumed, kept):
        assert type(other.primitives) is type(whole.primitives)
        assert all(torch.equal(a, b) for a, b in zip(whole.primitives, other.primitives, strict=True))
        water = whole.field.state_dict(), other.field.state_dict()
        assert all(torch.equal(values, water[1][name]) for name, values in water[0].items())


@pytest.mark.parametrize("recipe", PEERS)
def test_every_peer_may_refine_its_poses_or_hold_them(recipe, tiny_dive, tmp_path):
    settings = replace(with_recipe(FEW, recipe), iterations=4)
    for enabled in (True, False):
        asked = replace(settings, poses=replace(settings.poses, enabled=enabled))
        scene = train(tiny_dive.rec, tiny_dive.frames, asked, tmp_path / str(enabled))
        assert (scene.poses is not None) == enabled


@pytest.mark.parametrize("recipe", PEERS)
def test_no_peer_depends_on_the_unit_of_the_scene(recipe, tiny_dive, tmp_path):
    settings = replace(with_recipe(FEW, recipe), iterations=10)
    settings = replace(settings, poses=replace(settings.poses, enabled=False))
    found = []
    for name, metric in (("metric", True), ("not", False)):
        rec = replace(tiny_dive.rec, metric=metric)
        found.append(train(rec, tiny_dive.frames, settings, tmp_path / name).render(tiny_dive.cameras[4]).rgb)
    assert psnr(found[0], found[1]) > 33


@pytest.mark.parametrize("recipe", RECIPES)
def test_every_recipe_has_primitives_by_the_share(recipe):
    whole = with_recipe(UwbsSettings(), recipe)
    half = with_primitives(whole, 0.5)
    assert half.initial.primitives == whole.initial.primitives // 2
    cap_max = [s.densify.cap_max if isinstance(s, UwbsSettings) else s.cap_max for s in (half, whole)]
    assert cap_max[0] == cap_max[1] // 2
    assert with_primitives(whole, 1.0) == whole
