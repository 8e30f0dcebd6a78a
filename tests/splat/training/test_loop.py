"""The loop: it learns, it is exact about going on, and it writes what it says."""

import copy
import json
import math
from dataclasses import replace
from pathlib import Path

import pytest
import torch

from swimm3r.devices import torch_threads
from swimm3r.errors import UsageError
from swimm3r.evaluate.images import psnr
from swimm3r.splat import train
from swimm3r.splat.map_file import load_map
from swimm3r.splat.projection.view_camera import view_camera
from swimm3r.splat.recipes import uwbs
from swimm3r.splat.rendering import SplatMap, draw
from swimm3r.splat.settings import (
    DensifySettings,
    InitialSettings,
    LossWeights,
    MediumFieldSettings,
    SggSettings,
    UwbsSettings,
)
from swimm3r.splat.training import loop
from swimm3r.splat.training.loop import view_of_step
from swimm3r.splat.training.observer import TrainingStep
from swimm3r.splat.training.scene import TrainingScene
from swimm3r.splat.views import TrainingViews

SETTINGS = UwbsSettings(
    iterations=40,
    initial=InitialSettings(primitives=500, scale=2.0),
    densify=DensifySettings(cap_max=700, min_refine_every=4),
    log_every=0.125,
    checkpoint_every=0.25,
)


def equal(a: SplatMap, b: SplatMap) -> bool:
    same = [torch.equal(x, y) for x, y in zip(a.primitives, b.primitives, strict=True)]
    weights = a.field.state_dict(), b.field.state_dict()
    return all(same) and all(torch.equal(weights[0][k], weights[1][k]) for k in weights[0])


def rows(folder: Path) -> list[dict]:
    return [json.loads(line) for line in (folder / "metrics.jsonl").read_text().splitlines()]


class StoppedError(Exception):
    pass


def stop_at(step: int):
    def progress(what: str, done: int, total: int, /) -> None:
        if done == step:
            raise StoppedError

    return progress


def test_training_brings_the_map_nearer_to_a_image_it_has_not_seen(tiny_dive, tmp_path):
    settings = replace(SETTINGS, iterations=150)
    scene = train(tiny_dive.rec, tiny_dive.frames, settings, tmp_path)
    logged = rows(tmp_path)
    assert logged[-1]["l1"] < 0.5 * logged[0]["l1"]
    held_out = psnr(scene.render(tiny_dive.cameras[0]).rgb, tiny_dive.frames.image(0))
    assert held_out > 25


def test_an_interrupted_training_ends_with_the_bits_of_one_that_was_not(tiny_dive, tmp_path):
    whole = train(tiny_dive.rec, tiny_dive.frames, SETTINGS, tmp_path / "whole")
    with pytest.raises(StoppedError):
        train(tiny_dive.rec, tiny_dive.frames, SETTINGS, tmp_path / "cut", stop_at(27))
    assert not (tmp_path / "cut/map.safetensors").exists()
    with (tmp_path / "cut/metrics.jsonl").open("a") as torn:
        torn.write('{"step": 30, "loss": {"l1": 0.5}')
    resumed = train(tiny_dive.rec, tiny_dive.frames, SETTINGS, tmp_path / "cut")
    assert equal(whole, resumed)
    assert len(whole.primitives.xyz) > 500
    steps = [[row["step"] for row in rows(tmp_path / name)] for name in ("whole", "cut")]
    assert steps[0] == steps[1] == [5, 10, 15, 20, 25, 30, 35, 40]


@pytest.mark.long
def test_the_number_of_threads_changes_no_bit_of_a_map(tiny_dive, tmp_path):
    maps = []
    for threads in (1, 2, 3):
        with torch_threads(threads):
            maps.append(train(tiny_dive.rec, tiny_dive.frames, SETTINGS, tmp_path / str(threads)))
            assert torch.get_num_threads() == threads
    assert equal(maps[0], maps[1])
    assert equal(maps[0], maps[2])


