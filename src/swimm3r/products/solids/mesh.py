"""A mesh of the dense cloud: screened Poisson reconstruction (Kazhdan & Hoppe 2013, by pycolmap), cut to what was seen.

The method closes every surface. Triangles far from all points are therefore cut away, holes stay holes, and islands of
a few triangles go.
"""

import math
from dataclasses import dataclass
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np
from jaxtyping import Float, Int
from scipy import sparse
from scipy.spatial import KDTree

from swimm3r.errors import InputError
from swimm3r.products.packages import geo_package
from swimm3r.products.solids.cloud import OrientedCloud, write_ply
from swimm3r.scene.georeference import Georeference

_FAR = 1.5  # spacings from the nearest point, beyond which a vertex was not seen
_LEAST_DEPTH, _MOST_DEPTH = 5, 12  # of the octree; at 12 the surface has 4,096 cells along its longer side
_ISLAND = 0.002  # of all triangles, below which a connected part is an island


@dataclass(frozen=True)
class Mesh:
    """Triangles with vertex normals, local."""

    vertices: Float[np.ndarray, "v 3"]
    normals: Float[np.ndarray, "v 3"]
    triangles: Int[np.ndarray, "t 3"]


def poisson_mesh(cloud: OrientedCloud, spacing: float, place: Georeference, threads: int = -1) -> Mesh:
    """The surface of a cloud in triangles with sides of about `spacing`.

    Raises InputError where the points make no surface.
    """
    import pycolmap

    trimesh: Any = geo_package("trimesh")
    thinned = voxel_means(cloud, spacing)
    extent = float(np.ptp(thinned.xyz, axis=0).max()) * 1.1
    depth = min(max(round(math.log2(max(extent / spacing, 2))), _LEAST_DEPTH), _MOST_DEPTH)
    with TemporaryDirectory() as folder:
        given, made = Path(folder) / "points.ply", Path(folder) / "mesh.ply"
        middle = thinned.xyz.mean(0)
        write_ply(given, OrientedCloud(thinned.xyz - middle, thinned.normals, thinned.rgb), place)
        options = pycolmap.PoissonMeshingOptions()
        options.depth, options.color, options.trim, options.num_threads = depth, False, 0.0, threads
        pycolmap.poisson_meshing(str(given), str(made), options)
        if not made.is_file():
            raise _no_surface()
        raw = trimesh.load(made, process=False)
    vertices, triangles = np.asarray(raw.vertices, np.float64) + middle, np.asarray(raw.faces, np.int64)
    reach = _FAR * max(spacing, extent / 2**depth)
    seen = KDTree(thinned.xyz).query(vertices, distance_upper_bound=reach)[0] <= reach
    triangles = _without_islands(triangles[seen[triangles].all(1)], len(vertices))
    if not len(triangles):
        raise _no_surface()
    used, renumbered = np.unique(triangles, return_inverse=True)
    vertices, triangles = vertices[used], renumbered.reshape(-1, 3)
    return Mesh(vertices, vertex_normals(vertices, triangles), triangles)


def voxel_means(cloud: OrientedCloud, spacing: float) -> OrientedCloud:
    """One point for each cube of side `spacing`: means of position, normal and color."""
    cube = np.floor((cloud.xyz - cloud.xyz.min(0)) / spacing).astype(np.int64)
    _, which, count = np.unique(cube, axis=0, return_inverse=True, return_counts=True)
    which = which.reshape(-1)

    def means(values: np.ndarray) -> np.ndarray:
        total = np.stack([np.bincount(which, values[:, k], len(count)) for k in range(3)], 1)
        return total / count[:, None]

    normal = means(cloud.normals)
    length = np.linalg.norm(normal, axis=1, keepdims=True)
    kept = length[:, 0] > 0.2  # normals that contradict each other are noise
    thinned = OrientedCloud(means(cloud.xyz), normal / np.maximum(length, 1e-12), means(cloud.rgb))
    return thinned.select(kept)


def vertex_normals(vertices: Float[np.ndarray, "v 3"], triangles: Int[np.ndarray, "t 3"]) -> Float[np.ndarray, "v 3"]:
    """Unit normals, means of those of the triangles by their area."""
    a, b, c = (vertices[triangles[:, k]] for k in range(3))
    face = np.cross(b - a, c - a)
    total = np.zeros_like(vertices)
    for k in range(3):
        for axis in range(3):
            total[:, axis] += np.bincount(triangles[:, k], face[:, axis], len(vertices))
    return total / np.maximum(np.linalg.norm(total, axis=1, keepdims=True), 1e-300)


def _without_islands(triangles: Int[np.ndarray, "t 3"], vertices: int) -> Int[np.ndarray, "t2 3"]:
    """The triangles of connected parts that are not tiny."""
    if not len(triangles):
        return triangles
    pairs = np.concatenate([triangles[:, :2], triangles[:, 1:]])
    graph = sparse.coo_array((np.ones(len(pairs), bool), (pairs[:, 0], pairs[:, 1])), (vertices, vertices))
    _, part = sparse.csgraph.connected_components(graph, directed=False)
    size = np.bincount(part[triangles[:, 0]], minlength=part.max() + 1)
    return triangles[size[part[triangles[:, 0]]] >= max(4, _ISLAND * len(triangles))]


def _no_surface() -> InputError:
    return InputError(
        "the dense cloud makes no surface",
        cause="its points are too few, or too far apart for the triangles that were asked for",
        hint="a larger --mesh-spacing, or --no-mesh",
    )
