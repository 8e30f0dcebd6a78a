"""The adjoint of the images: the pairs once more, front to back, then sums over the tiles of each primitive."""

from typing import no_type_check

import numpy as np
from numba import njit

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
    LN_2,
    ONE,
    OWN_ROWS,
    PIXELS,
    SOURCES,
    STRIDE,
    TWO,
    ZERO,
    T,
    X,
    Y,
    advance,
    begin_tile,
    channels,
    color_slope,
    coverage,
    depth_slope,
    falloff,
    gather,
    half_slope,
    kernel,
    list_blocks,
    live_blocks,
    middle_of,
    payloads,
    plus,
    put_back,
    shape_slopes,
    squared_distance,
    through_water,
    transmittance,
    workspace,
)
from swimm3r.raster.records import TILE

# Rows beyond those of every tile: dL/d rgb, clear, z depth, alpha; what lies behind, of each of the three payloads;
G0, G1, G2, C0, C1, C2, GZ, GA, RF, RG, RD = (np.uintp(STRIDE * k) for k in range(OWN_ROWS, 23))
# sums of w E_B, w z E_B, w z c E_D
VB0, VB1, VB2, ZB0, ZB1, ZB2, ZD0, ZD1, ZD2 = (np.uintp(STRIDE * k) for k in range(23, 32))
# Rows of one primitive's pairs, its blocks one after the other: distance from its center, u and l, weight, the two
# shape slopes, dL/dr2 of each payload, and w times the slopes of color, of z through the water, of z itself
DX, DY, U, LOG_F, PW, P, Q, TF, TG, TD, S0, S1, S2, SW, SZ = (np.uintp(STRIDE * k) for k in range(15))
ROWS, PAIR_ROWS = 32, 15

# Columns of a slot
MEAN, CONIC, COL, OPACITY, BETA, Z_WATER, Z_DIRECT, GEO, GEO_ABS, FULL_ABS, DEPTH_MEAN = (
    0, 2, 5, 8, 9, 10, 11, 12, 14, 16, 18,
)  # fmt: skip
PLAIN, WITH_SGG = 12, 20

adjoint_kernel = njit(nogil=True, cache=True, error_model="numpy", fastmath=math.FLAGS | {"reassoc"})


@no_type_check
@math.inlined
def begin_adjoint(ws, tile_y, tile_x, g_rgb, g_clear, g_z, g_alpha, rgb, clear, z_depth, alpha_out):
    """dL/d image of a tile's pixels, and R = sum_j w_j e_j of the three payloads, which the forward images know."""
    for k in range(3):
        row = np.uintp(k * STRIDE)
        gather(ws, C0 + row, g_clear[k], tile_y, tile_x)
        gather(ws, ZB0 + row, clear[k], tile_y, tile_x)
        if rgb is not None:
            gather(ws, G0 + row, g_rgb[k], tile_y, tile_x)
            gather(ws, VB0 + row, rgb[k], tile_y, tile_x)
    gather(ws, GZ, g_z, tile_y, tile_x)
    gather(ws, GA, g_alpha, tile_y, tile_x)
    gather(ws, ZD0, z_depth, tile_y, tile_x)
    gather(ws, ZD1, alpha_out, tile_y, tile_x)
    for q in range(np.uintp(PIXELS)):
        g_clear_q, J = (ws[C0 + q], ws[C1 + q], ws[C2 + q]), (ws[ZB0 + q], ws[ZB1 + q], ws[ZB2 + q])
        depth = ws[GZ + q] * ws[ZD0 + q]
        other = depth + ws[GA + q] * ws[ZD1 + q]
        other += g_clear_q[0] * J[0] + g_clear_q[1] * J[1] + g_clear_q[2] * J[2]
        ws[RF + q], ws[RG + q], ws[RD + q] = other, other, depth
        if rgb is not None:
            g, B = (ws[G0 + q], ws[G1 + q], ws[G2 + q]), (ws[B0 + q], ws[B1 + q], ws[B2 + q])
            image = g[0] * (ws[VB0 + q] - B[0]) + g[1] * (ws[VB1 + q] - B[1]) + g[2] * (ws[VB2 + q] - B[2])
            ws[RF + q] = image + other
            ws[RG + q] = g[0] * J[0] + g[1] * J[1] + g[2] * J[2] + other
            ws[B0 + q], ws[B1 + q], ws[B2 + q] = g[0] * B[0], g[1] * B[1], g[2] * B[2]
    ws[VB0:] = ZERO


