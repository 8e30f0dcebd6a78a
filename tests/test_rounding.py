"""Numbers as people read them."""

import math

import pytest

from swimm3r.rounding import rounded


@pytest.mark.parametrize(
    ("value", "figures", "text"),
    [
        (12.3456, 2, "12"),
        (12345.6, 3, "12,346"),
        (8.0, 1, "8"),
        (20.7, 1, "21"),
        (0.000123, 2, "0.00012"),
        (0.5, 3, "0.5"),
        (9.996, 3, "10"),
        (0.0, 3, "0"),
        (-1.204, 3, "-1.2"),
        (math.inf, 2, "inf"),
        (math.nan, 2, "nan"),
    ],
)
def test_significant_figures_without_an_exponent(value: float, figures: int, text: str):
    assert rounded(value, figures) == text


def test_gains_and_losses_have_their_sign():
    assert rounded(1234.5, 3, sign=True) == "+1,234"
    assert rounded(-0.0456, 2, sign=True) == "-0.046"
