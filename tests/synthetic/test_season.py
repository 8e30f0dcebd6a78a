"""Repeat visits to the synthetic seafloor: corals and their fates, shifted sand, another path, with exact volumes."""

import numpy as np
import pytest

from swimm3r.errors import UsageError
from swimm3r.synthetic.path import survey
from swimm3r.synthetic.seafloor import CELL, CELLS, with_animals, with_shifted_sand
from swimm3r.synthetic.season import CORAL, Coral, corals_of, planted, sand_shift, volume
from swimm3r.synthetic.settings import DiveSettings, Season

SEASON = Season(grown=0.25, bleached=0.25, broken=0.2, moved=0.2, algae=0.3, sand=0.1)
SQUARES = [(column, row) for column in range(20) for row in range(20)]


def corals(season: Season, density: float = 0.7) -> list[Coral]:
    return [coral for column, row in SQUARES for coral in corals_of(column, row, density, season, 3)]


def test_the_volume_of_a_coral_is_that_of_its_dome():
    fields = (float(CORAL), 7.0, 7.0, 0.16, 0.11, 0.4, 0.2, 0.1, 0.05)
    height = np.zeros((CELLS + 1, CELLS + 1))
    with_animals(height, np.array([fields]), 0.0, 0.0)
    assert height.sum() * CELL**2 == pytest.approx(volume(fields), rel=0.01)
    assert height.max() == pytest.approx(0.11, rel=1e-3)


def test_a_season_changes_the_fates_of_corals_and_nothing_that_they_were_before():
    first, later = corals(Season()), corals(SEASON)
    assert [coral.before for coral in first] == [coral.before for coral in later]
    assert all(coral.before == coral.after for coral in first)
    shares = {
        fate: np.mean([coral.fate == fate for coral in later]) for fate in ("grown", "bleached", "broken", "moved")
    }
    for fate, share in shares.items():
        assert share == pytest.approx(getattr(SEASON, fate), abs=0.08)


def test_each_fate_does_what_it_says():
    for coral in corals(SEASON):
        before, after = np.array(coral.before), np.array(coral.after)
        same = {
            "unchanged": range(9),
            "grown": (0, 1, 2, 5, 6, 7, 8),
            "bleached": range(6),
            "broken": (0, 1, 2, 3, 5, 6, 7, 8),
            "moved": (0, 2, 3, 4, 5, 6, 7, 8),
        }[coral.fate]
        assert np.array_equal(before == after, np.isin(np.arange(9), list(same)))
        gained = volume(coral.after) - volume(coral.before)
        assert np.sign(gained) == {"grown": 1, "broken": -1}.get(coral.fate, 0)
        if coral.fate == "bleached":
            assert (after[6:] > 0.5).all()


def test_corals_keep_clear_of_each_other_wherever_a_season_moves_them():
    places = [place for coral in corals(SEASON, 1.0) for place in {coral.before[1:4], coral.after[1:4]}]
    by_square = [(coral, place) for coral in corals(SEASON, 1.0) for place in {coral.before[1:4], coral.after[1:4]}]
    assert len(places) > len(SQUARES)
    for coral, (x, y, r) in by_square:
        for other, (x2, y2, r2) in by_square:
            if other is not coral:
                assert np.hypot(x - x2, y - y2) > r + r2


def test_animals_stand_where_no_season_puts_a_coral():
    coral = corals(Season(moved=1.0), 1.0)[0]
    (x, y), (later_x, later_y) = coral.before[1:3], coral.after[1:3]
    animals = [[0.0, x + 0.1, y, 0.05, 0.01, 0, 1, 0, 0], [0.0, later_x, later_y + 0.1, 0.05, 0.01, 0, 1, 0, 0]]
    far = [0.0, x, y - 1.0, 0.05, 0.01, 0, 1, 0, 0]
    assert planted([*animals, far], [coral], []) == [far, list(coral.after)]


def test_sand_shifts_in_places_and_covers_rock_that_it_reaches():
    side = np.arange(401) * CELL * 5
    shift = sand_shift(side[None], side[:, None], SEASON, 3)
    assert 0.2 < np.mean(shift == 0) < 0.9
    assert 0.02 < shift.max() <= SEASON.sand
    assert -SEASON.sand <= shift.min() < -0.02
    sand, rock = np.zeros((401, 401)), np.full((401, 401), 0.05)
    height, share = with_shifted_sand(rock, np.ones_like(rock), sand, 0.0, 0.0, SEASON, 3)
    fine = sand_shift(CELL * np.arange(401)[None], CELL * np.arange(401)[:, None], SEASON, 3)
    assert np.allclose(height, np.maximum(0.05, fine))
    assert np.allclose(share, np.clip((height - fine) / 0.03, 0, 1))


def test_visits_differ_in_their_path_and_random_numbers_only():
    first = DiveSettings(path="transect", length=5, corals=0.5)
    again = DiveSettings(path="transect", length=5, corals=0.5, visit=1)
    assert first.stream(2, 7) == [0, 2, 7]
    assert first.stream(2, 7) != again.stream(2, 7)
    apart = np.linalg.norm(survey(first)[:, :3, 3] - survey(again)[:, :3, 3], axis=1)
    assert 0.02 < apart.mean() < 0.6


def test_a_coral_has_one_fate():
    with pytest.raises(UsageError, match=r"1\.2 together"):
        Season(grown=0.7, bleached=0.5)
