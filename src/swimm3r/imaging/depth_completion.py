"""Depth for every pixel of an image whose depth map has gaps, and where there is no surface at all."""

from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Bool, Float
from scipy.ndimage import maximum_filter, minimum_filter
from scipy.sparse import coo_array, csr_array, diags
from scipy.sparse.linalg import spsolve
from torch import Tensor

from swimm3r.imaging.filters import blur, local_linear
from swimm3r.imaging.gray import LUMA
from swimm3r.scene.reconstruction import DepthMap

_COARSE = 96  # long side of the grid on which unknown depth is filled
_NEARER, _FARTHER = 1.6, 2.5  # times as near as the nearest known, and as far as the farthest, that is filled in
_LEAST_TRUST = 0.05  # in depth, as a confidence: that of an image's own, at least, and that of other images'
_EDGE, _EDGES = 0.1, (0.008, 0.04)  # of brightness, and within which values, colors are others
_SLOPE = 0.003  # weight of first differences of inverse depth beside second ones
_STEP = 0.125  # of inverse depth, from which a surface is in front of another
_REACH = 0.04  # of the long side: as far from a silhouette, gaps belong to what lies behind
_HOLE = 0.015  # of the long side: gaps as narrow between parts of a surface in front are its own
_IN_FRONT = 0.9  # as open water, that surfaces in front are for what lies behind: it hardly goes on from them
_LIKELIER = 1.0  # logarithm of the ratio of likelihoods above which a gap has the colors of the surface in front
_COLOR_NOISE = 0.01  # standard deviation of colors of an even surface
_AROUND = 0.1  # of the long side, the standard deviation of the window in which colors are like those of a surface
_CHI_SQUARED_99 = 11.34  # of three channels


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

    A surface in front hides from other frames what lies beside its silhouette, so that gaps there are no part of it,
    unless their colors are: they continue what lies behind.
    """
    known = depth.z_depth > 0
    if not known.any():
        raise ValueError("a depth map without a single known pixel cannot be filled")
    middle = float(depth.z_depth[known].median())
    measured = depth.z_depth if elsewhere is None else torch.where(known, depth.z_depth, elsewhere * (sea < 0.5))
    inverse = torch.where(measured > 0, middle / measured.clamp(min=1e-9), 0.0)
    trust = torch.where(known, depth.confidence, 0.0).clamp(min=_LEAST_TRUST) * (measured > 0)
    told = None if cue is None else DepthCue(middle * cue.inverse, cue.trust)

    def continued(trust: Float[Tensor, "h w"], beyond: Float[Tensor, "h w"]) -> Float[Tensor, "h w"]:
        coarse = _continued(image, inverse, trust, beyond, told)
        sigma, weight = 0.01 * max(image.shape[:2]), (1.001 - beyond)[..., None]
        return local_linear(image @ LUMA, coarse[..., None], weight, sigma, 1e-3)[..., 0]

    filled = continued(trust, sea)
    front, beside = _silhouettes(inverse, filled)
    gaps = beside & ~known & (sea < 0.5)
    hidden = gaps & ~_of_the_front(image, front & known, (inverse > 0) & ~front, gaps)
    if hidden.any():
        behind = continued(trust * ~front, torch.maximum(sea, _IN_FRONT * front))
        filled = torch.where(hidden, torch.minimum(filled, behind), filled)
    nearest, farthest = filled_range(inverse[measured > 0])
    return middle / torch.where(known, inverse, filled.clamp(min=farthest, max=nearest))


def _silhouettes(
    inverse: Float[Tensor, "h w"], filled: Float[Tensor, "h w"]
) -> tuple[Bool[Tensor, "h w"], Bool[Tensor, "h w"]]:
    """Masks of the pixels of known inverse depth (0 where unknown) that lie in front of known ones close by, and of
    all pixels that have known ones in front and behind close by."""
    size = 2 * max(1, round(_REACH * max(inverse.shape))) + 1
    known = inverse.numpy() > 0
    behind = torch.from_numpy(minimum_filter(np.where(known, inverse.numpy(), np.inf), size))
    nearest = torch.from_numpy(maximum_filter(inverse.numpy(), size))
    front = (inverse > 0) & (inverse - behind > _STEP * inverse)
    return front, behind.isfinite() & (nearest - behind > _STEP * filled)


def _of_the_front(
    image: Float[Tensor, "h w 3"], front: Bool[Tensor, "h w"], behind: Bool[Tensor, "h w"], gaps: Bool[Tensor, "h w"]
) -> Bool[Tensor, "h w"]:
    """Mask of gaps that are holes in the surfaces in front, or likelier of their colors than of those behind."""
    import cv2

    reach = 2 * max(1, round(_HOLE * max(front.shape) / 2)) + 1
    disk = cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (reach, reach))
    closed = cv2.morphologyEx(
        front.byte().numpy(), cv2.MORPH_CLOSE, disk, borderType=cv2.BORDER_CONSTANT, borderValue=0
    )
    its_own = gaps & (torch.from_numpy(closed) > 0)
    its_own[gaps] |= _log_likelihood(image, front, gaps) - _log_likelihood(image, behind, gaps) > _LIKELIER
    return its_own


def _log_likelihood(
    image: Float[Tensor, "h w 3"], surface: Bool[Tensor, "h w"], asked: Bool[Tensor, "h w"]
) -> Float[Tensor, " n"]:
    """Logarithm of the likelihood of the asked pixels' colors, normally distributed as those of a surface close by."""
    off, covariance = _beside_colors(image, surface, asked, _REACH / 2)
    return -0.5 * _squared(off, covariance) - 0.5 * torch.linalg.slogdet(covariance).logabsdet


