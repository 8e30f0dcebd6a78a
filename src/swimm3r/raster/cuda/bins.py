"""Tile lists in torch, on the device of the primitives."""

import torch

from swimm3r.raster.records import TILE, Bins, Kernel, Primitives2D


def bin_primitives(p: Primitives2D, height: int, width: int, alpha_min: float, kernel: Kernel) -> Bins:
    """Tile lists on the primitives' device: every tile of which an ellipse may cover a pixel.

    They list a few in ten thousand more than the CPU's, which asks strips of four rows (`raster.cpu.bins.span`).
    The host waits twice: for the number of tiles around the primitives, and for that of those they touch.
    """
    n, device = len(p.depth), p.depth.device
    A, B, C = p.conic.double().unbind(-1)
    determinant = A * C - B * B
    if kernel == "gaussian":
        r2_max = (p.opacity.double() / alpha_min).log() / p.beta.double()
    else:
        r2_max = 1 - (alpha_min / p.opacity.double()) ** (1 / p.beta.double())
    seen = (p.depth > 0) & p.depth.isfinite() & p.mean2d.isfinite().all(-1) & (A > 0) & (determinant > 0)
    seen &= A.isfinite() & determinant.isfinite() & (p.beta > 0) & (p.opacity > 0) & (p.opacity >= alpha_min)
    safe = torch.where(seen, determinant, 1.0)
    half = torch.stack([r2_max * C / safe, r2_max * A / safe], -1).clamp(min=0).sqrt() + 1e-3
    size = torch.tensor([width, height]).to(device)
    mean = torch.where(seen[:, None], p.mean2d.double(), 0.0)
    first = (mean - half - 0.5).ceil().clamp(min=0).minimum(size).nan_to_num(0).long()
    last = (mean + half - 0.5).floor().clamp(min=-1).minimum(size - 1).nan_to_num(-1).long()
    first_tile, last_tile = first // TILE, torch.div(last, TILE, rounding_mode="floor")
    counts = (last_tile - first_tile + 1).clamp(min=0).prod(-1) * (seen & (first <= last).all(-1))
    ids = torch.repeat_interleave(torch.arange(n, device=device), counts)
    within = torch.arange(len(ids), device=device) - (counts.cumsum(0) - counts)[ids]
    wide = (last_tile - first_tile + 1)[ids, 0]
    column, row = first_tile[ids, 0] + within % wide, first_tile[ids, 1] + within // wide
    # the interval of x that the ellipse covers in the tile's rows (bins.span)
    a, b, d = A[ids], B[ids], determinant[ids]
    low_y = torch.maximum(row * TILE, first[ids, 1]) + 0.5 - mean[ids, 1]
    high_y = torch.minimum(row * TILE + TILE - 1, last[ids, 1]) + 0.5 - mean[ids, 1]
    offset = -b * half[ids, 0] / C[ids]
    reach = a * r2_max[ids]
    y = offset.clamp(low_y, high_y)
    right = mean[ids, 0] + (-b * y + (reach - d * y * y).clamp(min=0).sqrt()) / a + 1e-3
    y = (-offset).clamp(low_y, high_y)
    left = mean[ids, 0] + (-b * y - (reach - d * y * y).clamp(min=0).sqrt()) / a - 1e-3
    kept = ((left <= column * TILE + TILE - 0.5) & (right >= column * TILE + 0.5)).nonzero()[:, 0]
    ids, tile = ids[kept], (row * ((width + TILE - 1) // TILE) + column)[kept]
    key = (tile << 32) | p.depth.float().view(torch.int32)[
        ids
    ].long()  # the bits of positive floats sort like the floats
    order = torch.argsort(key, stable=True)
    tiles = ((height + TILE - 1) // TILE) * ((width + TILE - 1) // TILE)
    tile_start = torch.searchsorted(tile[order], torch.arange(tiles + 1, device=device)).int()
    record = torch.zeros(n, 16, device=device)
    record[:, :2], record[:, 2:5], record[:, 5] = p.mean2d, p.conic, p.opacity.log2()
    record[:, 6], record[:, 7], record[:, 8], record[:, 9:12] = p.beta, r2_max, p.depth, p.color
    return Bins(height, width, alpha_min, kernel, record, tile_start, ids[order].int())
