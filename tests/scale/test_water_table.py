"""The water in 1/m: standard deviations with the scale's, and what is derived is derived right."""

from dataclasses import replace

import numpy as np
import pytest
import torch
from tests.scale.test_rescale import water

from swimm3r.medium import AttenuationCurve, Medium, MediumFit, rescale
from swimm3r.report.scale import metric_water, plus_minus, scale_section
from swimm3r.scale.water_table import water_table
from swimm3r.water_types import JERLOV


def of_type(kind: str, std: float = 0.01) -> MediumFit:
    beta = torch.tensor(JERLOV[kind])  # type: ignore[index]
    zero = torch.zeros(3)
    spread = Medium(torch.full((3,), 0.01), std * beta, std * beta)
    known = {name: torch.ones(3, dtype=torch.bool) for name in ("Binf", "beta_D", "beta_B")}
    curve = AttenuationCurve(beta, zero, zero, zero)
    return MediumFit(torch.full((3,), 0.3), beta, beta, curve, spread, known, (0.5, 6.0), "linear")


@pytest.mark.parametrize("kind", list(JERLOV))
def test_the_nearest_type_of_a_type_is_itself(kind):
    derived = water_table(of_type(kind), 0.01)["derived"]
    assert (derived["jerlov"], derived["jerlov_in_std"]) == (kind, 0.0)


def test_stored_pixel_values_and_undetermined_channels_have_no_type():
    stored = replace(of_type("II"), encoding="srgb")
    assert water_table(stored, 0.01)["derived"]["jerlov"] is None
    fit = of_type("II")
    blind = replace(fit, identifiable={**fit.identifiable, "beta_D": torch.zeros(3, dtype=torch.bool)})
    assert "no channel" in water_table(blind, 0.01)["derived"]["jerlov_reason"]


def test_a_black_target_at_the_visibility_keeps_two_percent_of_its_contrast():
    fit = of_type("III")
    visibility = torch.tensor(water_table(fit, 0.0)["derived"]["visibility_m"])
    torch.testing.assert_close(torch.exp(-fit.beta_B * visibility), torch.full((3,), 0.02))


def test_the_scale_is_part_of_every_standard_deviation():
    table = water_table(of_type("II", std=0.03), 0.04)
    for name in ("beta_D", "beta_B"):
        np.testing.assert_allclose(np.array(table[name]["std"]) / table[name]["value"], 0.05, rtol=1e-4)
    np.testing.assert_allclose(
        table["derived"]["visibility_std_m"], 0.05 * np.array(table["derived"]["visibility_m"]), rtol=1e-4
    )


def test_ranges_beyond_the_data_are_marked():
    inside = {at["range_m"]: at["within_data"] for at in water_table(of_type("II"), 0.01)["beta_D_at"]}
    assert inside == {1.0: True, 2.0: True, 3.0: True, 5.0: True, 8.0: False}


def test_the_table_of_rescaled_water_is_that_of_rescaled_distances():
    one, other = water_table(water(), 0.0), water_table(rescale(water(), 0.5), 0.0)
    np.testing.assert_allclose(other["beta_B"]["value"], np.array(one["beta_B"]["value"]) / 0.5, rtol=1e-6)
    by_range = [{at["range_m"]: at["value"] for at in table["beta_D_at"]} for table in (one, other)]
    np.testing.assert_allclose(by_range[1][1.0], np.array(by_range[0][2.0]) / 0.5, rtol=1e-6)


def test_the_page_shows_lengths_with_their_standard_deviation():
    summary = {
        "scale": {
            "unit": "m", "factor": 0.4, "metres_per_unit": 0.4, "std": 0.01, "notes": ["A note."],
            "sources": [{
                "source": "marker 3", "scale": 0.4, "std": 0.01, "residual": 0.002, "residual_in_std": 0.2,
                "outlier": False, "detail": "0.2 m in 5 frames",
            }],
            "georeference": {"crs": "EPSG:32701", "origin_m": [1.0, 2.0, -3.0], "origin_std_m": [0.1, 0.1, 0.2]},
        },
        "water": water_table(of_type("II", std=0.03), 0.04),
    }  # fmt: skip
    section, table = scale_section(summary), metric_water(summary)
    assert section is not None
    assert table is not None
    assert "0.4000 \u00b1 0.0040 m" in section.lead
    assert section.lines[0].startswith("Origin of the coordinates in EPSG:32701: east 1.00 \u00b1 0.10 m")
    assert section.lines[-1] == "A note."
    assert "beyond the frames' distances" in table.rows[4][0]
    assert any("Jerlov's water types is II" in line for line in table.lines)
    assert scale_section({}) is None
    assert metric_water({}) is None


def test_numbers_have_two_digits_of_their_standard_deviation():
    assert plus_minus(0.380433, 0.0017) == "0.3804 \u00b1 0.0017"
    assert plus_minus(544734.808, 12.0) == "544735 \u00b1 12"
    assert plus_minus(1.5, float("inf")) == "1.5"
