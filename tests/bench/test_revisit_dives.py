"""The dives of repeat visits are chosen by the truth, so that there is something to find where both visits look."""

import pytest
import torch

from swimm3r.bench import revisit_dives
from swimm3r.bench.revisit_dives import LEAST, VIEWS, WATERS, filmed_by_both, pair_of_dives
from swimm3r.bench.settings import RevisitSettings
from swimm3r.cameras import Cameras, project_visible
from swimm3r.errors import UsageError
from swimm3r.synthetic import make_dive
from swimm3r.synthetic.season import corals_of


@pytest.mark.parametrize("number", range(len(WATERS)))
def test_both_visits_film_bleached_grown_and_moved_corals(number: int):
    first, later, same = pair_of_dives(number, RevisitSettings())
    filmed = filmed_by_both(first, later)
    assert all(filmed[fate] >= count for fate, count in LEAST.items())
    assert (first.family, later.family) == WATERS[number]
    assert first.seed == later.seed == same.seed
    assert filmed_by_both(first, same).keys() == {"unchanged"}


def test_the_seed_is_the_first_of_every_fourth_one_with_such_corals():
    start = RevisitSettings()
    chosen = pair_of_dives(0, start)[0].seed
    assert (chosen - start.seed) % len(WATERS) == 0
    assert chosen > start.seed  # else nothing below is tried
    assert pair_of_dives(0, RevisitSettings(seed=start.seed + len(WATERS)))[0].seed == chosen
    assert pair_of_dives(0, RevisitSettings(seed=chosen + len(WATERS)))[0].seed > chosen


def test_a_coral_that_is_filmed_whole_has_its_middle_in_images_of_both_visits():
    first, later, _ = pair_of_dives(0, RevisitSettings())
    corals = [
        coral
        for column in range(-4, 8)
        for row in range(-4, 8)
        for coral in corals_of(column, row, later.corals, later.season, later.seed)
        if coral.fate == "bleached"
    ]
    middles = torch.tensor([[*coral.before[1:3], 0.0] for coral in corals], dtype=torch.float64)
    shown = torch.stack([images_of(make_dive(dive).cameras, middles) for dive in (first, later)]).amin(0)
    assert 0 < filmed_by_both(first, later)["bleached"] <= int((shown >= VIEWS).sum())


def images_of(cameras: Cameras, points: torch.Tensor) -> torch.Tensor:
    """The number of images that show each point."""
    return project_visible(cameras, points.expand(len(cameras), -1, -1))[2].sum(0)


def test_frames_too_narrow_for_such_corals_are_refused_with_advice(monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setattr(revisit_dives, "_SEEDS", 2)
    with pytest.raises(UsageError, match="both visits film") as refused:
        pair_of_dives(0, RevisitSettings(width=320, height=48))
    assert "--path-length" in refused.value.hint