def unlike(
    image: Float[Tensor, "h w 3"], surface: Bool[Tensor, "h w"], asked: Bool[Tensor, "h w"]
) -> Bool[Tensor, "h w"]:
    """Mask of the asked pixels whose colors hardly any pixel of a surface around them has (1 in 100 at most).

    They show another thing, as a rod in front of sand does. Colors are taken to be normally distributed.
    """
    found = torch.zeros_like(asked)
    found[asked] = _squared(*_beside_colors(image, surface, asked, _AROUND)) > _CHI_SQUARED_99
    return found


def _beside_colors(
    image: Float[Tensor, "h w 3"], surface: Bool[Tensor, "h w"], asked: Bool[Tensor, "h w"], reach: float
) -> tuple[Float[Tensor, "n 3"], Float[Tensor, "n 3 3"]]:
    """Colors of the asked pixels less the mean of a surface's around them, and the covariance of these; `reach` is the
    standard deviation of the window, a share of the long side."""
    products = (image[..., :, None] * image[..., None, :]).flatten(2)
    moments = torch.cat([torch.ones_like(image[..., :1]), image, products], -1) * surface[..., None]
    cells = blur(on_grid(moments.permute(2, 0, 1)).permute(1, 2, 0), reach * _COARSE).permute(2, 0, 1)
    around = torch.nn.functional.interpolate(cells[None], surface.shape, mode="bilinear", align_corners=False)[0]
    share, mean, square = around[:, asked].T.double().split([1, 3, 9], -1)
    mean, square = mean / share.clamp(min=1e-9), (square / share.clamp(min=1e-9)).unflatten(-1, (3, 3))
    covariance = square - mean[:, :, None] * mean[:, None, :] + _COLOR_NOISE**2 * torch.eye(3, dtype=torch.float64)
    return image[asked].double() - mean, covariance


def _squared(off: Float[Tensor, "n 3"], covariance: Float[Tensor, "n 3 3"]) -> Float[Tensor, " n"]:
    """Squared Mahalanobis distance."""
    return (off * torch.linalg.solve(covariance, off[:, :, None])[:, :, 0]).sum(-1)


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
