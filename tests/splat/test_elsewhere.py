"""Maps on another device than the processor's. There is no GPU in CI: one is pretended, and Warp's kernels run on the
processor, so that what fails here would fail there. Nothing about speed or the GPU's own rounding is checked."""

import json
from dataclasses import replace
from pathlib import Path

import pytest
import torch
from tests.splat.elsewhere import DEVICE, Elsewhere, Pretended, held, waits

from swimm3r.evaluate.images import psnr
from swimm3r.splat import train_map
from swimm3r.splat.map_file import load_map
from swimm3r.splat.pose_refinement import refine_pose
from swimm3r.splat.recipes import uwbs
from swimm3r.splat.rendering import mean_water
from swimm3r.splat.settings import (
    DensifySettings,
    InitialSettings,
    PoseRefinementSettings,
    RecipeName,
    SggSettings,
    UwbsSettings,
    with_recipe,
)
from swimm3r.splat.training.scene import TrainingScene
from swimm3r.splat.views import TrainingViews

pytest.importorskip("warp", reason="warp-lang is not installed: maps were not trained on a pretended device")
from swimm3r.raster.cuda import backend as cuda_backend
from swimm3r.raster.cuda import bins as cuda_bins
from swimm3r.raster.cuda.launch import launch

SIZE = UwbsSettings(
    iterations=12,
    initial=InitialSettings(primitives=300, scale=2.0),
    densify=DensifySettings(cap_max=400, min_refine_every=3),
    log_every=1 / 12,
    checkpoint_every=0.5,
)
RECIPES: list[RecipeName] = [
    "uwbs-static",
    "uwbs-dynamic",
    "ubs",
    "watersplatting",
    "seasplat",
    "threers_gs",
    "mcmc_gs",
    "oceansplat",
    "3d-uir",
]

on_the_processor = pytest.mark.usefixtures("warp_on_the_processor")


@pytest.fixture
def warp_on_the_processor(monkeypatch: pytest.MonkeyPatch) -> None:
    def unwrapped(kernel, dim, arguments, **given) -> None:
        assert all(isinstance(t, Elsewhere) for t in arguments if isinstance(t, torch.Tensor))
        launch(kernel, dim, [held(t) if isinstance(t, torch.Tensor) else t for t in arguments], **given)

    for module in (cuda_backend, cuda_bins):
        monkeypatch.setattr(module, "launch", unwrapped)


BOTH_KINDS = ("uwbs-static", "watersplatting")  # Beta primitives and Gaussians; the others are made of their parts


def losses(folder: Path) -> list[float]:
    return [json.loads(line)["loss"] for line in (folder / "metrics.jsonl").read_text().splitlines()]


@on_the_processor
@pytest.mark.parametrize(
    "recipe", [recipe if recipe in BOTH_KINDS else pytest.param(recipe, marks=pytest.mark.long) for recipe in RECIPES]
)
def test_every_recipe_trains_elsewhere_as_on_the_processor(recipe: RecipeName, tiny_dive, tmp_path):
    settings = with_recipe(SIZE, recipe)
    here = train_map.train(tiny_dive.rec, tiny_dive.frames, settings, tmp_path / "here")
    with Pretended():
        there = train_map.train(tiny_dive.rec, tiny_dive.frames, settings, tmp_path / "there", device=DEVICE)
        assert there.device == DEVICE
        seen = there.render(tiny_dive.cameras[1], tiny_dive.frames.frames[1].time)
    assert losses(tmp_path / "there") == pytest.approx(losses(tmp_path / "here"), rel=0.03)
    assert type(seen.rgb) is torch.Tensor
    mine = here.render(tiny_dive.cameras[1], tiny_dive.frames.frames[1].time)
    assert psnr(seen.rgb, mine.rgb) > 35
    kept = load_map(tmp_path / "there" / "map.safetensors")
    assert kept.device.type == "cpu"
    assert torch.equal(kept.primitives.xyz, held(there.primitives.xyz))


