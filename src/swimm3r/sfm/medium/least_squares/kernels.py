"""Sums over points, frames and rays in the water's fit, compiled by Numba: one pass where arrays take ten."""

from typing import no_type_check

import numpy as np
from numba import njit

kernel = njit(cache=True, nogil=True, error_model="numpy")


@kernel
@no_type_check
def surface_colors(T_D, direct, weight, point, count, most=1.0):
    """J of every point by weighted least squares, kept within 0..most."""
    above, below = np.zeros(count), np.zeros(count)
    for k in range(len(point)):
        weighted = weight[k] * T_D[k]
        above[point[k]] += weighted * direct[k]
        below[point[k]] += weighted * T_D[k]
    for n in range(count):
        above[n] = min(max(above[n] / max(below[n], 1e-12), 0.0), most)
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
def frame_gains(T_D, B, I, weight, point, frame, points, present, stay, sweeps, most=1.0):
    """The gain of every frame by turns with the colors of the points; the mean logarithm of those present is 0."""
    gain = np.ones(len(present))
    direct = np.empty(len(I))
    for _ in range(sweeps):
        for k in range(len(I)):
            direct[k] = I[k] / gain[frame[k]] - B[k]
        J = surface_colors(T_D, direct, weight, point, points, most)
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


@kernel
@no_type_check
def scattered(direction, z, share, step, position, reference, fall_off, beam, beta):
    """G of `swimm3r.lamp` along unit directions up to z, [n, c], of a lamp of strength 1."""
    origin = np.sqrt(position[0] ** 2 + position[1] ** 2 + (reference - position[2]) ** 2)
    out = np.zeros((len(z), len(beta)))
    for k in range(len(z)):
        for m in range(len(share)):
            s = share[m] * z[k]
            x, y = s * direction[k, 0] - position[0], s * direction[k, 1] - position[1]
            ahead = s * direction[k, 2] - position[2]
            distance = max(np.sqrt(x * x + y * y + ahead * ahead), 1e-6 * reference)
            x, y, ahead = x / distance, y / distance, ahead / distance
            pattern = beam[0] * x + beam[1] * y + beam[2] * (1 - ahead)
            pattern += beam[3] * x * x + beam[4] * x * y + beam[5] * y * y
            log_light = pattern + fall_off * np.log(origin / distance)
            for c in range(len(beta)):
                out[k, c] += step[m] * z[k] * np.exp(log_light - beta[c] * (distance + s))
    return out