def test_a_checkpoint_of_other_settings_is_not_continued(tiny_dive, tmp_path):
    short = replace(SETTINGS, iterations=8)
    train(tiny_dive.rec, tiny_dive.frames, short, tmp_path / "a")
    other = replace(short, seed=1)
    anew = train(tiny_dive.rec, tiny_dive.frames, other, tmp_path / "a")
    assert equal(anew, train(tiny_dive.rec, tiny_dive.frames, other, tmp_path / "b"))


def test_a_checkpoint_of_code_that_trained_otherwise_is_not_continued(monkeypatch):
    before = loop.schedule_of(SETTINGS, "input").fingerprint
    monkeypatch.setattr(loop, "_TRAINING", loop._TRAINING + 1)
    assert loop.schedule_of(SETTINGS, "input").fingerprint != before


def test_a_map_comes_back_from_disk_as_it_was(tiny_dive, tmp_path):
    scene = train(tiny_dive.rec, tiny_dive.frames, replace(SETTINGS, iterations=4), tmp_path)
    stored = load_map(tmp_path / "map.safetensors")
    assert equal(scene, stored)
    assert stored.settings == scene.settings
    assert stored.metric
    view = tiny_dive.cameras[4]
    assert torch.equal(scene.render(view).rgb, stored.render(view).rgb)


def test_a_scene_in_another_unit_trains_to_the_same_map_in_that_unit(tiny_dive, tmp_path):
    """Without metric scale the unit is arbitrary: the image must not depend on it."""
    rec = replace(tiny_dive.rec, metric=False)
    few = replace(SETTINGS, iterations=10)
    scene = train(rec, tiny_dive.frames, few, tmp_path / "one")
    assert scene.length == pytest.approx(1, abs=0.1)  # the wall stands at about the working depth
    view = tiny_dive.cameras[4]
    metric = train(tiny_dive.rec, tiny_dive.frames, few, tmp_path / "metric")
    assert psnr(scene.render(view).rgb, metric.render(view).rgb) > 35


def test_the_water_waits_for_the_primitives(tiny_dive, tmp_path):
    still = replace(SETTINGS, iterations=10, medium=MediumFieldSettings(begin=1.0))
    moving = replace(SETTINGS, iterations=10, medium=MediumFieldSettings(begin=0.0))
    water = [
        train(tiny_dive.rec, tiny_dive.frames, settings, tmp_path / str(i)).render(tiny_dive.cameras[0]).medium.beta_D
        for i, settings in enumerate((still, moving))
    ]
    known = tiny_dive.rec.medium.beta_D.expand_as(water[0])
    torch.testing.assert_close(water[0], known)
    assert (water[1] - known).abs().max() > 1e-4


def test_an_epoch_visits_every_view_once_and_each_in_its_own_order():
    epochs = [[view_of_step(step, 7, seed=0) for step in range(1 + 7 * e, 8 + 7 * e)] for e in range(3)]
    assert all(sorted(epoch) == list(range(7)) for epoch in epochs)
    assert epochs[0] != epochs[1]


def test_the_number_of_primitives_never_exceeds_the_cap(tiny_dive, tmp_path):
    capped = replace(SETTINGS, densify=DensifySettings(cap_max=510, min_refine_every=4))
    assert len(train(tiny_dive.rec, tiny_dive.frames, capped, tmp_path).primitives.xyz) == 510