@no_type_check
@math.inlined
def end_adjoint(ws, tile_y, tile_x, d_Binf, d_beta_D, d_beta_B):
    """Gradients of a tile's water: g V, g B_inf sum w z E_B, -g sum w z c E_D."""
    for k in range(3):
        row = np.uintp(k * STRIDE)
        for q in range(row, row + np.uintp(PIXELS)):
            ws[VB0 + q] = ws[G0 + q] * (ONE - ws[VB0 + q])
            ws[ZB0 + q] *= ws[B0 + q]
            ws[ZD0 + q] *= -ws[G0 + q]
        put_back(ws, VB0 + row, d_Binf[k], tile_y, tile_x)
        put_back(ws, ZB0 + row, d_beta_B[k], tile_y, tile_x)
        put_back(ws, ZD0 + row, d_beta_D[k], tile_y, tile_x)


@no_type_check
@math.inlined
def take_light(ws, pairs, blocks, n, color, z, middle, at_middle, with_sgg, d_Binf, far):
    """The adjoint of `add_light`: slopes of the pairs, and sums of the pixels."""
    full_width_vectors()
    for j in range(n):
        first, pair = blocks[j], BLOCK * np.uintp(j)
        for k in range(BLOCK):
            q, c = first + k, pair + k
            w = pairs[PW + c]
            g_clear = (ws[C0 + q], ws[C1 + q], ws[C2 + q])
            if middle is None:
                g = g_veil = E_B = E_D = k_b = k_d = (ZERO, ZERO, ZERO)  # and the compiler leaves out what they enter
            else:
                g, g_veil = (ws[G0 + q], ws[G1 + q], ws[G2 + q]), (ws[B0 + q], ws[B1 + q], ws[B2 + q])
                d_b, d_d = (ws[KB0 + q], ws[KB1 + q], ws[KB2 + q]), (ws[KD0 + q], ws[KD1 + q], ws[KD2 + q])
                E_B = through_water(d_b, z, middle[0], at_middle[0], far)
                E_D = through_water(d_d, z, middle[1], at_middle[1], far)
                k_b, k_d = plus(middle[0], d_b), plus(middle[1], d_d)
            slope = color_slope(g, g_clear, E_D)
            full, geo, depth = payloads(color, z, E_B, slope, g, g_veil, g_clear, ws[GZ + q], ws[GA + q])
            pairs[S0 + c] = w * slope[0]
            pairs[S1 + c] = w * slope[1]
            pairs[S2 + c] = w * slope[2]
            pairs[SW + c] = w * depth_slope(color, E_B, E_D, g, g_veil, k_b, k_d)
            pairs[SZ + c] = w * ws[GZ + q]
            if d_Binf is not None:
                ws[VB0 + q] += w * E_B[0]
                ws[VB1 + q] += w * E_B[1]
                ws[VB2 + q] += w * E_B[2]
                wz = w * z
                ws[ZB0 + q] += wz * E_B[0]
                ws[ZB1 + q] += wz * E_B[1]
                ws[ZB2 + q] += wz * E_B[2]
                ws[ZD0 + q] += wz * color[0] * E_D[0]
                ws[ZD1 + q] += wz * color[1] * E_D[1]
                ws[ZD2 + q] += wz * color[2] * E_D[2]
            behind = ws[RF + q] - w * full
            ws[RF + q] = behind
            pairs[TF + c] = pairs[P + c] * full - pairs[Q + c] * behind
            if with_sgg is not None:
                behind_geo, behind_depth = ws[RG + q] - w * geo, ws[RD + q] - w * depth
                ws[RG + q], ws[RD + q] = behind_geo, behind_depth
                pairs[TG + c] = pairs[P + c] * geo - pairs[Q + c] * behind_geo
                pairs[TD + c] = pairs[P + c] * depth - pairs[Q + c] * behind_depth


