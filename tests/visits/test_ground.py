"""The ground as one visit saw it: colors are as uncertain as the water makes them, in whatever unit the run is."""

import numpy as np
import pytest
import torch
from tests.visits.conftest import TRANSMITTED, Visits

from swimm3r.medium import linear_from_srgb, srgb_from_linear
from swimm3r.progress import silent
from swimm3r.sfm.medium.restore import color_std
from swimm3r.sfm.settings import RestoreSettings
from swimm3r.visits.alignment.place import place_visits
from swimm3r.visits.ground import Ground, common_grid, observe
from swimm3r.visits.settings import VisitSettings


@pytest.fixture(scope="module")
def grounds(visits: Visits) -> list[Ground]:
    """Both visits on one grid."""
    placed = place_visits(visits.surveys(), ["spring", "autumn"], VisitSettings(), silent)
    grid = common_grid([each.survey for each in placed])
    return [observe(each.survey, grid) for each in placed]


def test_colors_that_the_water_takes_are_less_certain_at_both_visits(grounds: list[Ground]):
    """The runs have units of their own; the ground is seen from the altitude or, along slanted rays, from farther."""
    least = color_std(torch.tensor(TRANSMITTED).double(), RestoreSettings())
    assert least[0] > 5 * least[1]
    for ground in grounds:
        color, found = (np.nanmedian(each.reshape(-1, 3), axis=0) for each in (ground.color, ground.color_std))
        stored = srgb_from_linear(torch.from_numpy(color).double())
        expected = (linear_from_srgb(stored + least) - linear_from_srgb(stored - least)) / 2
        assert float(expected[0]) < found[0] < 1.4 * float(expected[0])
        assert found[1] < found[0] / 2


def test_an_error_of_the_backscatter_is_the_color_std_of_a_restored_image():
    """The error divided by the transmittance of a channel that arrives well, that of a guess of one that does not."""
    settings = RestoreSettings()
    well, lost = color_std(torch.tensor([[0.9, 0.7, 0.5], [1e-4, 1e-5, 1e-6]]), settings)
    torch.testing.assert_close(well, settings.veil_error / torch.tensor([0.9, 0.7, 0.5]), rtol=0.02, atol=0.0)
    torch.testing.assert_close(lost, torch.full((3,), settings.color_error), rtol=0.01, atol=0.0)
