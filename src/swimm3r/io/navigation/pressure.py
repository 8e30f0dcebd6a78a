"""Depth of sea water from pressure (Fofonoff & Millard 1983, UNESCO 44): a column of 0 degrees C, salinity 35."""

import numpy as np
from jaxtyping import Float

_ATMOSPHERE = 1.01325  # bar


def depth_of_pressure(
    bar: Float[np.ndarray, " n"], latitude: float = 45.0, *, absolute: bool = False
) -> Float[np.ndarray, " n"]:
    """Metres of water over a sensor; `absolute` pressures hold the air's. 10,000 dbar at 30 degrees are 9712.653 m."""
    p = 10.0 * (bar - _ATMOSPHERE if absolute else bar)  # dbar
    x = np.sin(np.radians(latitude)) ** 2
    gravity = 9.780318 * (1.0 + (5.2788e-3 + 2.36e-5 * x) * x) + 1.092e-6 * p
    return (((-1.82e-15 * p + 2.279e-10) * p - 2.2512e-5) * p + 9.72659) * p / gravity
