"""Changes of the ground: found where they are, silent where only light or noise differ, unknown where nobody looked."""

import json

import numpy as np
import pytest

from swimm3r.products.grid import Grid
from swimm3r.scene.georeference import Georeference
from swimm3r.visits.change import LESS, MORE, UNCHANGED, UNKNOWN, Misfit, compare
from swimm3r.visits.color import lab, light_gains, neutral
from swimm3r.visits.ground import Ground
from swimm3r.visits.places import find_places, write_polygons
from swimm3r.visits.settings import VisitSettings

SIDE, GSD, NOISE = 120, 0.01, 0.002
WHITE = np.ones(3)
NO_MISFIT = Misfit(np.zeros((SIDE, SIDE)), np.zeros((SIDE, SIDE)))


def ground(
    seed: int,
    raised: np.ndarray | float = 0.0,
    light: tuple[float, float, float] = (1, 1, 1),
    *,
    albedo: np.ndarray | float = 1.0,
    stated: float = NOISE,
) -> Ground:
    rng, shape = np.random.default_rng(seed), (SIDE, SIDE)
    y, x = np.mgrid[:SIDE, :SIDE] * GSD
    height = 0.02 * np.sin(4 * x) * np.cos(3 * y) + raised + rng.normal(0, NOISE, shape)
    color = 0.2 + 0.05 * np.sin(9 * x)[..., None] * np.array([1.0, 0.5, -0.5]) + rng.normal(0, 0.004, (*shape, 3))
    return Ground(
        height=height.astype(np.float32),
        height_std=np.full(shape, stated, np.float32),
        views=np.full(shape, 5, np.uint16),
        color=(color * np.broadcast_to(albedo, shape)[..., None] * np.array(light)).astype(np.float32),
        color_std=np.full((*shape, 3), 0.004, np.float32),
        distance=np.full(shape, 2.0, np.float32),
        slant=np.zeros(shape, np.float32),
    )


def disc(row: int, column: int, radius: int) -> np.ndarray:
    rows, columns = np.mgrid[:SIDE, :SIDE]
    return np.hypot(rows - row, columns - column) < radius


def test_ground_gained_and_lost_is_found_with_its_volume():
    up, down = disc(40, 40, 15), disc(80, 85, 12)
    change = compare(ground(1), ground(2, 0.03 * up - 0.02 * down), NO_MISFIT, GSD, WHITE, VisitSettings())
    for mask, code, height in ((up, MORE, 0.03), (down, LESS, -0.02)):
        found = change.height_kind == code
        assert (found & mask).sum() / mask.sum() > 0.9
        assert (found & mask).sum() / found.sum() > 0.9
        volume = change.height.value[found].sum() * GSD**2
        assert volume == pytest.approx(height * mask.sum() * GSD**2, rel=0.07)  # without the flanks
    assert not ((change.color_kind == MORE) | (change.color_kind == LESS)).any()


def test_a_place_of_color_without_heights_says_so_instead_of_nan(tmp_path):
    bleached = disc(60, 60, 14)
    change = compare(ground(1), ground(2, albedo=1 + 2 * bleached), NO_MISFIT, GSD, WHITE, VisitSettings())
    grid = Grid(0.0, 0.0, GSD, SIDE, SIDE)
    somewhere = Georeference(None, (0.0, 0.0, 0.0), ((1.0, 0.0, 0.0), (0.0, 1.0, 0.0), (0.0, 0.0, 1.0)), 1.0)
    (place,), _ = find_places(change, grid, somewhere)
    assert place.kind == "paler"
    assert place.height == pytest.approx(0.0, abs=2 * NOISE)
    change.height.value[:, :60] = np.nan
    (half,), _ = find_places(change, grid, somewhere)
    assert half.height == pytest.approx(0.0, abs=2 * NOISE)
    change.height.value[:] = np.nan
    (none,), outlines = find_places(change, grid, somewhere)
    assert none.height is None
    assert none.height_std is None
    write_polygons(tmp_path / "places.geojson", [none], outlines, grid, somewhere)
    assert json.loads((tmp_path / "places.geojson").read_text())["features"][0]["properties"]["height"] is None


def test_noise_alone_changes_nothing():
    change = compare(ground(1), ground(2), NO_MISFIT, GSD, WHITE, VisitSettings())
    assert (change.height_kind == UNCHANGED).all()
    assert (change.color_kind == UNCHANGED).all()