def test_the_objective_is_the_papers_sum_with_the_papers_weights(tiny_dive):
    paper = UwbsSettings(
        weights=LossWeights(
            in_front=0.0, guess=0.0, coverage=0.0, open_water=0.0, gamut=0.0, hidden=0.0, max_radius=100.0
        )
    )
    view = TrainingViews(tiny_dive.rec, tiny_dive.frames, paper, 1.0)[3]
    p = tiny_dive.truth.primitives
    p = p._replace(xyz=p.xyz + 0.05, scale=p.scale.clone())
    p.scale[0] = 3.0  # larger than 100 px of a 1280 px wide image
    drawing = draw(p, tiny_dive.truth.field, view_camera(view.camera), paper)
    found = uwbs.objective(p, drawing, view, paper, None, regularized=True)
    n = {name: float(torch.as_tensor(value).detach()) for name, value in found.numbers.items()}
    expected = 0.8 * n["l1"] + 0.2 * (1 - n["ssim"]) + 0.01 * n["opacity"] + 0.01 * n["scale"]
    expected += 0.1 * n["depth"] + 1.0 * n["medium_smoothness"] + 0.1 * n["radius"]
    assert float(found.total) == pytest.approx(expected, rel=1e-5)
    assert min(n["depth"], n["radius"], n["l1"]) > 0
    without = uwbs.objective(p, drawing, view, paper, None, regularized=False)
    assert float(found.total - without.total) == pytest.approx(0.01 * (n["opacity"] + n["scale"]), rel=1e-3)


def test_a_map_in_front_of_measured_depth_costs_its_weight(tiny_dive):
    totals, found = [], {}
    for weight in (0.0, 2.0):
        settings = UwbsSettings(weights=LossWeights(in_front=weight))
        view = TrainingViews(tiny_dive.rec, tiny_dive.frames, settings, 1.0)[3]
        p = tiny_dive.truth.primitives
        p = p._replace(xyz=p.xyz * 0.9)
        drawing = draw(p, tiny_dive.truth.field, view_camera(view.camera), settings)
        loss = uwbs.objective(p, drawing, view, settings, None, regularized=False)
        found = loss.numbers
        totals.append(float(loss.total))
    assert float(found["in_front"]) == pytest.approx((1 / 0.9 - 1) ** 2, rel=0.3)
    assert totals[1] - totals[0] == pytest.approx(2.0 * float(found["in_front"]), rel=1e-4)


def test_maps_of_gray_frames_are_gray(tiny_dive, tmp_path):
    rendered = {}
    for gray in (True, False):
        frames = replace(tiny_dive.frames, gray=gray)
        scene = train(tiny_dive.rec, frames, SETTINGS, tmp_path / str(gray))
        out = scene.render(tiny_dive.rec.cameras[3])
        rendered[gray] = torch.cat([out.rgb, out.clear], -1).unflatten(-1, (2, 3))
    apart = {gray: float((image - image.mean(-1, keepdim=True)).abs().max()) for gray, image in rendered.items()}
    assert apart[True] < 1e-6
    assert apart[False] > 0.01
    assert rendered[True].std() > 0.01


