"""Cross-view depth consistency, compiled by Numba: agreement, specks, resampling to another pixel grid.

Maps hold q = 1 / z_depth, 0 where unknown; pixels are indices, and H, e take them between views as in `kernels`.
"""

from typing import no_type_check

import numpy as np

from swimm3r.sfm.plane_sweep.kernels import kernel

_BORDER = 4  # pixels


@kernel
@no_type_check
def agreement(q, others, H, e, H_back, e_back, tolerance, pose_error):
    """Mean depth of all frames that see the same surface, the number of others among them, and of those that could.

    A point agrees where the other frame's own depth there differs by less than `tolerance` (relative) and its point
    falls back within 1.5 pixels of where it came from; or within `pose_error` pixels, which is all that the poses are
    worth, unless the depths then differ by more than 6 %. A frame could see a point that falls into its image,
    away from the border, where windows do not fit.
    """
    h, w = q.shape
    count, possible = np.zeros((h, w), np.uint8), np.zeros((h, w), np.uint8)
    fused = q.copy()
    for y in range(h):
        for x in range(w):
            if q[y, x] <= 0:
                continue
            total = q[y, x]
            for s in range(others.shape[0]):
                X = H[s, 0, 0] * x + H[s, 0, 1] * y + H[s, 0, 2] + q[y, x] * e[s, 0]
                Y = H[s, 1, 0] * x + H[s, 1, 1] * y + H[s, 1, 2] + q[y, x] * e[s, 1]
                Z = H[s, 2, 0] * x + H[s, 2, 1] * y + H[s, 2, 2] + q[y, x] * e[s, 2]
                if Z <= 1e-9:
                    continue
                u, v = X / Z, Y / Z
                if not (0 <= u < w - 1 and 0 <= v < h - 1):
                    continue
                if _BORDER <= u < w - _BORDER and _BORDER <= v < h - _BORDER:
                    possible[y, x] += 1
                expected = q[y, x] / Z  # inverse depth in the other frame
                i, j = int(u), int(v)
                nearest, there = 1e9, 0.0
                for b in range(2):
                    for a in range(2):
                        value = others[s, j + b, i + a]
                        if value > 0 and abs(value - expected) < nearest:
                            nearest, there = abs(value - expected), value
                if nearest > max(tolerance, 0.06) * expected:
                    continue
                bx = H_back[s, 0, 0] * u + H_back[s, 0, 1] * v + H_back[s, 0, 2] + there * e_back[s, 0]
                by = H_back[s, 1, 0] * u + H_back[s, 1, 1] * v + H_back[s, 1, 2] + there * e_back[s, 1]
                bz = H_back[s, 2, 0] * u + H_back[s, 2, 1] * v + H_back[s, 2, 2] + there * e_back[s, 2]
                if bz <= 1e-9:
                    continue
                aside = np.hypot(bx / bz - x, by / bz - y)
                if aside > pose_error and (nearest > tolerance * expected or aside > 1.5):
                    continue
                count[y, x] += 1
                total += there / bz
            fused[y, x] = total / (count[y, x] + 1)
    return fused, count, possible


@kernel
@no_type_check
def depth_beyond(q, other, H, e):
    """The depth that another frame measured where each point falls, over the point's own depth there; 0 = unknown."""
    h, w = q.shape
    beyond = np.zeros((h, w), np.float32)
    for y in range(h):
        for x in range(w):
            if q[y, x] <= 0:
                continue
            X = H[0, 0] * x + H[0, 1] * y + H[0, 2] + q[y, x] * e[0]
            Y = H[1, 0] * x + H[1, 1] * y + H[1, 2] + q[y, x] * e[1]
            Z = H[2, 0] * x + H[2, 1] * y + H[2, 2] + q[y, x] * e[2]
            if Z <= 1e-9:
                continue
            u, v = X / Z, Y / Z
            if not (-0.5 <= u < w - 0.5 and -0.5 <= v < h - 0.5):
                continue
            value = other[int(v + 0.5), int(u + 0.5)]
            if value > 0:
                beyond[y, x] = q[y, x] / Z / value
    return beyond


@kernel
@no_type_check
def patches(q, similar):
    """Connected patches of known q, numbered from 1; neighbors connect where they differ by < `similar` (relative)."""
    h, w = q.shape
    label = np.zeros((h, w), np.int32)
    stack = np.empty((h * w, 2), np.int32)
    current = 0
    for y0 in range(h):
        for x0 in range(w):
            if q[y0, x0] <= 0 or label[y0, x0]:
                continue
            current += 1
            label[y0, x0] = current
            stack[0] = y0, x0
            done, size = 0, 1
            while done < size:
                y, x = stack[done]
                done += 1
                for dy, dx in ((0, 1), (0, -1), (1, 0), (-1, 0)):
                    j, i = y + dy, x + dx
                    if 0 <= j < h and 0 <= i < w and q[j, i] > 0 and label[j, i] == 0:  # noqa: SIM102
                        if abs(q[j, i] - q[y, x]) < similar * q[y, x]:
                            label[j, i] = current
                            stack[size] = j, i
                            size += 1
    return label


@kernel
@no_type_check
def look_up(values, also, guide, u, v, wanted, edge, similar):
    """`values` (0 = unknown) at positions u, v, edge-aware: of the four around it, the most alike in `guide` decides.

    `wanted` is the guide's value at the place asked for. Those within `similar` of the deciding one are averaged.
    Returns the values and, read at the same places, `also`.
    """
    h, w = values.shape
    out, read = np.zeros(u.shape, np.float32), np.zeros(u.shape, np.float32)
    value, share = np.empty(4), np.empty(4)
    for n in range(u.size):
        if not (-0.5 <= u[n] <= w - 0.5 and -0.5 <= v[n] <= h - 0.5):
            continue
        i, j = min(max(int(np.floor(u[n])), 0), w - 2), min(max(int(np.floor(v[n])), 0), h - 2)
        a, b = min(max(u[n] - i, 0.0), 1.0), min(max(v[n] - j, 0.0), 1.0)
        best = 0
        for k in range(4):
            x, y = k % 2, k // 2
            likeness = (guide[j + y, i + x] - wanted[n]) / edge
            near = (a if x else 1 - a) * (b if y else 1 - b)
            share[k] = (near + 1e-3) * np.exp(-0.5 * likeness * likeness) + 1e-9 * near
            value[k] = values[j + y, i + x]
            if share[k] > share[best]:
                best = k
        if value[best] <= 0:
            continue
        total = mean = 0.0
        for k in range(4):
            if abs(value[k] - value[best]) < similar * value[best]:
                total += share[k]
                mean += share[k] * value[k]
        out[n] = mean / total
        read[n] = also[j + best // 2, i + best % 2]
    return out, read
