"""L1 and SSIM of two images and their gradients on CUDA, in NVIDIA Warp; the equations are those of `ssim_cpu`.

One thread per pixel and channel in four passes: rows and columns of the five moments, then rows and columns of the
derivatives of S by three of them. Maps between passes are stored one after the other, so that neighboring threads read
neighboring addresses. The same source runs on Warp's "cpu" device, one thread after the other, for tests. The gradient
is in closed form: Warp's own adjoint is switched off.
"""

from typing import no_type_check

import warp as wp
from jaxtyping import Float
from torch import Tensor

from swimm3r.raster.cuda.launch import launch
from swimm3r.splat.training import ssim_cpu

moments_type = wp.types.vector(length=5, dtype=float)
_weights_type = wp.types.vector(length=ssim_cpu.WINDOW, dtype=float)
_half = (ssim_cpu.W0, ssim_cpu.W1, ssim_cpu.W2, ssim_cpu.W3, ssim_cpu.W4, ssim_cpu.W5)
WINDOW, HALF = wp.constant(ssim_cpu.WINDOW), wp.constant(ssim_cpu.HALF)
WEIGHTS = wp.constant(_weights_type(*(float(w) for w in (*_half[:0:-1], *_half))))
C1, C2 = wp.constant(float(ssim_cpu.C1)), wp.constant(float(ssim_cpu.C2))


@no_type_check
@wp.func
def moments(a: float, b: float):
    """x, y, x^2, y^2 and xy of a value of either image."""
    return moments_type(a, b, a * a, b * b, a * b)


@no_type_check
@wp.kernel(enable_backward=False)
def moment_rows(render: wp.array3d(dtype=float), target: wp.array3d(dtype=float), rows: wp.array4d(dtype=float)):
    """The five moments, blurred along the rows."""
    c, y, x = wp.tid()
    total = moments_type()
    for k in range(WINDOW):
        at = x + k - HALF
        if at >= 0 and at < render.shape[2]:
            total += WEIGHTS[k] * moments(render[c, y, at], target[c, y, at])
    for m in range(5):
        rows[m, c, y, x] = total[m]


@no_type_check
@wp.kernel(enable_backward=False)
def similarity(
    render: wp.array3d(dtype=float), target: wp.array3d(dtype=float), rows: wp.array4d(dtype=float),
    slopes: wp.array4d(dtype=float), parts: wp.array4d(dtype=float),
):  # fmt: skip
    """|x - y| and S of a pixel, and dS by the mean, by the blurred square and by the blurred product."""
    c, y, x = wp.tid()
    total = moments_type()
    for k in range(WINDOW):
        at = y + k - HALF
        if at >= 0 and at < render.shape[1]:
            total += WEIGHTS[k] * moments_type(
                rows[0, c, at, x], rows[1, c, at, x], rows[2, c, at, x], rows[3, c, at, x], rows[4, c, at, x]
            )
    mx, my = total[0], total[1]
    A1, A2 = 2.0 * mx * my + C1, 2.0 * (total[4] - mx * my) + C2
    B1, B2 = mx * mx + my * my + C1, total[2] - mx * mx + total[3] - my * my + C2
    per = 1.0 / (B1 * B2)
    S = A1 * A2 * per
    slopes[0, c, y, x] = 2.0 * (my * (A2 - A1) * per + S * mx * (1.0 / B2 - 1.0 / B1))
    slopes[1, c, y, x] = -S / B2
    slopes[2, c, y, x] = 2.0 * A1 * per
    parts[0, c, y, x] = wp.abs(render[c, y, x] - target[c, y, x])
    parts[1, c, y, x] = S


@no_type_check
@wp.kernel(enable_backward=False)
def slope_rows(slopes: wp.array4d(dtype=float), rows: wp.array4d(dtype=float)):
    """The three derivatives, blurred along the rows."""
    c, y, x = wp.tid()
    total = wp.vec3()
    for k in range(WINDOW):
        at = x + k - HALF
        if at >= 0 and at < slopes.shape[3]:
            total += WEIGHTS[k] * wp.vec3(slopes[0, c, y, at], slopes[1, c, y, at], slopes[2, c, y, at])
    for m in range(3):
        rows[m, c, y, x] = total[m]


@no_type_check
@wp.kernel(enable_backward=False)
def descent(
    render: wp.array3d(dtype=float), target: wp.array3d(dtype=float), rows: wp.array4d(dtype=float),
    l1_weight: float, ssim_weight: float, gradient: wp.array3d(dtype=float),
):  # fmt: skip
    """The gradient of l1_weight sum |x - y| - ssim_weight sum S by x."""
    c, y, x = wp.tid()
    total = wp.vec3()
    for k in range(WINDOW):
        at = y + k - HALF
        if at >= 0 and at < render.shape[1]:
            total += WEIGHTS[k] * wp.vec3(rows[0, c, at, x], rows[1, c, at, x], rows[2, c, at, x])
    a, b = render[c, y, x], target[c, y, x]
    sign = wp.where(a > b, 1.0, wp.where(a < b, -1.0, 0.0))
    gradient[c, y, x] = l1_weight * sign - ssim_weight * (total[0] + 2.0 * a * total[1] + b * total[2])


def photometric(
    render: Float[Tensor, "3 h w"], target: Float[Tensor, "3 h w"], ssim_weight: float
) -> tuple[Float[Tensor, ""], Float[Tensor, ""], Float[Tensor, "3 h w"]]:
    """Mean absolute difference, mean SSIM, and the gradient of (1 - w) L1 + w (1 - SSIM) by the render.

    All on the device of the images; nothing waits for it.
    """
    a, b = render.detach().contiguous(), target.contiguous()
    rows, slopes, parts = (a.new_empty(count, *a.shape) for count in (5, 3, 2))
    gradient, n = a.new_empty(a.shape), a.numel()
    launch(moment_rows, a.shape, [a, b, rows])
    launch(similarity, a.shape, [a, b, rows, slopes, parts])
    launch(slope_rows, a.shape, [slopes, rows])
    launch(descent, a.shape, [a, b, rows, (1 - ssim_weight) / n, ssim_weight / n, gradient])
    l1, ssim = parts.flatten(1).mean(1).unbind()
    return l1, ssim, gradient