def test_understated_deviations_are_raised_to_the_spread_of_the_ground():
    honest = compare(ground(1), ground(2), NO_MISFIT, GSD, WHITE, VisitSettings()).height
    bold = compare(ground(1, stated=1e-5), ground(2, stated=1e-5), NO_MISFIT, GSD, WHITE, VisitSettings()).height
    assert honest.inflation == 1.0  # the filter makes them smaller than stated
    assert bold.inflation > 1.0
    spread = float(np.std(bold.value))
    assert float(np.median(bold.std)) == pytest.approx(spread, rel=0.5)


def test_deviations_are_raised_where_shared_points_are_far():
    """Ground beyond the shared points is bent up and down; no place of it has changed."""
    bent = np.zeros((SIDE, SIDE))
    bent[:, 60:] = 0.03 * np.sin(np.arange(60) / 9)
    far = np.where(np.arange(SIDE) < 60, 1e-4, 2e-4) * np.ones((SIDE, 1))
    misfit = Misfit(np.zeros((SIDE, SIDE)), far)
    told = compare(ground(1), ground(2, bent), misfit, GSD, WHITE, VisitSettings())
    blind = compare(ground(1), ground(2, bent), NO_MISFIT, GSD, WHITE, VisitSettings())
    assert (blind.height_kind[:, 60:] != UNCHANGED).any()
    assert (told.height_kind == UNCHANGED).all()
    assert np.median(told.height.std[:, 70:]) > 3 * np.median(told.height.std[:, :50])


def test_other_light_is_taken_out_and_bleaching_found():
    bleached = disc(60, 60, 14)
    later = ground(2, 0.0, (0.5, 0.9, 1.3), albedo=1 + 2 * bleached)
    change = compare(ground(1), later, NO_MISFIT, GSD, WHITE, VisitSettings())
    assert change.gains == pytest.approx(1 / np.array([0.5, 0.9, 1.3]), rel=0.02)
    paler = change.color_kind == MORE
    assert (paler & bleached).sum() / bleached.sum() > 0.9
    assert (paler & bleached).sum() / paler.sum() > 0.8
    assert not (change.color_kind == LESS).any()
    assert (change.height_kind == UNCHANGED).all()


def test_colors_of_ground_whose_height_is_uncertain_count_less_where_rays_are_slanted():
    """Patterned ground that a visit has 3 cm too high, seen at 45 degrees: its colors lie 3 cells beside."""
    high = np.full((SIDE, SIDE), 0.03)
    high[:, :70] = 0.0
    moved = ground(2, high)
    moved.color[:, 70:] = np.roll(moved.color, 3, axis=1)[:, 70:]
    nadir = compare(ground(1), moved, NO_MISFIT, GSD, WHITE, VisitSettings())
    moved.slant[:] = 1.0
    slanted = compare(ground(1), moved, NO_MISFIT, GSD, WHITE, VisitSettings())
    assert nadir.color is not None
    assert slanted.color is not None
    raised, flat = np.s_[10:-10, 80:-10], np.s_[10:-10, 10:50]
    assert np.median(slanted.color.std[raised] / nadir.color.std[raised]) > 1.5
    assert np.median(slanted.color.std[flat] / nadir.color.std[flat]) == pytest.approx(1.0, abs=0.2)


@pytest.mark.parametrize("cells", [2, 7])
def test_bleaching_is_found_on_patterned_ground_whose_place_is_uncertain_and_a_shift_is_not_called_bleaching(
    cells: int,
):
    """Squares of two colors, 6 cells wide, of a place known to some cells: the later visit has them so far beside."""
    rows, columns = np.mgrid[:SIDE, :SIDE] // 6
    squares = 1 + 0.8 * ((rows + columns) % 2)
    bleached = disc(60, 60, 14)
    unsure = Misfit(np.full((SIDE, SIDE), cells * GSD), np.zeros((SIDE, SIDE)))
    beside = ground(2, albedo=np.where(bleached, 5.0, np.roll(squares, cells, axis=1)))
    change = compare(ground(1, albedo=squares), beside, unsure, GSD, WHITE, VisitSettings())
    paler = change.color_kind == MORE
    assert (paler & bleached).sum() / bleached.sum() > 0.9
    assert (paler & bleached).sum() / paler.sum() > 0.9
    assert not (change.color_kind == LESS).any()


