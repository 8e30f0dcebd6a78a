"""Small matrices, one per primitive, computed LANES primitives at a time in one workspace that stays in cache.

The workspace `g` is [matrices, 4, 4, LANES]; a matrix is named by its number. The loops over rows and columns are short
and scalar, the innermost one runs over the lanes and becomes SIMD. It asks the workspace for their number: a loop of
known length would be unrolled whole, and take minutes to compile. Products come in lists (`products`), each of which is
one loop to the compiler: it takes a third of a second for each copy of the arithmetic.
"""

from typing import no_type_check

import numpy as np
from jaxtyping import Int

from swimm3r.raster.cpu.math import exp2, inlined

LANES = 128
SET, ADD = 0, 1
SIZE_1, SIZE_2, SIZE_3, SIZE_C = range(4)  # rows or columns of a matrix: one, two, three, as many as a query has
ZERO, HALF, ONE, TWO = np.float32(0.0), np.float32(0.5), np.float32(1.0), np.float32(2.0)
LOG2_E = np.float32(1.4426950408889634)
# odd powers of the series of artanh: log1p(e) = 2 artanh(e / (2 + e)), which keeps the digits of a small e
A3, A5, A7, A9, A11 = (np.float32(1 / k) for k in (3, 5, 7, 9, 11))


@no_type_check
@inlined
def log1p(e):
    """ln(1 + e) for 0 <= e <= 1, relative error 2e-7."""
    t = e / (TWO + e)
    t2 = t * t
    return TWO * t * (ONE + t2 * (A3 + t2 * (A5 + t2 * (A7 + t2 * (A9 + t2 * A11)))))


@no_type_check
@inlined
def exp(x):
    """e^x for x < 88; 0 below -55."""
    return exp2(x * LOG2_E)


@no_type_check
@inlined
def zero(g, out, rows, columns):
    """out = 0."""
    for i in range(rows):
        for j in range(columns):
            o = g[out, i, j]
            for q in range(g.shape[3]):
                o[q] = ZERO


Product = tuple[np.integer | int, ...]
_PLAIN, _A_TURNED, _B_TURNED = range(3)


def products(*listed: Product) -> Int[np.ndarray, "n 9"]:
    """Products to be run one after another (`run`)."""
    return np.array([[int(value) for value in each] for each in listed])


def product(out, a, b, rows, inner, columns, add=SET, halves=2) -> Product:
    """out = f a b, or out += with `add`, for a [rows, inner] and b [inner, columns]; f is so many halves."""
    return out, a, b, rows, inner, columns, _PLAIN, add, halves


def product_at(out, a, b, rows, inner, columns, add=SET, halves=2) -> Product:
    """out = f a^T b, or out += with `add`, for a [inner, rows] and b [inner, columns]."""
    return out, a, b, rows, inner, columns, _A_TURNED, add, halves


def product_bt(out, a, b, rows, inner, columns, add=SET, halves=2) -> Product:
    """out = f a b^T, or out += with `add`, for a [rows, inner] and b [columns, inner]."""
    return out, a, b, rows, inner, columns, _B_TURNED, add, halves


@no_type_check
@inlined
def run(g, listed, two, three, c):
    """Products of the workspace's matrices, for sizes that are known when it runs."""
    sizes = (1, two, three, c)
    for p in range(listed.shape[0]):
        out, a, b = listed[p, 0], listed[p, 1], listed[p, 2]
        turned, factor = listed[p, 6], HALF * np.float32(listed[p, 8])
        for i in range(sizes[listed[p, 3]]):
            for j in range(sizes[listed[p, 5]]):
                o = g[out, i, j]
                if listed[p, 7] == SET:
                    for q in range(g.shape[3]):
                        o[q] = ZERO
                for k in range(sizes[listed[p, 4]]):
                    u = g[a, k, i] if turned == _A_TURNED else g[a, i, k]
                    v = g[b, j, k] if turned == _B_TURNED else g[b, k, j]
                    for q in range(g.shape[3]):
                        o[q] += (factor * u[q]) * v[q]


@no_type_check
@inlined
def cholesky(g, factor, a, n):
    """Lower factor with factor factor^T = a, for positive definite a; the upper part of `factor` is not touched."""
    for j in range(n):
        d, pivot = g[factor, j, j], g[a, j, j]
        for q in range(g.shape[3]):
            d[q] = pivot[q]
        for k in range(j):
            f = g[factor, j, k]
            for q in range(g.shape[3]):
                d[q] -= f[q] * f[q]
        for q in range(g.shape[3]):
            d[q] = np.sqrt(d[q])
        for i in range(j + 1, n):
            o, below = g[factor, i, j], g[a, i, j]
            for q in range(g.shape[3]):
                o[q] = below[q]
            for k in range(j):
                u, v = g[factor, i, k], g[factor, j, k]
                for q in range(g.shape[3]):
                    o[q] -= u[q] * v[q]
            for q in range(g.shape[3]):
                o[q] /= d[q]


@no_type_check
@inlined
def inverse_of_lower(g, out, factor, n):
    """out = factor^-1, both lower; the upper part of `out` is not touched."""
    for j in range(n):
        for i in range(j, n):
            o, d = g[out, i, j], g[factor, i, i]
            one = ONE if i == j else ZERO
            for q in range(g.shape[3]):
                o[q] = one
            for k in range(j, i):
                u, v = g[factor, i, k], g[out, k, j]
                for q in range(g.shape[3]):
                    o[q] -= u[q] * v[q]
            for q in range(g.shape[3]):
                o[q] /= d[q]
