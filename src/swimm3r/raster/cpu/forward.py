"""The images, a tile at a time: pairs front to back, each over the blocks it may touch."""

from typing import no_type_check

import numpy as np

from swimm3r.raster.cpu import math
from swimm3r.raster.cpu.bins import COLOR, CONIC_A, DEPTH, EXPONENT, LOG2_O, MEAN_X, MEAN_Y, R2_MAX
from swimm3r.raster.cpu.math import full_width_vectors, prefetch
from swimm3r.raster.cpu.tiles import (
    AHEAD,
    B0,
    B1,
    B2,
    BLOCK,
    BLOCKS,
    CHECK,
    HALF,
    KB0,
    KB1,
    KB2,
    KD0,
    KD1,
    KD2,
    ONE,
    OWN_ROWS,
    PIXELS,
    SOURCES,
    STRIDE,
    ZERO,
    T,
    X,
    Y,
    advance,
    begin_tile,
    channels,
    coverage,
    falloff,
    kernel,
    list_blocks,
    live_blocks,
    middle_of,
    put_back,
    seen_color,
    squared_distance,
    through_water,
    transmittance,
    workspace,
)
from swimm3r.raster.records import TILE

# Rows beyond those of every tile: sums of the underwater color, the clear color, z; the pair's weight
I0, I1, I2, J0, J1, J2, Z, W = (np.uintp(STRIDE * k) for k in range(OWN_ROWS, 20))
ROWS = 20


@no_type_check
@math.inlined
def add_light(ws, blocks, n, color, z, middle, at_middle, far):
    """Add the pairs of n blocks, whose weights are known, to the images; no `middle`, no water."""
    full_width_vectors()
    for j in range(n):
        first = blocks[j]
        for q in range(first, first + BLOCK):
            w = ws[W + q]
            if middle is not None:
                E_B = through_water((ws[KB0 + q], ws[KB1 + q], ws[KB2 + q]), z, middle[0], at_middle[0], far)
                E_D = through_water((ws[KD0 + q], ws[KD1 + q], ws[KD2 + q]), z, middle[1], at_middle[1], far)
                F = seen_color(color, (ws[B0 + q], ws[B1 + q], ws[B2 + q]), E_B, E_D)
                ws[I0 + q] += w * F[0]
                ws[I1 + q] += w * F[1]
                ws[I2 + q] += w * F[2]
            ws[J0 + q] += w * color[0]
            ws[J1 + q] += w * color[1]
            ws[J2 + q] += w * color[2]
            ws[Z + q] += w * z


@no_type_check
@kernel
def forward_tiles(
    first_tile,
    beyond,
    packed,
    tile_start,
    ids,
    masks,
    Binf,
    beta_D,
    beta_B,
    rgb,
    clear,
    z_depth,
    alpha_out,
    gaussian,
    sources=SOURCES,
):
    """Images of the tiles first_tile..beyond-1; without water (None for the maps) the clear one is all there is."""
    full_width_vectors()
    height, width = z_depth.shape
    columns = (width + TILE - 1) // TILE
    ws, blocks = workspace(ROWS), np.empty(BLOCKS, np.uintp)
    for tile in range(first_tile, beyond):
        tile_y, tile_x = (tile // columns) * TILE, (tile % columns) * TILE
        spread = begin_tile(ws, tile_y, tile_x, height, width, Binf, beta_D, beta_B)
        ws[I0:] = ZERO
        begin, end = tile_start[tile], tile_start[tile + 1]
        live = live_blocks(ws)
        for entry in range(begin, end):
            if (entry - begin) % CHECK == CHECK - 1:
                live = live_blocks(ws)
                if live == 0:
                    break
            prefetch(packed, ids[min(entry + AHEAD, end - 1)])
            i = np.uintp(ids[entry])  # no view of the row: counting references to it is atomic, and stalls
            n = list_blocks(masks[entry] & live, blocks)
            mean_x, mean_y = packed[i, MEAN_X] - np.float32(tile_x), packed[i, MEAN_Y] - np.float32(tile_y)
            log2_o, exponent, r2_max, z = packed[i, LOG2_O], packed[i, EXPONENT], packed[i, R2_MAX], packed[i, DEPTH]
            conic, color = channels(packed, i, CONIC_A), channels(packed, i, COLOR)
            for j in range(n):
                first = blocks[j]
                for q in range(first, first + BLOCK):
                    r2 = squared_distance(ws[X + q] - mean_x, ws[Y + q] - mean_y, conic)
                    _, log_f = falloff(r2, gaussian)
                    alpha, _ = coverage(r2, log_f, log2_o, exponent, r2_max)
                    ws[W + q], ws[T + q] = advance(ws[T + q], alpha)
            if Binf is None:
                add_light(ws, blocks, n, color, z, None, None, None)
            else:
                middle = middle_of(ws)
                at_middle = transmittance(middle[0], z), transmittance(middle[1], z)
                if z * spread <= HALF:
                    add_light(ws, blocks, n, color, z, middle, at_middle, None)
                else:
                    add_light(ws, blocks, n, color, z, middle, at_middle, True)
        for q in range(np.uintp(PIXELS)):
            ws[T + q] = ONE - abs(ws[T + q])
        for k in range(3):
            if Binf is not None:
                I, B = I0 + np.uintp(k * STRIDE), B0 + np.uintp(k * STRIDE)
                for q in range(np.uintp(PIXELS)):
                    ws[I + q] += ws[B + q]
                put_back(ws, I, rgb[k], tile_y, tile_x)
            put_back(ws, J0 + np.uintp(k * STRIDE), clear[k], tile_y, tile_x)
        put_back(ws, Z, z_depth, tile_y, tile_x)
        put_back(ws, T, alpha_out, tile_y, tile_x)
