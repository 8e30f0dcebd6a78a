"""Rounds of densification, and trainings at the ends of what the settings allow."""

import json
import math
from dataclasses import replace

import pytest
import torch

from swimm3r.splat import train
from swimm3r.splat.densify import schedule
from swimm3r.splat.primitives.thinning import voxel_sample
from swimm3r.splat.settings import DensifySettings, InitialSettings, MoverSettings, UwbsSettings, with_recipe

PAPER = DensifySettings()


def test_the_papers_rounds_are_every_100_steps_from_beyond_500_to_10000():
    rounds = [step for step in range(1, 20_001) if schedule.has_round(PAPER, step, 20_000)]
    assert rounds == list(range(600, 10_001, 100))


def test_growth_by_2_percent_a_round_doubles_400000_primitives_in_36_rounds():
    counts = [400_000]
    while counts[-1] < 800_000:
        counts.append(schedule.grown(counts[-1], PAPER.cap_max, PAPER.growth, PAPER, 20_000))
    assert len(counts) - 1 == 36
    assert counts[1] == 408_000
    assert schedule.grown(800_000, 800_000, 1.02, PAPER, 20_000) == 800_000
    assert schedule.grown(900_000, 800_000, 1.02, PAPER, 20_000) == 900_000  # nobody is removed


def test_rounds_farther_apart_make_up_for_those_left_out():
    short = replace(PAPER, min_refine_every=20)  # of 2,000 steps every 10th would have a round
    assert schedule.steps_between(short, 2000) == 20
    assert schedule.grown(10_000, 50_000, 1.02, short, 2000) == int(1.02**2 * 10_000)


def test_no_growth_is_too_much_for_the_arithmetic():
    often = DensifySettings(refine_every=1e-6, min_refine_every=1000, growth=2.0)
    assert schedule.grown(400, 700, often.growth, often, 1) == 700
    assert schedule.grown(400, 700, 1.0, often, 1) == 400


def test_a_sample_is_never_smaller_than_asked_for_where_points_allow():
    """Voxels of the corners of a cube are 1, 2, 4 or 8."""
    corners = torch.cartesian_prod(*[torch.tensor([0.0, 1.0]).double()] * 3) * torch.tensor([1.0, 1.01, 1.02]).double()
    for target in range(1, 9):
        assert target <= len(voxel_sample(corners, target)) <= 8


EXTREMES = {
    "one step": {"iterations": 1},
    "fewest primitives": {"iterations": 2, "initial": InitialSettings(primitives=4)},
    "rounds rarer than the run is long": {
        "iterations": 3,
        "densify": DensifySettings(refine_every=1.0, min_refine_every=10),
    },
    "a round every step, at full growth": {
        "iterations": 3,
        "densify": DensifySettings(
            refine_start=0, refine_stop=1, refine_every=1e-6, min_refine_every=1, growth=2.0, cap_max=700
        ),
    },
    "windows the wrong way round": {"iterations": 2, "densify": DensifySettings(refine_start=1, refine_stop=0)},
    "everything is dead": {
        "iterations": 2,
        "densify": DensifySettings(
            refine_start=0, refine_stop=1, min_refine_every=1, refine_every=1e-6, min_opacity=1 - 1e-6
        ),
    },
    "movers in the last step": {"iterations": 2, "dynamic": True, "movers": MoverSettings(at=1.0)},
    "nothing but movers": {"iterations": 2, "dynamic": True, "movers": MoverSettings(at=0.5, share=1.0)},
}


@pytest.mark.parametrize("changes", EXTREMES.values(), ids=EXTREMES.keys())
def test_maps_are_trained_and_recorded_at_the_ends_of_what_settings_allow(changes: dict, tiny_dive, tmp_path):
    settings = replace(UwbsSettings(initial=InitialSettings(primitives=300)), **changes)
    scene = train(tiny_dive.rec, tiny_dive.frames, settings, tmp_path)
    assert all(bool(values.isfinite().all()) for values in scene.primitives)
    assert len(scene.primitives.xyz) <= max(settings.initial.primitives * 1.05 + 8, settings.densify.cap_max)
    last = json.loads((tmp_path / "metrics.jsonl").read_text().splitlines()[-1])
    assert last["step"] == settings.iterations
    assert math.isfinite(last["loss"])


@pytest.mark.parametrize(
    "recipe", ["ubs", "mcmc_gs", "threers_gs", "watersplatting", "seasplat", "oceansplat", "3d-uir"]
)
def test_every_recipe_takes_one_step_and_rounds_without_pause(recipe, tiny_dive, tmp_path):
    settings = with_recipe(UwbsSettings(iterations=2, initial=InitialSettings(primitives=4)), recipe)
    cadence = {"refine_start": 0.0, "refine_stop": 1.0, "refine_every": 1.0, "min_refine_every": 1}
    if recipe not in ("ubs", "mcmc_gs", "threers_gs"):
        cadence["reset_every"] = 0.1  # more often than there are rounds
    settings = replace(settings, densify=replace(settings.densify, **cadence))
    scene = train(tiny_dive.rec, tiny_dive.frames, settings, tmp_path)
    assert all(bool(values.isfinite().all()) for values in scene.primitives)
