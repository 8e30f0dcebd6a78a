"""L1 and SSIM of two images and their gradients in one pass on the CPU.

    S = (2 mx my + C1)(2 sxy + C2) / ((mx^2 + my^2 + C1)(sx^2 + sy^2 + C2))

with Gaussian-weighted moments; the blur with zero padding is its own adjoint, so the gradient is three more blurs.
"""

from typing import no_type_check

import numpy as np
import torch
from jaxtyping import Float
from numba import njit
from torch import Tensor

from swimm3r.raster.cpu import math
from swimm3r.raster.cpu.threads import spread

WINDOW, SIGMA = 11, 1.5
C1, C2 = np.float32(0.01**2), np.float32(0.03**2)
HALF = WINDOW // 2
_offsets = np.arange(WINDOW) - HALF
_weights = np.exp(-0.5 * (_offsets / SIGMA) ** 2)
W0, W1, W2, W3, W4, W5 = (np.float32(w) for w in (_weights / _weights.sum())[HALF:])  # symmetric: the middle first
ZERO, ONE, TWO = np.float32(0.0), np.float32(1.0), np.float32(2.0)

kernel = njit(nogil=True, cache=True, error_model="numpy", fastmath=math.FLAGS | {"reassoc"})  # for sums along rows


@no_type_check
@kernel
def blur(image, out, rows):
    """The Gaussian window with zero padding. `rows` is scratch of the image's size."""
    height, width = image.shape
    padded = np.zeros(width + 2 * HALF, np.float32)
    for y in range(height):
        padded[HALF : HALF + width] = image[y]
        p0, p1, p2, p3, p4, p5 = padded, padded[1:], padded[2:], padded[3:], padded[4:], padded[5:]
        p6, p7, p8, p9, p10 = padded[6:], padded[7:], padded[8:], padded[9:], padded[10:]
        row = rows[y]
        for x in range(width):
            row[x] = (
                W0 * p5[x] + W1 * (p4[x] + p6[x]) + W2 * (p3[x] + p7[x])
                + W3 * (p2[x] + p8[x]) + W4 * (p1[x] + p9[x]) + W5 * (p0[x] + p10[x])
            )  # fmt: skip
    nothing = np.zeros(width, np.float32)
    for y in range(height):
        o, r = out[y], rows[y]
        for x in range(width):
            o[x] = W0 * r[x]
        for k in range(1, HALF + 1):
            w = W1 if k == 1 else W2 if k == 2 else W3 if k == 3 else W4 if k == 4 else W5
            above = rows[y - k] if y >= k else nothing
            below = rows[y + k] if y + k < height else nothing
            for x in range(width):
                o[x] += w * (above[x] + below[x])


@no_type_check
@kernel
def photometric_channel(render, target, l1_weight, ssim_weight, gradient):
    """Sums over one channel of |render - target| and of SSIM; `gradient` of l1_weight first - ssim_weight second."""
    height, width = render.shape
    work = np.empty((6, height, width), np.float32)
    mean_x, mean_y, xx, yy, xy, rows = work[0], work[1], work[2], work[3], work[4], work[5]
    blur(render, mean_x, rows)
    blur(target, mean_y, rows)
    for y in range(height):
        a, b, g = render[y], target[y], gradient[y]
        for x in range(width):
            g[x] = a[x] * a[x]
    blur(gradient, xx, rows)
    for y in range(height):
        b, g = target[y], gradient[y]
        for x in range(width):
            g[x] = b[x] * b[x]
    blur(gradient, yy, rows)
    for y in range(height):
        a, b, g = render[y], target[y], gradient[y]
        for x in range(width):
            g[x] = a[x] * b[x]
    blur(gradient, xy, rows)
    similarity = 0.0
    for y in range(height):
        mx_row, my_row, xx_row, yy_row, xy_row = mean_x[y], mean_y[y], xx[y], yy[y], xy[y]
        along = ZERO
        for x in range(width):
            mx, my = mx_row[x], my_row[x]
            A1, A2 = TWO * mx * my + C1, TWO * (xy_row[x] - mx * my) + C2
            B1, B2 = mx * mx + my * my + C1, xx_row[x] - mx * mx + yy_row[x] - my * my + C2
            per = ONE / (B1 * B2)
            S = A1 * A2 * per
            along += S
            # dS by the mean, by the blurred square and by the blurred product
            mx_row[x] = TWO * (my * (A2 - A1) * per + S * mx * (ONE / B2 - ONE / B1))
            xx_row[x] = -S / B2
            xy_row[x] = TWO * A1 * per
        similarity += along
    blur(mean_x, mean_y, rows)
    blur(xx, yy, rows)
    blur(xy, mean_x, rows)
    difference = 0.0
    for y in range(height):
        a, b, g, by_mean, by_square, by_product = render[y], target[y], gradient[y], mean_y[y], yy[y], mean_x[y]
        along = ZERO
        for x in range(width):
            d = a[x] - b[x]
            along += abs(d)
            sign = ONE if d > ZERO else (-ONE if d < ZERO else ZERO)
            g[x] = l1_weight * sign - ssim_weight * (by_mean[x] + TWO * a[x] * by_square[x] + b[x] * by_product[x])
        difference += along
    return difference, similarity


def photometric(
    render: Float[Tensor, "3 h w"], target: Float[Tensor, "3 h w"], ssim_weight: float
) -> tuple[float, float, Float[Tensor, "3 h w"]]:
    """Mean absolute difference, mean SSIM, and the gradient of (1 - w) L1 + w (1 - SSIM) by the render."""
    a, b = render.detach().contiguous().numpy(), target.contiguous().numpy()
    gradient = np.empty_like(a)
    n = a.size
    sums = np.zeros((3, 2))
    l1_weight, ssim_share = np.float32((1 - ssim_weight) / n), np.float32(ssim_weight / n)

    def work(first: int, beyond: int) -> None:
        for channel in range(first, beyond):
            sums[channel] = photometric_channel(a[channel], b[channel], l1_weight, ssim_share, gradient[channel])

    spread(work, 3)
    l1, ssim = (sums.sum(0) / n).tolist()
    return l1, ssim, torch.from_numpy(gradient)
