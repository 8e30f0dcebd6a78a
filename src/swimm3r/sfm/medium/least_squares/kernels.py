"""The sums over points and frames of the water's least squares, compiled by Numba: one pass where NumPy takes ten."""

from typing import no_type_check

import numpy as np
from numba import njit

kernel = njit(cache=True, nogil=True, error_model="numpy")


@kernel
@no_type_check
def surface_colors(T_D, direct, weight, point, count):
    """J of every point by weighted least squares, kept within 0..1."""
    above, below = np.zeros(count), np.zeros(count)
    for k in range(len(point)):
        weighted = weight[k] * T_D[k]
        above[point[k]] += weighted * direct[k]
        below[point[k]] += weighted * T_D[k]
    for n in range(count):
        above[n] = min(max(above[n] / max(below[n], 1e-12), 0.0), 1.0)
    return above


@kernel
@no_type_check
def whitened(residuals, I, weight, frame, count, gain_std):
    """Residuals in units of their noise without the part that a gain common to their frame would explain."""
    square, along = np.zeros(count), np.zeros(count)
    out = np.empty(len(residuals))
    for k in range(len(residuals)):
        out[k] = weight[k] * residuals[k]
        p = weight[k] * (I[k] - residuals[k])
        square[frame[k]] += p * p
        along[frame[k]] += p * out[k]
    for n in range(count):
        total = max(square[n], 1e-12)
        along[n] *= (1 - 1 / np.sqrt(1 + gain_std**2 * total)) / total
    for k in range(len(residuals)):
        out[k] -= weight[k] * (I[k] - residuals[k]) * along[frame[k]]
    return out


@kernel
@no_type_check
def frame_gains(T_D, B, I, weight, point, frame, points, present, stay, sweeps):
    """The gain of every frame by turns with the colors of the points; the mean logarithm of those present is 0."""
    gain = np.ones(len(present))
    direct = np.empty(len(I))
    for _ in range(sweeps):
        for k in range(len(I)):
            direct[k] = I[k] / gain[frame[k]] - B[k]
        J = surface_colors(T_D, direct, weight, point, points)
        above, below = np.full(len(present), stay), np.full(len(present), stay)
        for k in range(len(I)):
            p = J[point[k]] * T_D[k] + B[k]
            above[frame[k]] += weight[k] * I[k] * p
            below[frame[k]] += weight[k] * p * p
        logarithm = count = 0.0
        for n in range(len(present)):
            gain[n] = above[n] / below[n]
            if present[n]:
                logarithm += np.log(gain[n])
                count += 1.0
        gain /= np.exp(logarithm / count)
    return gain