@on_the_processor
def test_a_map_elsewhere_shows_and_places_what_it_does_here(tiny_dive):
    scene, lens = tiny_dive.truth, tiny_dive.rec.cameras[1]
    steps = PoseRefinementSettings(steps=6, long_side=64, halvings=0)
    here = scene.render(tiny_dive.cameras[1])
    image, mask = tiny_dive.frames.image(1), tiny_dive.frames.mask(1)
    off = replace(lens, cam2world=lens.cam2world.clone())
    off.cam2world[0, 0, 3] += 0.02
    expected = refine_pose(scene, off, image, mask, steps)
    with Pretended():
        moved = scene.to(DEVICE)
        there, water = moved.render(tiny_dive.cameras[1]), mean_water(moved, tiny_dive.cameras[1])
        placed = refine_pose(moved, off, image, mask, steps)
    for name in ("rgb", "clear", "backscatter", "z_depth", "alpha"):
        torch.testing.assert_close(getattr(there, name), getattr(here, name), atol=2e-5, rtol=2e-4)
    torch.testing.assert_close(water.Binf, mean_water(scene, tiny_dive.cameras[1]).Binf)
    torch.testing.assert_close(placed.camera.cam2world, expected.camera.cam2world, atol=1e-4, rtol=0)


@on_the_processor
def test_an_interrupted_training_goes_on_elsewhere(tiny_dive, tmp_path):
    settings = replace(SIZE, sgg=SggSettings(enabled=False))

    class StoppedError(Exception):
        pass

    def stop(what: str, done: int, total: int, /) -> None:
        if done == 8:
            raise StoppedError

    with pytest.raises(StoppedError):
        train_map.train(tiny_dive.rec, tiny_dive.frames, settings, tmp_path, stop)
    with Pretended():
        scene = train_map.train(tiny_dive.rec, tiny_dive.frames, settings, tmp_path, device=DEVICE)
    assert scene.device == DEVICE
    assert len(losses(tmp_path)) == 12


@on_the_processor
def test_a_step_waits_for_the_device_only_to_bin(tiny_dive):
    settings = replace(SIZE, iterations=1000, poses=replace(SIZE.poses, enabled=False))
    views = TrainingViews(tiny_dive.rec, tiny_dive.frames, settings, 1.0)
    with Pretended():
        scene = TrainingScene(tiny_dive.rec, 1.0, 1.0, views, None, DEVICE)
        recipe = uwbs.Uwbs(settings, scene, uwbs.known_water(scene, settings))
        state, view = recipe.start().to(DEVICE), scene.view(2)
        waits.clear()
        recipe.step(state, view, 26)
    assert waits == ["bins.py:bin_primitives"]  # how many tiles the primitives touch


def test_the_pretence_sees_tensors_in_two_places():
    with Pretended():
        there = torch.ones(3).to(DEVICE)
        with pytest.raises(AssertionError, match="on the device and on the processor"):
            _ = there + torch.ones(3)
        with pytest.raises(RuntimeError):
            there.numpy()


@pytest.mark.gpu
@pytest.mark.skipif(not torch.cuda.is_available(), reason="no CUDA device: no map was trained on a GPU")
@pytest.mark.parametrize("recipe", RECIPES)
def test_every_recipe_trains_on_the_gpu_as_on_the_processor(recipe: RecipeName, tiny_dive, tmp_path):
    settings = with_recipe(SIZE, recipe)
    train_map.train(tiny_dive.rec, tiny_dive.frames, settings, tmp_path / "here")
    there = train_map.train(tiny_dive.rec, tiny_dive.frames, settings, tmp_path / "there", device=torch.device("cuda"))
    assert losses(tmp_path / "there") == pytest.approx(losses(tmp_path / "here"), rel=0.03)
    assert there.render(tiny_dive.cameras[1], tiny_dive.frames.frames[1].time).rgb.device.type == "cpu"
