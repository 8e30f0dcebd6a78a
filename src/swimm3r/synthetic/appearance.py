"""Appearance of the seafloor in clear water: albedo, light, caustics, in linear light.

    radiance = albedo * (sky_share * SKY + sun_share * max(0, n . sun) * SUNLIGHT * caustics)

Textures are functions of the place in space, so they do not stretch on steep rock; detail finer than a pixel fades out
before it can alias.
"""

from typing import no_type_check

import numba
import numpy as np

from swimm3r.synthetic.noise import fractal, hashed, noise, share
from swimm3r.synthetic.raycast import bilinear
from swimm3r.synthetic.seafloor import SPONGE, STAR, SUN, outline
from swimm3r.synthetic.season import CORAL

_SKY = 0.55
_SUNLIGHT = 1.05


@numba.njit(cache=True)
@no_type_check
def caustic(x: float, y: float, time: float, strength: float) -> float:
    """The sun's share under a rippled surface, 1 on average: bright threads that move and change."""
    drift = 0.25 * time
    a = noise(x / 0.55 + 0.4 * drift, y / 0.55, time * 0.8, 901)
    b = noise(x / 0.38 - 0.3 * drift, y / 0.38 + 0.2 * drift, time * 1.1, 902)
    thread = (1 - min(1.0, abs(a + 0.6 * b) * 2.2)) ** 2
    return 1 + strength * (2.6 * thread - 0.85)


@numba.njit(cache=True)
@no_type_check
def _pebble(x: float, y: float, spacing: float, chance: float, footprint: float, seed: int) -> tuple[float, float]:
    """Cover (0..1) and tone of the pebble of one scale at a place; every cell of a turned grid holds at most one."""
    if footprint > 0.35 * spacing:
        return 0.0, 0.0
    turn = 0.7 + 1.3 * (seed % 7)
    gx = (np.cos(turn) * x + np.sin(turn) * y) / spacing
    gy = (np.cos(turn) * y - np.sin(turn) * x) / spacing
    i, j = int(np.floor(gx)), int(np.floor(gy))
    h = hashed(i, j, 0, seed)
    if share(h, 0) > chance:
        return 0.0, 0.0
    h2 = hashed(i, j, 1, seed)
    radius = 0.16 + 0.2 * share(h, 1)
    u = gx - i - (radius + (1 - 2 * radius) * share(h, 2))
    v = gy - j - (radius + (1 - 2 * radius) * share(h, 3))
    angle = np.pi * share(h2, 0)
    long = np.cos(angle) * u + np.sin(angle) * v
    across = (np.cos(angle) * v - np.sin(angle) * u) * (1 + 0.7 * share(h2, 1))
    r = np.sqrt(long * long + across * across) / radius
    soft = max(footprint / (spacing * radius), 0.06)
    cover = min(max((1 - r) / soft + 0.5, 0.0), 1.0) * min(1.0, (0.35 - footprint / spacing) * 8)
    light = 1.0 - 0.45 * r * r + 0.35 * (SUN[0] * u + SUN[1] * v) / radius
    return cover, light * (0.12 + 0.9 * share(h2, 2) ** 1.5)


