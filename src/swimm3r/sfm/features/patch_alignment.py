"""Patches of one image found again in another to a fraction of a pixel.

A keypoint is the extremum of a blurred image, and noise, haze and a change of scale each move it by a few tenths of a
pixel. Between images that show the same ground the patches themselves can be laid over each other: an affine map of one
onto the other, with a gain and an offset of the values, by least squares. The map is found by inverse compositional
alignment (Baker and Matthews 2004): gradients are those of the template, so that an iteration samples the image once.
"""

from typing import no_type_check

import numba
import numpy as np
from jaxtyping import Float32, Float64

_RADIUS = 7  # pixels from the middle of a patch to its border
_SIDE = 2 * _RADIUS + 1
PATCH_SIDE = _SIDE + 2
"""Pixels along a patch: one more around, for its gradient."""
_WINDOW = _RADIUS / 2  # standard deviation of the weights
_SMOOTHING = 0.7  # pixels, standard deviation: against the noise of pixels
_ITERATIONS, _STILL = 20, 0.01  # at most, and the step in pixels that ends them
_FARTHEST = 3.0  # pixels: COLMAP takes observations that lie 4 beside their points
_SQUEEZE = 3.0  # change of the area under the map beyond which it is not one of the ground
_DAMPING = 1e-3
_FLAT = 1e-6  # deviation of the values of a patch


def smoothed(gray: Float32[np.ndarray, "h w"]) -> Float32[np.ndarray, "h w"]:
    """An image without the noise of single pixels, as the functions below take images."""
    import cv2

    return cv2.GaussianBlur(gray, (0, 0), _SMOOTHING)