def test_a_map_off_guessed_depth_costs_its_weight(tiny_dive):
    totals, found = [], {}
    for weight in (1.0, 3.0):
        settings = UwbsSettings(weights=LossWeights(guess=weight))
        view = TrainingViews(tiny_dive.rec, tiny_dive.frames, settings, 1.0)[3]
        known = view.z_depth.clone()
        known[:, : known.shape[1] // 2] = 0  # the map is as far as they were; the guess is twice as far
        view = replace(view, z_depth=known, guessed_z_depth=torch.where(known > 0, 0.0, 2 * view.z_depth))
        drawing = draw(tiny_dive.truth.primitives, tiny_dive.truth.field, view_camera(view.camera), settings)
        loss = uwbs.objective(tiny_dive.truth.primitives, drawing, view, settings, None, regularized=False)
        found = loss.numbers
        totals.append(float(loss.total))
    assert float(found["off_guess"]) == pytest.approx(math.log(2 / 1.1) ** 2 / 2, rel=0.2)
    assert totals[1] - totals[0] == pytest.approx(2.0 * float(found["off_guess"]), rel=1e-4)


def test_mcmc_noise_comes_with_every_step_where_asked(tiny_dive):
    views = TrainingViews(tiny_dive.rec, tiny_dive.frames, SETTINGS, 1.0)
    moved = {}
    for cadence in ("round", "step"):
        faint = replace(SETTINGS, iterations=1000, initial=InitialSettings(primitives=200, opacity=0.004))
        settings = replace(faint, densify=DensifySettings(noise_cadence=cadence))
        recipe = uwbs.Uwbs(settings, TrainingScene(tiny_dive.rec, 1.0, 1.0, views))
        moved[cadence] = recipe.step(recipe.start(), views[3], 1)[0].primitives.xyz
    assert (moved["round"] != moved["step"]).any(-1).float().mean() > 0.9


def test_rates_settle_from_half_of_the_run_on(tiny_dive):
    held = replace(SETTINGS, sgg=SggSettings(enabled=False), densify=DensifySettings(refine_stop=0.0))
    views = TrainingViews(tiny_dive.rec, tiny_dive.frames, held, 1.0)
    settling = replace(held, rates=replace(held.rates, final_rate_factor=0.01))
    start = uwbs.Uwbs(held, TrainingScene(tiny_dive.rec, 1.0, 1.0, views)).start()
    for step, share in ((20, 1.0), (30, 0.1), (40, 0.01)):
        moved = []
        for settings in (held, settling):
            recipe = uwbs.Uwbs(settings, TrainingScene(tiny_dive.rec, 1.0, 1.0, views))
            after = recipe.step(copy.deepcopy(start), views[3], step)[0].primitives.opacity
            moved.append((after - start.primitives.opacity).abs().max())
        assert moved[0] > 0
        torch.testing.assert_close(moved[1], share * moved[0], rtol=1e-4, atol=0)


def test_a_near_plane_behind_the_scene_is_refused_before_training(tiny_dive, tmp_path):
    settings = replace(SETTINGS, render=replace(SETTINGS.render, near=10.0))
    with pytest.raises(UsageError, match="near plane"):
        train(tiny_dive.rec, tiny_dive.frames, settings, tmp_path)
    assert not any(tmp_path.iterdir())


def test_an_observer_sees_the_map_grow_and_changes_none_of_its_bits(tiny_dive, tmp_path):
    seen: list[tuple[int, int, SplatMap]] = []

    def watch(done: TrainingStep) -> None:
        if done.step % 10:
            return
        scene = done.map()
        scene.render(done.camera())
        torch.rand(3)  # an observer's own randomness is none of the training's
        seen.append((done.step, done.iterations, scene))

    unwatched = train(tiny_dive.rec, tiny_dive.frames, SETTINGS, tmp_path / "unwatched")
    watched = train(tiny_dive.rec, tiny_dive.frames, SETTINGS, tmp_path / "watched", observer=watch)
    assert equal(unwatched, watched)
    assert [(step, of) for step, of, _ in seen] == [(10, 40), (20, 40), (30, 40), (40, 40)]
    assert equal(seen[-1][2], watched)
    assert not equal(seen[0][2], seen[1][2])  # each stays as it was


def test_the_first_steps_train_on_smaller_images_and_the_rest_on_whole_ones(tiny_dive, monkeypatch: pytest.MonkeyPatch):
    widths: list[int] = []
    dilations: list[float] = []
    real = uwbs.draw
    monkeypatch.setattr(
        uwbs,
        "draw",
        lambda p, field, view, drawn_by, *rest, **more: (
            widths.append(view.width)
            or dilations.append(drawn_by.render.dilation)
            or real(p, field, view, drawn_by, *rest, **more)
        ),
    )
    settings = replace(SETTINGS, iterations=4, coarse_until=0.5)
    views = TrainingViews(tiny_dive.rec, tiny_dive.frames, settings, 1.0)
    recipe = uwbs.Uwbs(settings, TrainingScene(tiny_dive.rec, 1.0, 1.0, views))
    state = recipe.start()
    for step in range(1, 5):
        state, _ = recipe.step(state, views[0], step)
    whole = views[0].rgb.shape[-1]
    assert widths == [whole // 2, whole // 2, whole, whole]
    assert dilations == [0.075, 0.075, 0.3, 0.3]  # px^2: the same width in the scene