@numba.njit(cache=True)
@no_type_check
def _speck(
    x: float, y: float, z: float, spacing: float, chance: float, footprint: float, seed: int
) -> tuple[float, float]:
    """Cover and tone of what grows in spots on rock; every cell of a lattice in space holds at most one ball."""
    if footprint > 0.4 * spacing:
        return 0.0, 0.0
    gx, gy, gz = (0.8 * x + 0.6 * z) / spacing, (y + 0.3 * x) / spacing, (0.8 * z - 0.6 * x) / spacing
    i, j, k = int(np.floor(gx)), int(np.floor(gy)), int(np.floor(gz))
    h = hashed(i, j, k, seed)
    if share(h, 0) > chance:
        return 0.0, 0.0
    h2 = hashed(i, j, k, seed + 1)
    radius = 0.2 + 0.25 * share(h2, 0)
    u = gx - i - (radius + (1 - 2 * radius) * share(h, 1))
    v = gy - j - (radius + (1 - 2 * radius) * share(h, 2))
    w = gz - k - (radius + (1 - 2 * radius) * share(h, 3))
    r = np.sqrt(u * u + v * v + w * w) / radius
    if r > 1.6:
        return 0.0, 0.0
    r *= 1 + 0.45 * noise(2.3 * gx, 2.3 * gy, 2.3 * gz, seed + 2)
    soft = max(footprint / (spacing * radius), 0.12)
    fade = min(1.0, (0.4 - footprint / spacing) * 6)
    return min(max((1 - r) / soft + 0.5, 0.0), 1.0) * fade, share(h2, 1)


@numba.njit(cache=True)
@no_type_check
def _sand(x: float, y: float, z: float, footprint: float, seed: int) -> tuple[float, float, float]:
    """Albedo of sand: broad stains, grains, pebbles and shell at four sizes."""
    stain = fractal(x, y, z, 1.3, 4, 0.7, footprint, seed + 1)
    grain = fractal(x, y, z, 0.14, 7, 0.95, footprint, seed + 2)
    tone = np.exp(0.36 * stain + 0.40 * grain)
    r, g, b = 0.40 * tone, 0.345 * tone, 0.25 * tone
    gather = min(max(0.55 + 0.9 * stain, 0.12), 1.0)
    for scale in range(4):
        cover, pebble = _pebble(
            x,
            y,
            (0.17, 0.075, 0.036, 0.018)[scale],
            gather * (0.4, 0.6, 0.75, 0.8)[scale],
            footprint,
            seed + 40 + scale,
        )
        if cover > 0:
            pebble *= np.exp(0.35 * grain)
            r += cover * (0.74 * pebble - r)
            g += cover * (0.70 * pebble - g)
            b += cover * (0.64 * pebble - b)
    return r, g, b


@numba.njit(cache=True)
@no_type_check
def _rock(x: float, y: float, z: float, steep: float, footprint: float, seed: int) -> tuple[float, float, float]:
    """Albedo of rock: grain and pits, mauve crust, turf on what faces up, spots of barnacles and of holes."""
    grain = fractal(x, y, z, 0.28, 7, 0.92, footprint, seed + 3)
    broad = fractal(x, y, z, 0.75, 4, 0.65, footprint, seed + 4)
    tone = np.exp(0.62 * grain + 0.25 * broad)
    tone *= 1 - 0.75 * min(max((-grain - 0.42) / 0.3, 0.0), 1.0)  # pits
    r, g, b = 0.27 * tone, 0.235 * tone, 0.185 * tone
    crust = min(max((broad + 0.45 * grain - 0.36) / 0.16, 0.0), 1.0)
    r += 0.8 * crust * (0.36 * tone - r)
    g += 0.8 * crust * (0.17 * tone - g)
    b += 0.8 * crust * (0.21 * tone - b)
    turf = fractal(x + 7, y, z, 0.6, 6, 0.75, footprint, seed + 6)
    turf = min(max((turf - 0.10) / 0.18, 0.0), 1.0) * min(max((2.1 - steep) * 1.5, 0.0), 1.0)
    if turf > 0:
        blade = np.exp(0.8 * fractal(x, y, 0.3 * z, 0.06, 5, 0.9, footprint, seed + 7))
        olive = 0.5 + 0.5 * broad
        r += turf * ((0.10 + 0.05 * olive) * blade - r)
        g += turf * (0.135 * blade - g)
        b += turf * (0.04 * blade - b)
    for scale in range(3):
        cover, kind = _speck(
            x, y, z, (0.11, 0.045, 0.024)[scale], (0.22, 0.30, 0.36)[scale], footprint, seed + 50 + 3 * scale
        )
        if cover == 0:
            continue
        if kind < 0.30 and scale > 0:  # holes
            r, g, b = r * (1 - 0.98 * cover), g * (1 - 0.98 * cover), b * (1 - 0.98 * cover)
        elif kind < 0.8 and scale > 0:  # barnacles, tube worms
            r += cover * (0.62 * tone**0.3 - r)
            g += cover * (0.59 * tone**0.3 - g)
            b += cover * (0.50 * tone**0.3 - b)
        else:  # lichen-like crusts, ochre and dull red
            red = 1.0 if kind > 0.9 else 0.0
            r += cover * (0.45 * tone - r)
            g += cover * ((0.30 - 0.16 * red) * tone - g)
            b += cover * (0.10 * tone - b)
    return r, g, b


