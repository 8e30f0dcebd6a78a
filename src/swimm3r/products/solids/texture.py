"""A texture for a mesh: every triangle has a corner of a small square of the image, colored from the frames.

A square of p = n + 2 texels holds two triangles with n texels along a leg, one from each of two opposite corners. The
texel at (i, j) of the first has the barycentric coordinates (1 - b - c, b, c), b = i / (n - 1), c = j / (n - 1). One
diagonal beyond its edge belongs to it, too, so that bilinear sampling reads no other triangle. Triangles beside each
other on the ground are beside each other in the image, row by row.
"""

import math
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, Float32, UInt8
from scipy.spatial import KDTree

from swimm3r.products.frame_colors import Points, blended
from swimm3r.products.solids.cloud import OrientedCloud
from swimm3r.products.solids.mesh import Mesh
from swimm3r.products.survey import Colors, Survey
from swimm3r.progress import Progress, silent

_LARGEST = 8192  # texels along a side: what browsers take
_FEWEST, _MOST = 2, 12  # texels along a triangle's leg
_CHUNK = 400_000  # texels that are colored at a time


@dataclass(frozen=True)
class Texture:
    """An image, and the place of every corner of every triangle in it, 0..1 from the upper left."""

    image: UInt8[np.ndarray, "side side 3"]
    uv: Float[np.ndarray, "t 3 2"]


def textured(
    survey: Survey, mesh: Mesh, cloud: OrientedCloud, texel: float, colors: Colors, progress: Progress = silent
) -> Texture:
    """The texture of a mesh with texels of about this size, local; what no frame sees has the nearest point's color."""
    edges = mesh.vertices[mesh.triangles[:, 0]] - mesh.vertices[mesh.triangles[:, 1]]
    n = _texels(float(np.median(np.linalg.norm(edges, axis=1))) / texel, len(mesh.triangles))
    square, flipped, side = _arranged(mesh)
    i, j = _of_triangle(n)
    weights = np.stack([1 - (i + j) / (n - 1), i / (n - 1), j / (n - 1)], -1)
    size = side * (n + 2)
    image = np.zeros((size, size, 3), np.uint8)
    order = np.argsort(square[:, 1] * side + square[:, 0], kind="stable")
    step = max(1, _CHUNK // len(i))
    for start in range(0, len(order), step):
        progress("coloring the mesh", start, len(order))
        own = order[start : start + step]
        corners = mesh.vertices[mesh.triangles[own]]
        normal = mesh.normals[mesh.triangles[own]].mean(1)
        normal /= np.maximum(np.linalg.norm(normal, axis=1, keepdims=True), 1e-12)
        places = np.einsum("kc,tcx->tkx", weights, corners).reshape(-1, 3)
        found = colored(survey, places, np.repeat(normal, len(i), 0), cloud, texel, colors)
        column, row = _places(square[own], flipped[own], i, j, n)
        image[row.ravel(), column.ravel()] = (found * 255 + 0.5).astype(np.uint8)
    progress("coloring the mesh", len(order), len(order))
    leg = np.array([[0, 0], [n - 1, 0], [0, n - 1]])
    column, row = _places(square, flipped, leg[:, 0], leg[:, 1], n)
    return Texture(image, np.stack([column + 0.5, row + 0.5], -1) / size)


def colored(
    survey: Survey,
    places: Float[np.ndarray, "n 3"],
    normals: Float[np.ndarray, "n 3"],
    cloud: OrientedCloud,
    size: float,
    colors: Colors,
) -> Float32[np.ndarray, "n 3"]:
    """Colors of places on a surface by the frames that see them, else by the nearest point of the cloud."""
    points = Points(places, normals, size)
    found = blended(survey, points, list(survey.overview), [colors])[colors]
    (unseen,) = np.nonzero(np.isnan(found).any(1))
    if len(unseen):
        found[unseen] = cloud.rgb[KDTree(cloud.xyz).query(places[unseen])[1]]
    return found


def _texels(edge: float, triangles: int) -> int:
    """Texels along a leg, as many as the largest image allows."""
    n = min(max(round(edge) + 1, _FEWEST), _MOST)
    while n > _FEWEST and math.ceil(math.sqrt(triangles / 2)) * (n + 2) > _LARGEST:
        n -= 1
    return n


def _arranged(mesh: Mesh) -> tuple[np.ndarray, np.ndarray, int]:
    """The square (column, row) of each triangle, which of them are the second there, and squares along a side."""
    middles = mesh.vertices[mesh.triangles].mean(1)
    count = len(middles)
    side = max(1, math.ceil(math.sqrt(math.ceil(count / 2))))
    order = np.argsort(-middles[:, 1], kind="stable")
    for start in range(0, count, 2 * side):
        row = order[start : start + 2 * side]
        order[start : start + 2 * side] = row[np.argsort(middles[row, 0], kind="stable")]
    rank = np.empty(count, np.int64)
    rank[order] = np.arange(count)
    square = rank // 2
    return np.stack([square % side, square // side], -1), rank % 2 == 1, side


def _of_triangle(n: int) -> tuple[np.ndarray, np.ndarray]:
    """Columns and rows of a triangle's texels in its square, the diagonal beyond its edge included."""
    i, j = np.meshgrid(np.arange(n + 1), np.arange(n + 1), indexing="ij")
    own = i + j <= n
    return i[own], j[own]


def _places(
    square: np.ndarray, flipped: np.ndarray, i: np.ndarray, j: np.ndarray, n: int
) -> tuple[np.ndarray, np.ndarray]:
    """Columns and rows in the image of texels of triangles; the second of a square counts from its far corner."""
    p = n + 2
    column = np.where(flipped[:, None], p - 1 - i, i) + square[:, :1] * p
    row = np.where(flipped[:, None], p - 1 - j, j) + square[:, 1:] * p
    return column, row
