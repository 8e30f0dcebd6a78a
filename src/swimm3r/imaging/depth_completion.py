"""Depth for every pixel of an image whose depth map has gaps, and where there is no surface at all."""

import numpy as np
import torch
from jaxtyping import Float
from scipy.sparse import coo_matrix, diags
from scipy.sparse.linalg import spsolve
from torch import Tensor

from swimm3r.imaging.filters import LUMA, local_linear
from swimm3r.scene.reconstruction import DepthMap

_COARSE = 96  # long side of the grid on which unknown depth is filled


def fill_z_depth(image: Float[Tensor, "h w 3"], depth: DepthMap, sea: Float[Tensor, "h w"]) -> Float[Tensor, "h w"]:
    """Depth for every pixel: known values stay, gaps follow their surroundings along similar colors.

    Inverse depth is diffused on a coarse grid and fitted to the image by local linear models, between the nearest and
    the farthest hundredth of what is known. `sea` (0..1) says where there is none; what is filled in there is no depth.
    """
    known = depth.z_depth > 0
    if not known.any():
        raise ValueError("a depth map without a single known pixel cannot be filled")
    middle = float(depth.z_depth[known].median())
    inverse = torch.where(known, middle / depth.z_depth.clamp(min=1e-9), 0.0)
    trust = torch.where(known, depth.confidence.clamp(min=0.05), 0.0)
    coarse = _diffused(image, inverse, trust, sea)
    guide = image @ LUMA
    smooth = local_linear(guide, coarse[..., None], (1.001 - sea)[..., None], 0.01 * max(image.shape[:2]), 1e-3)[..., 0]
    farthest, nearest = np.quantile(inverse[known].numpy(), [0.01, 0.99]).tolist()
    filled = smooth.clamp(min=farthest, max=nearest)
    return middle / torch.where(known, inverse, filled)


def _diffused(
    image: Float[Tensor, "h w 3"],
    inverse: Float[Tensor, "h w"],
    trust: Float[Tensor, "h w"],
    sea: Float[Tensor, "h w"],
) -> Float[Tensor, "h w"]:
    """Inverse depth everywhere, from a sparse linear system on a coarse grid.

    Neighboring cells conduct with exp(-|dI|^2 / 0.04^2), and not at all into the sea, which is no surface.
    """
    height, width = inverse.shape
    factor = max(1.0, max(height, width) / _COARSE)
    size = (max(2, round(height / factor)), max(2, round(width / factor)))

    def shrink(x: Tensor) -> np.ndarray:
        return torch.nn.functional.interpolate(x[None], size, mode="area")[0].double().numpy()

    color, land = shrink(image.permute(2, 0, 1)), 1 - shrink(sea[None])[0]
    weight = shrink(trust[None])[0]
    value = shrink((trust * inverse)[None])[0] / np.maximum(weight, 1e-9)
    index = np.arange(weight.size).reshape(size)
    a = np.concatenate([index[:-1].ravel(), index[:, :-1].ravel()])
    b = np.concatenate([index[1:].ravel(), index[:, 1:].ravel()])
    flat = color.reshape(3, -1)
    g = np.exp(-((flat[:, a] - flat[:, b]) ** 2).sum(0) / 0.04**2) * land.ravel()[a] * land.ravel()[b] + 1e-4
    n = index.size
    affinity = coo_matrix((np.r_[g, g], (np.r_[a, b], np.r_[b, a])), shape=(n, n)).tocsr()
    laplacian = diags(np.asarray(affinity.sum(1)).ravel()) - affinity
    solved = spsolve((laplacian + diags(10 * weight.ravel() + 1e-8)).tocsc(), (10 * weight * value).ravel())
    grid = torch.from_numpy(np.asarray(solved, dtype=np.float32)).reshape(1, 1, *size)
    return torch.nn.functional.interpolate(grid, (height, width), mode="bilinear", align_corners=False)[0, 0]