@numba.njit(cache=True)
@no_type_check
def radiance(
    shade: np.ndarray,
    animals: np.ndarray,
    owner: np.ndarray,
    corner: np.ndarray,
    cell: float,
    p: np.ndarray,
    footprint: float,
    time: float,
    caustics: float,
    seed: int,
    out: np.ndarray,
) -> None:
    """Add the radiance of the surface at the world point p, seen by a pixel of the given size there, to out[3]."""
    gx, gy = (p[0] - corner[0]) / cell, (p[1] - corner[1]) / cell
    slope_x, slope_y = bilinear(shade[:, :, 0], gx, gy), bilinear(shade[:, :, 1], gx, gy)
    sun, sky = bilinear(shade[:, :, 2], gx, gy), bilinear(shade[:, :, 3], gx, gy)
    rock = bilinear(shade[:, :, 4], gx, gy)
    x, y, z = p[0], p[1], p[2]
    steep = np.sqrt(1 + slope_x * slope_x + slope_y * slope_y)

    r = g = b = 0.0
    if rock < 1:
        r, g, b = _sand(x, y, z, footprint, seed)
    if rock > 0:
        rr, rg, rb = _rock(x, y, z, steep, footprint, seed)
        r += rock * (rr - r)
        g += rock * (rg - g)
        b += rock * (rb - b)

    number = owner[min(max(int(gy), 0), owner.shape[0] - 1), min(max(int(gx), 0), owner.shape[1] - 1)]
    if number >= 0:
        animal = animals[number]
        distance = outline(animal, x - animal[1], y - animal[2])
        cover = min(max((1 - distance) * animal[3] / max(footprint, 0.002) + 0.5, 0.0), 1.0)
        if cover > 0:
            pattern = np.exp(0.45 * fractal(x, y, z, 0.03, 4, 0.8, footprint, seed + 9))
            if animal[0] == STAR:
                pattern *= 1.25 - 0.5 * min(distance, 1.0)
            elif animal[0] == CORAL:  # broad lobes, so that views of it match
                pattern *= np.exp(0.8 * fractal(x, y, z, 0.09, 3, 0.7, footprint, seed + 12))
            elif animal[0] == SPONGE:
                pore = noise(x / 0.012, y / 0.012, z / 0.012, seed + 10)
                pattern *= 1 - 0.6 * min(max(pore * 3, 0.0), 1.0) * min(1.0, max(0.0, 2 - footprint / 0.006))
            r += cover * (animal[6] * pattern - r)
            g += cover * (animal[7] * pattern - g)
            b += cover * (animal[8] * pattern - b)

    facing = max(0.0, (SUN[2] - SUN[0] * slope_x - SUN[1] * slope_y) / steep)
    direct = _SUNLIGHT * sun * facing
    if caustics > 0:
        direct *= caustic(x - SUN[0] / SUN[2] * z, y - SUN[1] / SUN[2] * z, time, caustics)
    light = _SKY * sky * (0.6 + 0.4 / steep) + direct
    out[0] += min(r, 0.95) * light
    out[1] += min(g, 0.95) * light
    out[2] += min(b, 0.95) * light
