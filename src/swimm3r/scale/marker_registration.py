"""Corners of a coded marker from all edges of its pattern, outer and inner.

In linear light blur moves no edge, but the response of a camera is not known exactly, and scattered light, sharpening
and an unknown response move every edge toward its dark or its bright side. Edges of the pattern face both ways, so the
shift is solved for together with the homography from the marker's plane to the rays of the camera, whose lens bends
straight edges.
"""

from dataclasses import dataclass

import cv2
import numpy as np
import torch
from jaxtyping import Bool, Float

from swimm3r.cameras import Cameras, directions, distort

_REACH_PX = 4.0  # greatest distance from an edge to which its profile goes
_REACH_CELLS = 0.45  # the same by the side of a cell: to the middle of both cells
_STEPS = 17  # samples of a profile
_PLACES = np.linspace(0.35, 0.65, 5)  # along the side of a cell, away from its corners, which blur rounds
_ROUNDS = 6  # profiles are laid again around the edges that were found
_CONTRAST = 0.4  # of the marker's median, below which an edge is covered or in shadow
_OUTLIER = 3.0  # robust standard deviations
_FEWEST = 0.6  # of the edges, below which the marker is not seen well enough
_STEP = 1e-5  # of rays, for derivatives by the lens
_FAR_CELLS = 0.25  # robust deviation of the edges from the homography's, above which the square is another thing


@dataclass(frozen=True)
class PatternEdges:
    """Edges between dark and bright cells; the unit is the side of a cell, the origin the square's first corner."""

    places: Float[np.ndarray, "edges k 2"]
    to_bright: Float[np.ndarray, "edges 2"]  # unit vectors across the edges


def pattern_edges(bright: Bool[np.ndarray, "n n"]) -> PatternEdges:
    """The edges of a pattern (rows from the first corner on, its dark frame included) on a bright ground."""
    padded = np.pad(bright, 1, constant_values=True)
    places, to_bright = [], []
    for axis in (0, 1):
        low, high = (padded[:-1], padded[1:]) if axis == 0 else (padded[:, :-1], padded[:, 1:])
        for row, column in np.argwhere(low != high):
            along, across = (column, row) if axis == 0 else (row, column)
            line = np.stack([along - 1 + _PLACES, np.full(len(_PLACES), float(across))], -1)
            sign = 1.0 if high[row, column] else -1.0
            places.append(line if axis == 0 else line[:, ::-1])
            to_bright.append((0.0, sign) if axis == 0 else (sign, 0.0))
    return PatternEdges(np.array(places), np.array(to_bright))


def registered_corners(
    light: Float[np.ndarray, "h w"],
    camera: Cameras,
    corners: Float[np.ndarray, "4 2"],
    bright: Bool[np.ndarray, "n n"],
) -> Float[np.ndarray, "4 2"] | None:
    """Corners of the dark square of a marker in a camera's image of linear light, pixels from the image's corner.

    `corners` are those corners within half a cell, clockwise from the pattern's first one. None where the pattern does
    not fit there: covered, or not flat.
    """
    edges, n = pattern_edges(bright), len(bright)
    square = np.array([[0, 0], [n, 0], [n, n], [0, n]], np.float32)
    rays = directions(camera, torch.from_numpy(corners)[None])[0, :, :2].numpy()
    plane = cv2.getPerspectiveTransform(square, rays.astype(np.float32)).astype(np.float64)
    tangent = edges.to_bright[:, None, ::-1] * np.ones_like(edges.places)
    for _ in range(_ROUNDS):
        at, slopes, by_plane = _seen(plane, camera, edges.places)
        ahead = np.einsum("ekij,ekj->eki", slopes, tangent)
        inward = np.einsum("ekij,ej->eki", slopes, edges.to_bright)
        side = np.linalg.norm(ahead, axis=-1)
        across = np.stack([-ahead[..., 1], ahead[..., 0]], -1) / side[..., None]
        across *= np.sign((across * inward).sum(-1, keepdims=True))
        away, clear = _distances(light, at, across, min(_REACH_PX, _REACH_CELLS * float(np.median(side))))
        if clear.mean() < _FEWEST:
            return None
        rows, away = np.einsum("eki,ekij->ekj", across, by_plane)[clear], away[clear]
        found, spread = _robust_fit(np.concatenate([rows, np.ones((len(rows), 1))], 1), away)
        if spread > _FAR_CELLS * float(np.median(side)):
            return None
        plane = plane + np.append(found[:8], 0).reshape(3, 3)
    return _seen(plane, camera, square[:, None].astype(np.float64))[0][:, 0]


