"""The CPU back end: Numba's tile kernels on a thread pool.

The kernels release the GIL. Each pair of tile and primitive owns a slot for its gradient, and slots are summed per
primitive in a fixed order: no atomics, and results that do not depend on the number of threads, to the bit.
"""

from collections.abc import Iterable
from typing import Any

import numpy as np
import torch
from torch import Tensor

from swimm3r.raster.cpu.adjoint import PLAIN, WITH_SGG, adjoint_tiles, sum_slots
from swimm3r.raster.cpu.bins import bin_primitives
from swimm3r.raster.cpu.forward import forward_tiles
from swimm3r.raster.cpu.threads import spread_by_cost
from swimm3r.raster.records import Bins, CpuBins, MediumMaps, Primitives2D, RasterOutput, SggBuffers

__all__ = ["backward", "bin_primitives", "forward"]


def forward(bins: Bins, p: Primitives2D, medium: MediumMaps | None) -> RasterOutput:
    """The four images; without a medium, rgb is a copy of the clear one."""
    height, width = bins.height, bins.width
    shapes = ((3, height, width), (3, height, width), (height, width), (height, width))
    out = RasterOutput(*(torch.empty(shape) for shape in shapes))
    lists = (bins.packed, bins.tile_start, bins.ids, _lists(bins).blocks)
    maps = (None,) * 3 if medium is None else _arrays(medium)
    arguments: tuple[Any, ...] = (*_arrays(lists), *maps, *_arrays(out), _gaussian(bins))
    spread_by_cost(lambda first, beyond: forward_tiles(first, beyond, *arguments), bins.tile_start.numpy())
    if medium is None:
        out.rgb.copy_(out.clear)
    return out


def backward(
    bins: Bins,
    p: Primitives2D,
    medium: MediumMaps | None,
    out: RasterOutput,
    cotangent: RasterOutput,
    sgg: SggBuffers | None,
    with_medium: bool,
) -> tuple[Primitives2D, MediumMaps | None]:
    """Gradients of the primitives and, where wanted, of the medium maps; adds to `sgg`."""
    grads = Primitives2D(*(torch.zeros_like(t) for t in p))
    medium_grads = MediumMaps(*(torch.empty_like(t) for t in medium)) if medium is not None and with_medium else None
    own = _lists(bins)
    slots = np.empty((len(bins.ids), PLAIN if sgg is None else WITH_SGG), np.float32)
    lists = (bins.packed, bins.tile_start, bins.ids, own.blocks, own.slot)
    g_rgb, g_clear, g_z, g_alpha = (g.contiguous() for g in cotangent)
    images: tuple[Any, ...]
    if medium is None:
        images = (*(None,) * 4, *_arrays((g_rgb + g_clear, g_z, g_alpha)), None, *_arrays(out[1:]))
    else:
        images = _arrays((*medium, g_rgb, g_clear, g_z, g_alpha, *out))
    d_medium = (None,) * 3 if medium_grads is None else _arrays(medium_grads)
    with_sgg = None if sgg is None else True
    arguments: tuple[Any, ...] = (*_arrays(lists), *images, slots, *d_medium, with_sgg, _gaussian(bins))
    spread_by_cost(lambda first, beyond: adjoint_tiles(first, beyond, *arguments), bins.tile_start.numpy())
    buffers = (None,) * 5 if sgg is None else _arrays(sgg)
    totals: tuple[Any, ...] = (*_arrays((bins.packed, own.order, own.first_slot)), slots, *_arrays(grads), *buffers)
    spread_by_cost(lambda first, beyond: sum_slots(first, beyond, *totals), own.first_slot.numpy())
    return grads, medium_grads


def _lists(bins: Bins) -> CpuBins:
    if bins.cpu is None:
        raise ValueError("these bins were made for the Warp back end; make them with bin_primitives on CPU tensors")
    return bins.cpu


def _gaussian(bins: Bins) -> bool | None:
    """The kernel as the compiled code is told: by type."""
    return True if bins.kernel == "gaussian" else None


def _arrays(tensors: Iterable[Tensor]) -> tuple[Any, ...]:
    return tuple(t.numpy() for t in tensors)
