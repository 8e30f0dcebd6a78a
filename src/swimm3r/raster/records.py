"""Inputs and outputs of the rasterizer: one camera's projected primitives, the water per pixel, the images.

Pixel (x, y) has its center at (x + 0.5, y + 0.5). Images are [3, H, W]; depths are camera z in the units of the betas.
"""

from dataclasses import dataclass
from typing import Literal, NamedTuple

import torch
from jaxtyping import Float, Int
from torch import Tensor

TILE = 16
"""Side of a tile in pixels."""
ALPHA_MIN = 1 / 255
"""Pairs fainter than this are skipped by default; the paper and the vectors cut nothing (alpha_min=0)."""
ALPHA_MAX = 0.999
"""Opacity of one pair is capped here; a capped pair has no gradient toward its shape."""
Kernel = Literal["beta", "gaussian"]
"""Falloff of a primitive from its center: (1 - r2)^b within r2 < 1, or e^{-b r2}, which only `alpha_min` ends."""
T_MIN = 1e-4
"""A pixel ends *before* the primitive that would bring its transmittance to this or below."""


class Primitives2D(NamedTuple):
    """Primitives as one camera sees them, in any order."""

    mean2d: Float[Tensor, "n 2"]  # px
    conic: Float[Tensor, "n 3"]  # (A, B, C) of r2 = A dx^2 + 2 B dx dy + C dy^2, 1/px^2
    color: Float[Tensor, "n 3"]  # clear (water-free) color
    opacity: Float[Tensor, " n"]  # 0..1, already conditioned on the view
    beta: Float[Tensor, " n"]  # b of the kernel, > 0: 4 exp of a Beta primitive's raw parameter, 1/2 of a Gaussian
    depth: Float[Tensor, " n"]  # camera z of the center; <= 0 or not finite: not drawn


class MediumMaps(NamedTuple):
    """The water at every pixel. For ray depth, scale both betas with the length of the pixel's ray at z = 1."""

    Binf: Float[Tensor, "3 h w"]  # veiling light B_inf
    beta_D: Float[Tensor, "3 h w"]  # attenuation coefficient, per unit of depth
    beta_B: Float[Tensor, "3 h w"]  # backscatter coefficient, per unit of depth


class RasterOutput(NamedTuple):
    """The images of one camera. The expected depth is z_depth / alpha."""

    rgb: Float[Tensor, "3 h w"]  # with its water (Eq. 12)
    clear: Float[Tensor, "3 h w"]  # without: sum_i w_i c_i
    z_depth: Float[Tensor, "h w"]  # sum_i w_i z_i, not normalized
    alpha: Float[Tensor, "h w"]  # 1 - T_{K+1}


class SggBuffers(NamedTuple):
    """Parts of the projected-center gradient (Alg. 1), added to in place by the adjoint; start from `zeros`.

    The clear-object, clear-image, depth and alpha branches make `geo`, attenuation and backscatter `med`;
    geo + med is the plain gradient of mean2d (docs/derivations/compositing.md#branches-of-the-adjoint).
    """

    geo: Float[Tensor, "n 2"]
    med: Float[Tensor, "n 2"]
    geo_abs: Float[Tensor, "n 2"]  # sum over pixels of the component-wise absolute geo gradient
    full_abs: Float[Tensor, "n 2"]  # the same of the plain gradient
    depth_iso: Float[Tensor, "n 3"]  # gradient of mean2d (2) and depth (1) that comes through z_depth alone

    @staticmethod
    def zeros(n: int, device: torch.device | str = "cpu") -> "SggBuffers":
        """Buffers for n primitives."""
        return SggBuffers(*(torch.zeros(n, k, device=device) for k in (2, 2, 2, 2, 3)))


@dataclass(frozen=True)
class CpuBins:
    """Layout of the pairs of a primitive, for the CPU's kernels."""

    order: Int[Tensor, " drawn"]  # the primitives that may be seen, by depth
    blocks: Int[Tensor, " pairs"]  # bit 4 r + c: the ellipse may cover a pixel of the tile's 4 x 4 block (r, c)
    slot: Int[Tensor, " pairs"]  # where this pair's gradient is kept: the pairs of one primitive are neighbors
    first_slot: Int[Tensor, " slot_bounds"]  # order[r] owns slots first_slot[r] : first_slot[r + 1]


@dataclass(frozen=True)
class Bins:
    """Primitives of each tile, front to back; without gradient, for one camera and one image size."""

    height: int
    width: int
    alpha_min: float
    kernel: Kernel
    packed: Float[Tensor, "n 16"]  # what a kernel reads of each primitive, one cache line (see bins.py)
    tile_start: Int[Tensor, " tile_bounds"]  # tile t holds the pairs tile_start[t] : tile_start[t + 1]
    ids: Int[Tensor, " pairs"]  # index of the primitive
    cpu: "CpuBins | None" = None  # what only the CPU kernels read

    def tiles(self) -> tuple[int, int]:
        """Rows and columns of tiles."""
        return -(-self.height // TILE), -(-self.width // TILE)