def _robust_fit(rows: Float[np.ndarray, "n p"], values: Float[np.ndarray, " n"]) -> tuple[np.ndarray, float]:
    """The least squares solution without outliers, and the robust deviation from it."""
    kept, found, spread = np.ones(len(values), bool), np.zeros(rows.shape[1]), 0.0
    for _ in range(3):
        found = np.linalg.lstsq(rows[kept], values[kept], rcond=None)[0]
        left = np.abs(values - rows @ found)
        spread = 1.4826 * float(np.median(left))
        kept = left <= max(_OUTLIER * spread, 1e-3)
    return found, spread


def _seen(
    plane: Float[np.ndarray, "3 3"], camera: Cameras, xy: Float[np.ndarray, "m k 2"]
) -> tuple[Float[np.ndarray, "m k 2"], Float[np.ndarray, "m k 2 2"], Float[np.ndarray, "m k 2 8"]]:
    """Pixels of points of the marker's plane, and their derivatives by the points and by the homography's entries.

    The homography takes the plane to rays (x, y, 1) of the camera; its last entry is 1.
    """
    uvw = xy @ plane[:, :2].T + plane[:, 2]
    w = uvw[..., 2, None, None]
    rays = uvw[..., :2] / uvw[..., 2:]
    by_point = (plane[:2, :2] - rays[..., None] * plane[2, :2]) / w
    x, y = np.moveaxis(xy, -1, 0)
    u, v = np.moveaxis(rays, -1, 0)
    none, one = np.zeros_like(x), np.ones_like(x)
    rows = [[x, y, one, none, none, none, -u * x, -u * y], [none, none, none, x, y, one, -v * x, -v * y]]
    by_plane = np.moveaxis(np.array(rows), (0, 1), (-2, -1)) / w
    at, lens = _pixels(camera, rays)
    return at, lens @ by_point, lens @ by_plane


def _pixels(
    camera: Cameras, rays: Float[np.ndarray, "m k 2"]
) -> tuple[Float[np.ndarray, "m k 2"], Float[np.ndarray, "m k 2 2"]]:
    """Pixels of rays (x, y, 1), and their derivatives by x and y as central differences."""
    beside = _STEP * np.array([[0.0, 0], [1, 0], [-1, 0], [0, 1], [0, -1]])
    xy = torch.from_numpy(rays[..., None, :] + beside)
    K = camera.K[0].double()
    pixels = distort(xy, camera.distortion[0].double(), camera.model) @ K[:2, :2].T + K[:2, 2]
    at, right, left, below, above = np.moveaxis(pixels.numpy(), -2, 0)
    return at, np.stack([right - left, below - above], -1) / (2 * _STEP)


def _distances(
    light: Float[np.ndarray, "h w"],
    at: Float[np.ndarray, "m k 2"],
    across: Float[np.ndarray, "m k 2"],
    reach: float,
) -> tuple[Float[np.ndarray, "m k"], Bool[np.ndarray, "m k"]]:
    """Distances by which edges lie beyond places in the direction of their bright side, and those that are seen.

    The distance is that of a sharp edge with as much light along the profile.
    """
    offsets = np.linspace(-reach, reach, _STEPS)
    xy = at[..., None, :] + offsets[:, None] * across[..., None, :]
    h, w = light.shape
    inside = ((xy >= 0.5) & (xy <= (w - 0.5, h - 0.5))).all((-1, -2))
    x, y = np.moveaxis(xy.reshape(len(xy), -1, 2) - 0.5, -1, 0).astype(np.float32)
    profiles = cv2.remap(light.astype(np.float32), x, y, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
    profiles = profiles.reshape(xy.shape[:-1]).astype(np.float64)
    dark, bright = (profiles[..., end].mean(1, keepdims=True) for end in (0, -1))
    contrast = bright - dark
    seen = inside & (contrast > max(_CONTRAST * float(np.median(contrast)), 0.0))
    lit = np.trapezoid(profiles - dark[..., None], offsets, axis=-1)
    return reach - lit / np.where(seen, contrast, np.inf), seen
