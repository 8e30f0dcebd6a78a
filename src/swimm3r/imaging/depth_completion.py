"""Depth for every pixel of an image whose depth map has gaps, and where there is no surface at all."""

from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Float
from scipy.sparse import coo_array, csr_array, diags
from scipy.sparse.linalg import spsolve
from torch import Tensor

from swimm3r.imaging.filters import LUMA, local_linear
from swimm3r.scene.reconstruction import DepthMap

_COARSE = 96  # long side of the grid on which unknown depth is filled
_NEARER, _FARTHER = 1.6, 2.5  # times as near as the nearest known, and as far as the farthest, that is filled in
_LEAST_TRUST = 0.05  # in depth, as a confidence: that of an image's own, at least, and that of other images'
_EDGE, _EDGES = 0.1, (0.008, 0.04)  # of brightness, and within which values, colors are others
_SLOPE = 0.003  # weight of first differences of inverse depth beside second ones


@dataclass(frozen=True)
class DepthCue:
    """Depth that something else than other frames tells of the grid's cells (`on_grid`)."""

    inverse: Float[Tensor, "r c"]  # 1/z-depth
    trust: Float[Tensor, "r c"]  # as a confidence; 0 where it tells nothing


def on_grid(values: Float[Tensor, "*channels h w"]) -> Float[Tensor, "*channels r c"]:
    """Means over the cells of the grid on which unknown depth is filled."""
    *channels, height, width = values.shape
    factor = max(1.0, max(height, width) / _COARSE)
    size = (max(2, round(height / factor)), max(2, round(width / factor)))
    cells = torch.nn.functional.interpolate(values.reshape(1, -1, height, width), size, mode="area")
    return cells.reshape(*channels, *size)


def filled_range(inverse: Float[Tensor, " n"]) -> tuple[float, float]:
    """Inverse depth of the nearest and of the farthest that is filled in beside the inverse depths that are known."""
    farthest, nearest = np.quantile(inverse.numpy(), [0.01, 0.99]).tolist()
    return nearest * _NEARER, farthest / _FARTHER


def fill_z_depth(
    image: Float[Tensor, "h w 3"],
    depth: DepthMap,
    sea: Float[Tensor, "h w"],
    elsewhere: Float[Tensor, "h w"] | None = None,
    cue: DepthCue | None = None,
) -> Float[Tensor, "h w"]:
    """Depth for every pixel: known values stay, gaps go on as planes along similar colors.

    Inverse depth, which is linear over the image of a plane, has the least second differences on a coarse grid, and is
    fitted to the image by local linear models, to 1.6 times as near and 2.5 times as far as the nearest and the
    farthest hundredth of what is known. `sea` (0..1) says where there is none; what is filled in there is no depth.
    `elsewhere` is the depth of points in this image that others have measured, 0 where there are none: what is filled
    in follows them, and the cue (`depth_from_color`) as far as it is to be trusted.
    """
    known = depth.z_depth > 0
    if not known.any():
        raise ValueError("a depth map without a single known pixel cannot be filled")
    middle = float(depth.z_depth[known].median())
    measured = depth.z_depth if elsewhere is None else torch.where(known, depth.z_depth, elsewhere * (sea < 0.5))
    inverse = torch.where(measured > 0, middle / measured.clamp(min=1e-9), 0.0)
    trust = torch.where(known, depth.confidence, 0.0).clamp(min=_LEAST_TRUST) * (measured > 0)
    told = None if cue is None else DepthCue(middle * cue.inverse, cue.trust)
    coarse = _continued(image, inverse, trust, sea, told)
    guide = image @ LUMA
    smooth = local_linear(guide, coarse[..., None], (1.001 - sea)[..., None], 0.01 * max(image.shape[:2]), 1e-3)[..., 0]
    nearest, farthest = filled_range(inverse[measured > 0])
    filled = smooth.clamp(min=farthest, max=nearest)
    return middle / torch.where(known, inverse, filled)


def _continued(
    image: Float[Tensor, "h w 3"],
    inverse: Float[Tensor, "h w"],
    trust: Float[Tensor, "h w"],
    sea: Float[Tensor, "h w"],
    cue: DepthCue | None,
) -> Float[Tensor, "h w"]:
    """Inverse depth everywhere, from a sparse linear system on a coarse grid.

    Neighboring cells conduct with exp(-|dI|^2 / e^2), e being a tenth of the darker one's brightness within 0.008 to
    0.04, and not at all into the sea, which is no surface. Three cells in a row lie on a line as far as both pairs
    conduct.
    """
    color = on_grid(image.permute(2, 0, 1)).double().numpy()
    land, trust_of_cell = 1 - on_grid(sea).double().numpy(), on_grid(trust)
    weight = trust_of_cell.double().numpy()
    value = (on_grid(trust * inverse) / trust_of_cell.clamp(min=1e-9)).double().numpy()
    flat, surface, n = color.reshape(3, -1), land.ravel(), weight.size
    bright = flat.max(0)
    first, second = _in_a_row(land.shape, 2), _in_a_row(land.shape, 3)

    def conducted(a: np.ndarray, b: np.ndarray) -> np.ndarray:
        edge = np.clip(_EDGE * np.minimum(bright[a], bright[b]), *_EDGES)
        return np.exp(-((flat[:, a] - flat[:, b]) ** 2).sum(0) / edge**2) * surface[a] * surface[b] + 1e-4

    slope = _differences(first, np.sqrt(_SLOPE * conducted(*first)), [1, -1], n)
    bend = _differences(second, np.sqrt(conducted(*second[:2]) * conducted(*second[1:])), [1, -2, 1], n)
    smoothness = slope.T @ slope + bend.T @ bend
    pull, sought = 10 * weight.ravel(), 10 * (weight * value).ravel()
    if cue is not None:
        told = 10 * cue.trust.double().numpy().ravel() * surface
        pull, sought = pull + told, sought + told * cue.inverse.double().numpy().ravel()
    solved = spsolve((smoothness + diags(pull + 1e-8)).tocsc(), sought)
    grid = torch.from_numpy(np.asarray(solved, dtype=np.float32)).reshape(1, 1, *land.shape)
    return torch.nn.functional.interpolate(grid, inverse.shape, mode="bilinear", align_corners=False)[0, 0]


def _in_a_row(size: tuple[int, int], count: int) -> list[np.ndarray]:
    """Numbers of the cells of a grid that lie side by side, `count` of them, along columns and along rows."""
    index = np.arange(size[0] * size[1]).reshape(size)
    down = [index[k : size[0] - count + 1 + k].ravel() for k in range(count)]
    across = [index[:, k : size[1] - count + 1 + k].ravel() for k in range(count)]
    return [np.concatenate(pair) for pair in zip(down, across, strict=True)]


def _differences(cells: list[np.ndarray], weight: np.ndarray, factors: list[int], count: int) -> csr_array:
    """The matrix (rows, count) of weighted differences between cells in a row."""
    row = np.tile(np.arange(len(weight)), len(cells))
    values = np.concatenate([factor * weight for factor in factors])
    return coo_array((values, (row, np.concatenate(cells))), shape=(len(weight), count)).tocsr()
