"""The CUDA back end: NVIDIA Warp kernels on torch's tensors and current stream."""

from typing import Any

import torch
from torch import Tensor

from swimm3r.raster import pairmath
from swimm3r.raster.cuda.bins import bin_primitives
from swimm3r.raster.cuda.kernels import PASSES, VALUES
from swimm3r.raster.cuda.launch import launch
from swimm3r.raster.records import TILE, Bins, MediumMaps, Primitives2D, RasterOutput, SggBuffers

__all__ = ["backward", "bin_primitives", "forward"]


def forward(bins: Bins, p: Primitives2D, medium: MediumMaps) -> RasterOutput:
    """The four images."""
    like, height, width = medium.Binf, bins.height, bins.width
    shapes = ((3, height, width), (3, height, width), (height, width), (height, width))
    out = RasterOutput(*(like.new_empty(shape) for shape in shapes))
    _launch(PASSES[bins.kernel].forward, bins, [bins.packed, bins.tile_start, bins.ids, *medium, *out])
    return out


def backward(
    bins: Bins,
    p: Primitives2D,
    medium: MediumMaps,
    out: RasterOutput,
    cotangent: RasterOutput,
    sgg: SggBuffers | None,
    with_medium: bool,
) -> tuple[Primitives2D, MediumMaps | None]:
    """Gradients of the primitives and, where wanted, of the medium maps; adds to `sgg`."""
    sums = bins.packed.new_zeros(len(p.depth) * VALUES)
    d_medium = MediumMaps(*(torch.empty_like(t) for t in medium))
    images = (*medium, *(g.contiguous() for g in cotangent), *out)
    _launch(PASSES[bins.kernel].adjoint, bins, [bins.packed, bins.tile_start, bins.ids, *images, sums, *d_medium])
    s = sums.view(-1, VALUES)
    exponent = torch.where(s.any(-1), p.beta, 1.0)[:, None]  # what was not seen may hold anything
    opacity = torch.where(s.any(-1), p.opacity, 1.0)
    grads = Primitives2D(
        2 * exponent * s[:, 0:2],
        -exponent * s[:, 2:5],
        s[:, 5:8].contiguous(),
        s[:, 8] / opacity,
        pairmath.LN_2 * s[:, 9],
        pairmath.LN_2 * s[:, 10] + s[:, 11],
    )
    if sgg is not None:
        geo, geo_abs, full_abs, depth = (2 * exponent * s[:, k : k + 2] for k in (12, 14, 16, 18))
        iso = torch.cat([depth, s[:, 11:12]], -1)
        for buffer, part in zip(sgg, (geo, grads.mean2d - geo, geo_abs, full_abs, iso), strict=True):
            buffer += part
    return grads, d_medium if with_medium else None


def _launch(kernel: Any, bins: Bins, tensors: list[Tensor]) -> None:
    """One thread per pixel of every tile."""
    rows, columns = bins.tiles()
    launch(kernel, (rows * columns, TILE * TILE), tensors, block_dim=TILE * TILE)
