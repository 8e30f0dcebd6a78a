"""The synthetic seafloor from straight above, without water: the truth about maps of it."""

from typing import no_type_check

import numba
import numpy as np
import torch
from jaxtyping import Float

from swimm3r.medium import srgb_from_linear
from swimm3r.synthetic.appearance import radiance
from swimm3r.synthetic.dive import Dive
from swimm3r.synthetic.printed_markers import plates_from_above
from swimm3r.synthetic.raycast import bilinear
from swimm3r.synthetic.render_frame import SAMPLES

_PATCH = 0.5  # m; cells of a square this wide are taken from one patch of the floor


def top_view(
    dive: Dive, x: Float[np.ndarray, " columns"], y: Float[np.ndarray, " rows"]
) -> tuple[Float[np.ndarray, "rows columns 3"], Float[np.ndarray, "rows columns"]]:
    """Clear colors 0..1 (sRGB) and heights in metres of square cells with these middles, evenly spaced."""
    cell = float(abs(x[1] - x[0]))
    color, height = np.zeros((len(y), len(x), 3)), np.zeros((len(y), len(x)))
    for rows in _groups(y):
        for columns in _groups(x):
            floor = dive.floor.around(float(x[columns].mean()), float(y[rows].mean()))
            s = floor.surface
            colors, heights = _from_above(
                s.height, s.cell, np.array([s.x0, s.y0, 0.0]), floor.shade, floor.animals, floor.owner, x[columns],
                y[rows], cell, floor.seed * 1000 + 17,
            )  # fmt: skip
            color[np.ix_(rows, columns)], height[np.ix_(rows, columns)] = colors, heights
    color, height = plates_from_above(color, height, x, y, dive.plates)
    return srgb_from_linear(torch.from_numpy(color)).clamp(0, 1).numpy(), height


def _groups(values: Float[np.ndarray, " n"]) -> list[np.ndarray]:
    """Indices of the values, by the patches they fall into."""
    patch = np.floor(values / _PATCH)
    return [np.nonzero(patch == number)[0] for number in np.unique(patch)]


@numba.njit(cache=True)
@no_type_check
def _from_above(height, cell, corner, shade, animals, owner, x, y, size, seed):
    color = np.zeros((len(y), len(x), 3))
    middle = np.zeros((len(y), len(x)))
    p = np.empty(3)
    for row in range(len(y)):
        for column in range(len(x)):
            middle[row, column] = bilinear(height, (x[column] - corner[0]) / cell, (y[row] - corner[1]) / cell)
            for sample in range(SAMPLES * SAMPLES):
                p[0] = x[column] + ((sample % SAMPLES + 0.5) / SAMPLES - 0.5) * size
                p[1] = y[row] + ((sample // SAMPLES + 0.5) / SAMPLES - 0.5) * size
                p[2] = bilinear(height, (p[0] - corner[0]) / cell, (p[1] - corner[1]) / cell)
                radiance(shade, animals, owner, corner, cell, p, size, 0.0, 0.0, seed, color[row, column])
            for channel in range(3):
                color[row, column, channel] /= SAMPLES * SAMPLES
    return color, middle
