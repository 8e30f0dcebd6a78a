"""Numbers in words for people: rounded to significant figures, never with an exponent."""

import math


def rounded(value: float, figures: int, *, sign: bool = False) -> str:
    """The value rounded to so many significant figures, without zeros at the end of its decimals.

    Thousands are set apart by commas; figures before the point are kept when they are more. `sign` writes + before
    positive values.
    """
    if not math.isfinite(value):
        return f"{value:g}"
    exponent = math.floor(math.log10(abs(float(f"{value:.{figures - 1}e}")))) if value else 0
    decimals = max(0, figures - 1 - exponent)
    text = f"{value:{'+' if sign else ''},.{decimals}f}"
    return text.rstrip("0").rstrip(".") if decimals else text