def half_size(image: Float32[np.ndarray, "h w"]) -> Float32[np.ndarray, "half_h half_w"]:
    """A smoothed image at half its size, with which places are halved."""
    import cv2

    h, w = image.shape
    return smoothed(cv2.resize(image[: h // 2 * 2, : w // 2 * 2], (w // 2, h // 2), interpolation=cv2.INTER_AREA))


def cut_patches(
    image: Float32[np.ndarray, "h w"], places: Float64[np.ndarray, "k 2"]
) -> Float32[np.ndarray, "k side side"]:
    """The patches around pixels (column, row; the center of the first is 0.5, 0.5); NaN where one leaves the image."""
    patches = np.full((len(places), PATCH_SIDE, PATCH_SIDE), np.nan, np.float32)
    _cut(image, places, patches)
    return patches


def align_patches(
    image: Float32[np.ndarray, "h w"],
    patches: Float32[np.ndarray, "k side side"],
    places: Float64[np.ndarray, "k 2"],
    maps: Float64[np.ndarray, "k 2 2"],
) -> tuple[Float64[np.ndarray, "k 2"], Float64[np.ndarray, " k"]]:
    """Pixels of an image that show the middles of patches, and the weighted correlation of both (-1 to 1).

    `places` are where the middles are expected, and `maps` take steps in the image of the patches to steps here. The
    pixel is the expected one and the correlation NaN where a patch has no texture or leaves either image, or no map
    near the expected one fits.
    """
    found, alike = places.copy(), np.full(len(places), np.nan)
    _align(image, patches, maps, _weights(), found, alike)
    return found, alike


def _weights() -> Float64[np.ndarray, " n"]:
    steps = np.arange(-_RADIUS, _RADIUS + 1)
    weights = np.exp(-(steps[:, None] ** 2 + steps[None] ** 2) / (2 * _WINDOW**2)).ravel()
    return weights / weights.sum()


@numba.njit(cache=True, nogil=True)
@no_type_check  # the tests' shape checks would wrap what Numba must compile
def _value(image, x, y):
    """The image at a place, by linear interpolation; NaN outside. Here the center of the first pixel is (0, 0)."""
    h, w = image.shape
    if not (0 <= x <= w - 1 and 0 <= y <= h - 1):
        return np.nan
    i, j = min(int(y), h - 2), min(int(x), w - 2)
    b, a = y - i, x - j
    above = (1 - a) * image[i, j] + a * image[i, j + 1]
    below = (1 - a) * image[i + 1, j] + a * image[i + 1, j + 1]
    return (1 - b) * above + b * below


@numba.njit(cache=True, nogil=True)
@no_type_check
def _cut(image, places, patches):
    for k in range(len(places)):
        for v in range(PATCH_SIDE):
            for u in range(PATCH_SIDE):
                x, y = places[k, 0] - 0.5 + u - _RADIUS - 1, places[k, 1] - 0.5 + v - _RADIUS - 1
                patches[k, v, u] = _value(image, x, y)


@numba.njit(cache=True, nogil=True)
@no_type_check
def _standardized(values, weights):
    """Values with weighted mean 0 and variance 1 in place; returns the deviation they had, 0 for flat ones."""
    mean = 0.0
    for i in range(len(values)):
        mean += weights[i] * values[i]
    square = 0.0
    for i in range(len(values)):
        values[i] -= mean
        square += weights[i] * values[i] * values[i]
    deviation = np.sqrt(square)
    if deviation > 0:
        values /= deviation
    return deviation


@numba.njit(cache=True, nogil=True)
@no_type_check
def _template(patch, weights, values, slopes):
    """Standardized values of a patch and what the parameters of the map change of them; False for flat or cut ones."""
    if np.isnan(patch).any():
        return False
    i = 0
    for v in range(_SIDE):
        for u in range(_SIDE):
            values[i] = patch[v + 1, u + 1]
            across = 0.5 * (patch[v + 1, u + 2] - patch[v + 1, u])
            down = 0.5 * (patch[v + 2, u + 1] - patch[v, u + 1])
            x, y = u - _RADIUS, v - _RADIUS
            slopes[0, i], slopes[1, i] = across, down
            slopes[2, i], slopes[3, i], slopes[4, i], slopes[5, i] = across * x, across * y, down * x, down * y
            i += 1
    deviation = _standardized(values, weights)
    if not deviation > _FLAT:
        return False
    for p in range(6):  # gain and offset take up a part of each
        mean, along = 0.0, 0.0
        for i in range(len(values)):
            mean += weights[i] * slopes[p, i]
            along += weights[i] * slopes[p, i] * values[i]
        for i in range(len(values)):
            slopes[p, i] = (slopes[p, i] - mean - along * values[i]) / deviation
    return True


@numba.njit(cache=True, nogil=True)
@no_type_check
def _inverse_of_normal(slopes, weights):
    """The inverse of the slightly damped normal matrix of the parameters."""
    normal = np.empty((6, 6))
    for p in range(6):
        for q in range(p + 1):
            total = 0.0
            for i in range(len(weights)):
                total += weights[i] * slopes[p, i] * slopes[q, i]
            normal[p, q] = normal[q, p] = total
    for p in range(6):
        normal[p, p] = (1 + _DAMPING) * normal[p, p] + 1e-9
    return np.linalg.inv(normal)


@numba.njit(cache=True, nogil=True)
@no_type_check
def _pull(values, seen, slopes, weights):
    """Correlation of template and image, and the gradient of half their squared difference."""
    alike, pull = 0.0, np.zeros(6)
    for i in range(len(values)):
        alike += weights[i] * seen[i] * values[i]
        for p in range(6):
            pull[p] += weights[i] * slopes[p, i] * (seen[i] - values[i])
    return alike, pull


@numba.njit(cache=True, nogil=True)
@no_type_check
def _look(image, x, y, M, weights, seen):
    """Standardized values of the image under a map; False where it is flat there or ends."""
    i = 0
    for v in range(-_RADIUS, _RADIUS + 1):
        for u in range(-_RADIUS, _RADIUS + 1):
            seen[i] = _value(image, x + M[0, 0] * u + M[0, 1] * v, y + M[1, 0] * u + M[1, 1] * v)
            i += 1
    return _standardized(seen, weights) > _FLAT


@numba.njit(cache=True, nogil=True)
@no_type_check
def _followed(image, x, y, M, values, slopes, weights, seen):
    """Place, correlation and whether the map that begins with `M`, which is changed, came to rest."""
    inverse, start_x, start_y, alike = _inverse_of_normal(slopes, weights), x, y, np.nan
    for _ in range(_ITERATIONS):
        if not _look(image, x, y, M, weights, seen):
            return x, y, alike, False
        alike, pull = _pull(values, seen, slopes, weights)
        s, t, aa, ab, ba, bb = inverse @ pull
        # the map after the inverse of the step (u, v) -> (s, t) + [[1 + aa, ab], [ba, 1 + bb]] (u, v)
        size = (1 + aa) * (1 + bb) - ab * ba
        if not size > 1 / _SQUEEZE:
            return x, y, alike, False
        for row in range(2):
            first, second = M[row, 0], M[row, 1]
            M[row, 0], M[row, 1] = (first * (1 + bb) - second * ba) / size, (second * (1 + aa) - first * ab) / size
        across, down = M[0, 0] * s + M[0, 1] * t, M[1, 0] * s + M[1, 1] * t
        x, y = x - across, y - down
        if not np.hypot(x - start_x, y - start_y) < _FARTHEST:
            return x, y, alike, False
        if np.hypot(across, down) < _STILL:
            return x, y, alike, True
    return x, y, alike, False


@numba.njit(cache=True, nogil=True)
@no_type_check
def _align(image, patches, maps, weights, found, alike):
    values, seen, slopes = np.empty(len(weights)), np.empty(len(weights)), np.empty((6, len(weights)))
    for k in range(len(patches)):
        if not _template(patches[k], weights, values, slopes):
            continue
        M = maps[k].copy()
        area = M[0, 0] * M[1, 1] - M[0, 1] * M[1, 0]
        x, y, like, still = _followed(image, found[k, 0] - 0.5, found[k, 1] - 0.5, M, values, slopes, weights, seen)
        change = (M[0, 0] * M[1, 1] - M[0, 1] * M[1, 0]) / area
        if still and 1 / _SQUEEZE < change < _SQUEEZE:
            found[k, 0], found[k, 1], alike[k] = x + 0.5, y + 0.5, like
