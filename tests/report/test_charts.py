"""The page's charts."""

import numpy as np
import pytest

from swimm3r.report import charts


@pytest.mark.parametrize("largest", [0.007, 0.3, 1.0, 3.8, 12.0, 980.0])
def test_ticks_are_round_few_and_within(largest: float):
    ticks = charts.ticks(largest)
    assert 3 <= len(ticks) <= 6
    assert ticks[0] == 0
    assert ticks[-1] <= largest
    assert all(f"{t:g}" == f"{t:.3g}" for t in ticks)


def test_a_curve_is_dashed_beyond_what_was_seen():
    x = np.linspace(0, 5, 20, dtype=np.float32)
    svg = charts.line_chart([charts.Curve(x, x**2, "#f00", "R", solid_until=3.0)], "z", "B")
    assert svg.count("<polyline") == 2
    assert svg.count("stroke-dasharray") == 2  # of the line and of its sample in the legend
    assert ">z<" in svg


def test_a_chart_names_its_lines_and_axes():
    x = np.linspace(0, 5, 20)
    curves = [charts.Curve(x, x, "#f00", "red"), charts.Curve(x, 2 * x, "#00f", "blue", solid_until=4.0)]
    svg = charts.line_chart(curves, "distance, m", "share <of> light")
    for text in (">red<", ">blue<", ">beyond the depths seen<", ">distance, m<", ">share &lt;of&gt; light<"):
        assert text in svg
    assert 'aria-label="share &lt;of&gt; light over distance, m: red, blue"' in svg


def test_a_chart_of_zeros_is_drawn():
    zeros = np.zeros(5)
    assert "nan" not in charts.line_chart([charts.Curve(zeros, zeros, "#f00", "none")], "x", "y")
