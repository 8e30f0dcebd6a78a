"""Gradient noise and hashes: everything on the seafloor that looks random is a fixed function of place and seed.

Perlin's construction: at each corner of the unit lattice a hashed direction g, the noise is the smooth (quintic)
interpolation of g . (x - corner). Values lie in about -1..1 and are 0 on the lattice.
"""

from typing import no_type_check

import numba
import numpy as np


@numba.njit(cache=True, inline="always")
@no_type_check
def hashed(i: int, j: int, k: int, seed: int) -> int:
    """A well mixed 32-bit integer of a lattice place."""
    h = (i * 0x9E3779B1 ^ j * 0x85EBCA77 ^ k * 0xC2B2AE3D ^ seed * 0x27D4EB2F) & 0xFFFFFFFF
    h = ((h ^ (h >> 15)) * 0x2C1B3C6D) & 0xFFFFFFFF
    h = ((h ^ (h >> 12)) * 0x297A2D39) & 0xFFFFFFFF
    return h ^ (h >> 15)


@numba.njit(cache=True, inline="always")
@no_type_check
def share(h: int, which: int) -> float:
    """One of four independent numbers in 0..1 from a hash."""
    return ((h >> (8 * which)) & 0xFF) / 255.0


@numba.njit(cache=True, inline="always")
@no_type_check
def _corner(h: int, x: float, y: float, z: float) -> float:
    h &= 15  # the 12 edges of a cube, 4 of them twice
    u = x if h < 8 else y
    v = y if h < 4 else (x if h == 12 or h == 14 else z)
    return (u if h & 1 == 0 else -u) + (v if h & 2 == 0 else -v)


@numba.njit(cache=True)
@no_type_check
def noise(x: float, y: float, z: float, seed: int) -> float:
    """Gradient noise at a place, -1..1."""
    fx, fy, fz = np.floor(x), np.floor(y), np.floor(z)
    i, j, k = int(fx), int(fy), int(fz)
    x -= fx
    y -= fy
    z -= fz
    u = x * x * x * (x * (x * 6 - 15) + 10)
    v = y * y * y * (y * (y * 6 - 15) + 10)
    w = z * z * z * (z * (z * 6 - 15) + 10)
    low = 0.0
    high = 0.0
    for dz in range(2):
        a = _corner(hashed(i, j, k + dz, seed), x, y, z - dz)
        b = _corner(hashed(i + 1, j, k + dz, seed), x - 1, y, z - dz)
        c = _corner(hashed(i, j + 1, k + dz, seed), x, y - 1, z - dz)
        d = _corner(hashed(i + 1, j + 1, k + dz, seed), x - 1, y - 1, z - dz)
        ab, cd = a + u * (b - a), c + u * (d - c)
        if dz == 0:
            low = ab + v * (cd - ab)
            if z == 0:  # a plane of the lattice: half the work for textures in two dimensions
                return low
        else:
            high = ab + v * (cd - ab)
    return low + w * (high - low)


@numba.njit(cache=True)
@no_type_check
def fractal(
    x: float, y: float, z: float, wavelength: float, octaves: int, gain: float, footprint: float, seed: int
) -> float:
    """Octaves of noise from `wavelength` downwards, each `gain` times the one before.

    Octaves finer than `footprint`, the size of a pixel at the place, fade out: what a lens would have averaged.
    """
    total = 0.0
    amplitude = 1.0
    for octave in range(octaves):
        visible = min(wavelength / max(footprint, 1e-9) / 2.0 - 0.75, 1.0)
        if visible <= 0:
            break
        frequency = 1.0 / wavelength
        total += visible * amplitude * noise(x * frequency, y * frequency, z * frequency, seed + 101 * octave)
        amplitude *= gain
        wavelength *= 0.5
    return total