@no_type_check
@math.inlined
def put_sums(slots, own, column, sums):
    """Write neighbors in a row."""
    for k in range(len(sums)):
        slots[own, np.uintp(column + k)] = sums[k]


@no_type_check
@adjoint_kernel
def adjoint_tiles(
    first_tile, beyond, packed, tile_start, ids, masks, slot, Binf, beta_D, beta_B, g_rgb, g_clear, g_z, g_alpha,
    rgb, clear, z_depth, alpha_out, slots, d_Binf, d_beta_D, d_beta_B, with_sgg, gaussian, sources=SOURCES,
):  # fmt: skip
    """Slots and water gradients of the tiles first_tile..beyond-1.

    None for `with_sgg` or `d_Binf` leaves that part out; without water, None for the maps, rgb and g_rgb.
    """
    full_width_vectors()
    height, width = z_depth.shape
    columns = (width + TILE - 1) // TILE
    ws, pairs, blocks = workspace(ROWS), workspace(PAIR_ROWS), np.empty(BLOCKS, np.uintp)
    for tile in range(first_tile, beyond):
        tile_y, tile_x = (tile // columns) * TILE, (tile % columns) * TILE
        spread = begin_tile(ws, tile_y, tile_x, height, width, Binf, beta_D, beta_B)
        begin_adjoint(ws, tile_y, tile_x, g_rgb, g_clear, g_z, g_alpha, rgb, clear, z_depth, alpha_out)
        begin, end = tile_start[tile], tile_start[tile + 1]
        live = live_blocks(ws)
        for entry in range(begin, end):
            own = np.uintp(slot[entry])
            if (entry - begin) % CHECK == CHECK - 1:
                live = live_blocks(ws)
            if live == 0:
                for k in range(slots.shape[1]):
                    slots[own, np.uintp(k)] = ZERO
                continue
            prefetch(packed, ids[min(entry + AHEAD, end - 1)])
            i = np.uintp(ids[entry])
            n = list_blocks(masks[entry] & live, blocks)
            mean_x, mean_y = packed[i, MEAN_X] - np.float32(tile_x), packed[i, MEAN_Y] - np.float32(tile_y)
            log2_o, exponent, r2_max, z = packed[i, LOG2_O], packed[i, EXPONENT], packed[i, R2_MAX], packed[i, DEPTH]
            conic, color = channels(packed, i, CONIC_A), channels(packed, i, COLOR)
            mx = my = xx = xy = yy = red = green = blue = opacity = beta = z_water = z_direct = ZERO
            geo_x = geo_y = abs_geo_x = abs_geo_y = abs_x = abs_y = depth_x = depth_y = ZERO
            for j in range(n):
                first, pair = blocks[j], BLOCK * np.uintp(j)
                for k in range(BLOCK):
                    q, c = first + k, pair + k
                    before = ws[T + q]
                    dx, dy = ws[X + q] - mean_x, ws[Y + q] - mean_y
                    r2 = squared_distance(dx, dy, conic)
                    u, log_f = falloff(r2, gaussian)
                    alpha, shaped = coverage(r2, log_f, log2_o, exponent, r2_max)
                    w, ws[T + q] = advance(before, alpha)
                    pairs[DX + c], pairs[DY + c], pairs[U + c], pairs[LOG_F + c], pairs[PW + c] = dx, dy, u, log_f, w
                    pairs[P + c], pairs[Q + c] = shape_slopes(w, before, alpha, shaped, u)
            if Binf is None:
                take_light(ws, pairs, blocks, n, color, z, None, None, with_sgg, d_Binf, None)
            else:
                middle = middle_of(ws)
                at_middle = transmittance(middle[0], z), transmittance(middle[1], z)
                if z * spread <= HALF:
                    take_light(ws, pairs, blocks, n, color, z, middle, at_middle, with_sgg, d_Binf, None)
                else:
                    take_light(ws, pairs, blocks, n, color, z, middle, at_middle, with_sgg, d_Binf, True)
            for c in range(BLOCK * np.uintp(n)):
                dx, dy, t = pairs[DX + c], pairs[DY + c], pairs[TF + c]
                half_x, half_y = half_slope(dx, dy, conic)
                mx += t * half_x
                my += t * half_y
                xx += t * dx * dx
                xy += t * dx * dy
                yy += t * dy * dy
                tu = t * pairs[U + c]
                opacity += tu
                beta += tu * pairs[LOG_F + c]
                red += pairs[S0 + c]
                green += pairs[S1 + c]
                blue += pairs[S2 + c]
                z_water += pairs[SW + c]
                z_direct += pairs[SZ + c]
                if with_sgg is not None:
                    abs_x += abs(t * half_x)
                    abs_y += abs(t * half_y)
                    t_geo, t_depth = pairs[TG + c], pairs[TD + c]
                    geo_x += t_geo * half_x
                    geo_y += t_geo * half_y
                    abs_geo_x += abs(t_geo * half_x)
                    abs_geo_y += abs(t_geo * half_y)
                    depth_x += t_depth * half_x
                    depth_y += t_depth * half_y
            put_sums(slots, own, MEAN, (mx, my, xx, xy, yy, red, green, blue, opacity, beta, z_water, z_direct))
            if with_sgg is not None:
                put_sums(slots, own, GEO, (geo_x, geo_y, abs_geo_x, abs_geo_y, abs_x, abs_y, depth_x, depth_y))
        if d_Binf is not None:
            end_adjoint(ws, tile_y, tile_x, d_Binf, d_beta_D, d_beta_B)


@no_type_check
@kernel
def sum_slots(
    first, beyond, packed, order, first_slot, slots,
    d_mean, d_conic, d_color, d_opacity, d_beta, d_depth, geo, med, geo_abs, full_abs, depth_iso, sources=SOURCES,
):  # fmt: skip
    """Gradients of the primitives order[first..beyond-1]: sums of slots, times what all pairs of a primitive share."""
    s = np.empty(WITH_SGG, np.float32)
    for rank in range(first, beyond):
        s[:] = ZERO
        for k in range(first_slot[rank], first_slot[rank + 1]):
            for c in range(slots.shape[1]):
                s[c] += slots[k, c]
        i = order[rank]
        exponent = packed[i, EXPONENT]
        twice = TWO * exponent  # dL/dmean = 2 b sum t (conic d), d = pixel - mean, dr2/dmean = -2 (conic d)
        d_mean[i, 0], d_mean[i, 1] = twice * s[MEAN], twice * s[MEAN + 1]
        d_conic[i, 0], d_conic[i, 1] = -exponent * s[CONIC], -twice * s[CONIC + 1]
        d_conic[i, 2] = -exponent * s[CONIC + 2]
        d_color[i, 0], d_color[i, 1], d_color[i, 2] = s[COL], s[COL + 1], s[COL + 2]
        d_opacity[i], d_beta[i] = s[OPACITY] / TWO ** packed[i, LOG2_O], LN_2 * s[BETA]
        d_depth[i] = LN_2 * s[Z_WATER] + s[Z_DIRECT]
        if geo is not None:
            for c in range(2):
                geo[i, c] += twice * s[GEO + c]
                med[i, c] += d_mean[i, c] - twice * s[GEO + c]
                geo_abs[i, c] += twice * s[GEO_ABS + c]
                full_abs[i, c] += twice * s[FULL_ABS + c]
                depth_iso[i, c] += twice * s[DEPTH_MEAN + c]
            depth_iso[i, 2] += s[Z_DIRECT]