def test_cells_beside_a_hole_take_their_doubt_from_the_heights_nearby():
    a, b = ground(1), ground(2, 0.03 * disc(50, 50, 25))
    b.slant[:] = a.slant[:] = 1.0
    b.height[40:60, 40:60] = np.nan
    change = compare(a, b, Misfit(np.zeros((SIDE, SIDE)), np.full((SIDE, SIDE), 0.1)), GSD, WHITE, VisitSettings())
    assert change.color is not None
    assert np.isnan(change.height.value[39, 50])
    assert change.color.std[39, 50] > 0.5 * np.median(change.color.std[32:38, 45:55])
    assert change.color.std[39, 50] > 1.3 * np.median(change.color.std[80:, 80:])


def test_light_alone_changes_no_color():
    change = compare(ground(1), ground(2, 0.0, (0.4, 1.0, 1.2)), NO_MISFIT, GSD, WHITE, VisitSettings())
    assert (change.color_kind == UNCHANGED).all()


def test_ground_that_one_visit_did_not_see_is_unknown():
    later = ground(2, 0.05 * disc(60, 60, 20))
    later.height[:, 50:] = later.color[:, 50:] = np.nan
    change = compare(ground(1), later, NO_MISFIT, GSD, WHITE, VisitSettings())
    assert (change.height_kind[:, 50:] == UNKNOWN).all()
    assert (change.color_kind[:, 50:] == UNKNOWN).all()
    assert np.isnan(change.height.value[:, 50:]).all()
    assert (change.height_kind[60, 42:47] == MORE).all()
    assert change.comparable.sum() == 120 * 49  # cells beside a hole have no sure height


def test_an_uncertain_alignment_bounds_what_is_called_a_change():
    later = ground(2, 0.03 * disc(60, 60, 20))
    sure = compare(ground(1), later, NO_MISFIT, GSD, WHITE, VisitSettings())
    vague = compare(
        ground(1), later, Misfit(np.zeros((SIDE, SIDE)), np.full((SIDE, SIDE), 0.02)), GSD, WHITE, VisitSettings()
    )
    assert (sure.height_kind == MORE).any()
    assert not (vague.height_kind == MORE).any()


def test_level_misfit_counts_on_slopes_only():
    steep = 0.05 * disc(60, 60, 20)
    one = compare(
        ground(1, steep),
        ground(2, steep),
        Misfit(np.full((SIDE, SIDE), 0.005), np.zeros((SIDE, SIDE))),
        GSD,
        WHITE,
        VisitSettings(),
    )
    edge, flat = one.height.std[60, 40], one.height.std[20, 100]
    assert edge > 2 * flat


@pytest.mark.parametrize(("least", "found"), [(None, False), (0.0005, True)])
def test_places_smaller_than_the_least_area_are_left_out(least: float | None, found: bool):
    later = ground(2, 0.05 * disc(60, 60, 2))
    settings = VisitSettings(min_area=least)
    assert (compare(ground(1), later, NO_MISFIT, GSD, WHITE, settings).height_kind == MORE).any() == found


def test_visits_without_clear_colors_are_compared_by_height_alone():
    a, b = ground(1), ground(2, 0.03 * disc(60, 60, 20))
    b.color[:] = np.nan
    change = compare(a, b, NO_MISFIT, GSD, WHITE, VisitSettings())
    assert change.color is None
    assert change.lab is None
    assert (change.color_kind == UNKNOWN).all()
    assert (change.height_kind == MORE).any()


def test_cielab_of_white_and_of_gray_is_that_of_the_standard():
    assert lab(np.ones(3)) == pytest.approx([100, 0, 0], abs=0.01)
    assert lab(np.full(3, 0.184187)) == pytest.approx([50, 0, 0], abs=0.01)
    assert lab(np.array([1.0, 0, 0])) == pytest.approx([53.24, 80.09, 67.20], abs=0.02)


def test_gains_rest_on_stable_ground_alone_and_say_when_there_is_none():
    a, b = ground(1).color, ground(2, light=(0.5, 1, 1)).color
    b[:60] *= 3
    stable = np.zeros((SIDE, SIDE), bool)
    assert np.isinf(light_gains(a, b, stable)[1]).all()
    stable[60:] = True
    gains, std = light_gains(a, b, stable)
    assert gains == pytest.approx([2, 1, 1], rel=0.02)
    assert (std < 0.01).all()


def test_the_tint_of_the_first_visit_is_made_gray():
    tinted = ground(1, light=(0.3, 0.8, 1.0)).color
    balanced = tinted * neutral(tinted)
    assert balanced.reshape(-1, 3).mean(0).std() < 0.1 * balanced.mean()
