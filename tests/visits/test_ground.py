"""The ground as one visit saw it: colors without the water, as uncertain as the water makes them, in any unit."""

from dataclasses import replace

import numpy as np
import pytest
import torch
from tests.visits.conftest import LATER_LIGHT, TRANSMITTED, Seabed, Visits

from swimm3r.medium import AttenuationCurve, Encoding, Medium, MediumFit, add_water, linear_from_srgb, srgb_from_linear
from swimm3r.progress import silent
from swimm3r.sfm.medium.settings import RestoreSettings
from swimm3r.visits.alignment.place import place_visits
from swimm3r.visits.color import linear
from swimm3r.visits.ground import Ground, clear_light, common_grid, observe
from swimm3r.visits.settings import VisitSettings

SEABEDS = Seabed(), Seabed(changed=True, light=LATER_LIGHT)


@pytest.fixture(scope="module")
def grounds(visits: Visits) -> list[tuple[Ground, np.ndarray]]:
    """Both visits on one grid, each with the true linear colors of its cells."""
    placed = place_visits(visits.surveys(), ["spring", "autumn"], VisitSettings(), silent)
    grid = common_grid([each.survey for each in placed])
    x, y = np.meshgrid(
        grid.x0 + (np.arange(grid.columns) + 0.5) * grid.gsd, grid.y1 - (np.arange(grid.rows) + 0.5) * grid.gsd
    )
    true = [linear(np.clip(seabed.color(x, y), 0, 1).astype(np.float32)) for seabed in SEABEDS]
    return [(observe(each.survey, grid), color) for each, color in zip(placed, true, strict=True)]


@pytest.mark.long
def test_colors_that_the_water_takes_are_less_certain_at_both_visits(grounds: list[tuple[Ground, np.ndarray]]):
    """The runs have units of their own; the ground is seen from the altitude or, along slanted rays, from farther."""
    least = RestoreSettings().veil_error / torch.tensor(TRANSMITTED).double()
    for ground, _ in grounds:
        color, found = (np.nanmedian(each.reshape(-1, 3), axis=0) for each in (ground.color, ground.color_std))
        stored = srgb_from_linear(torch.from_numpy(color).double())
        expected = (linear_from_srgb(stored + least) - linear_from_srgb(stored - least)) / 2
        assert float(expected[0]) < found[0] < 1.8 * float(expected[0])
        assert found[1] < found[0] / 2


def test_colors_are_those_of_the_ground_without_the_water(grounds: list[tuple[Ground, np.ndarray]]):
    """Red is filmed in steps that are a twelfth of white without the water: its mean is right all the same."""
    for ground, true in grounds:
        off = (ground.color - true)[ground.seen]
        assert np.abs(np.median(off, axis=0)).max() < 0.01
        assert (np.median(np.abs(off), axis=0) < [0.05, 0.02, 0.02]).all()


@pytest.mark.parametrize("encoding", ["linear", "srgb"])
@pytest.mark.parametrize("red", [0.2, 4.0])
def test_clear_light_inverts_the_water_however_little_of_a_channel_is_left(encoding: Encoding, red: float):
    """No color is held back: in any water a surface has one color. The deviation is what errors of B make."""
    beta = torch.tensor([red, 0.3, 0.2]).double()
    none, sure = (
        torch.zeros(3).double(),
        {name: torch.ones(3, dtype=torch.bool) for name in ("Binf", "beta_D", "beta_B")},
    )
    curve = AttenuationCurve(beta, none, none, none)
    fit = MediumFit(0.2 + none, beta, beta, curve, Medium(none, none, none), sure, (0.1, 9.0), encoding)
    colors = torch.tensor([[0.7, 0.1, 0.08], [0.05, 0.5, 0.9]]).double()
    ray = torch.tensor([[0.0, 0.6, 0.8], [1.2, 0.0, 0.9]]).double()
    z = ray.norm(dim=1)
    through = add_water(colors, z, fit.at(z))
    filmed, light = (through, linear_from_srgb(colors)) if encoding == "srgb" else (srgb_from_linear(through), colors)
    found, std = clear_light(filmed, ray, fit)
    np.testing.assert_allclose(found, light.numpy(), rtol=1e-6, atol=1e-7)
    share = -torch.expm1(-beta * z[:, None])  # of Binf that B(z) is
    for k in range(len(z)):
        error = RestoreSettings().veil_error / share[k]
        less, more = (clear_light(filmed, ray, replace(fit, Binf=fit.Binf + sign * error))[0][k] for sign in (1, -1))
        np.testing.assert_allclose(std[k], (more - less) / 2, rtol=1e-6)
