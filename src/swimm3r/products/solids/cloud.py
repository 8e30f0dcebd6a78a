"""The dense cloud with normals: PLY in local coordinates, LAZ in those of the map.

A normal is the direction in which the nearest neighbors of a point spread least, on the side of the nearest camera.
LAZ holds integers and an offset in double precision, so that map coordinates of millions of metres keep a tenth of a
millimetre; PLY holds 32-bit floats and therefore local coordinates, whose origin its header tells.
"""

from dataclasses import dataclass
from pathlib import Path

import numpy as np
from jaxtyping import Float
from scipy.spatial import KDTree

from swimm3r.io import ply
from swimm3r.io.files.atomic import atomic_path
from swimm3r.products.packages import geo_package
from swimm3r.products.survey import Survey
from swimm3r.scene.georeference import Georeference

_NEIGHBORS = 16
_CHUNK = 200_000  # points whose neighbors are in memory at a time
_STEPS = 10_000  # of a LAZ coordinate in a metre
_RECORD = np.dtype(
    [(name, "<f4") for name in ("x", "y", "z", "nx", "ny", "nz")] + [(name, "u1") for name in ("red", "green", "blue")]
)


@dataclass(frozen=True)
class OrientedCloud:
    """Points with normals and colors, local."""

    xyz: Float[np.ndarray, "n 3"]
    normals: Float[np.ndarray, "n 3"]  # unit, on the side of the cameras
    rgb: Float[np.ndarray, "n 3"]  # as shown, 0..1

    def select(self, which: np.ndarray) -> "OrientedCloud":
        """Some of the points."""
        return OrientedCloud(self.xyz[which], self.normals[which], self.rgb[which])


def oriented_cloud(survey: Survey) -> OrientedCloud | None:
    """The dense cloud of a run with normals; None where the run has none, or fewer points than a normal needs."""
    cloud = survey.rec.cloud
    if cloud is None or len(cloud.xyz) <= _NEIGHBORS:
        return None
    xyz = survey.place.to_local(cloud.xyz.numpy())
    rgb = cloud.shown(survey.rec.white_balance).numpy().astype(np.float64)
    return OrientedCloud(xyz, normals(xyz, survey.centers), rgb)


def normals(xyz: Float[np.ndarray, "n 3"], centers: Float[np.ndarray, "c 3"]) -> Float[np.ndarray, "n 3"]:
    """Unit normals of a cloud that was seen from these places."""
    tree, cameras = KDTree(xyz), KDTree(centers)
    found = np.empty_like(xyz)
    for start in range(0, len(xyz), _CHUNK):
        own = xyz[start : start + _CHUNK]
        near = xyz[tree.query(own, k=_NEIGHBORS)[1]]
        away = near - near.mean(1, keepdims=True)
        axis = np.linalg.eigh(away.transpose(0, 2, 1) @ away)[1][:, :, 0]
        to_camera = centers[cameras.query(own)[1]] - own
        found[start : start + _CHUNK] = np.where((axis * to_camera).sum(1, keepdims=True) < 0, -axis, axis)
    return found


def write_ply(path: Path, cloud: OrientedCloud, place: Georeference) -> None:
    """A PLY file of the cloud in local coordinates."""
    points = np.empty(len(cloud.xyz), _RECORD)
    for axis, name in enumerate("xyz"):
        points[name] = cloud.xyz[:, axis]
        points[f"n{name}"] = cloud.normals[:, axis]
    for channel, name in enumerate(("red", "green", "blue")):
        points[name] = np.clip(cloud.rgb[:, channel], 0, 1) * 255 + 0.5
    ply.write_vertices(path, points, comments=origin_comments(place))


def write_laz(path: Path, cloud: OrientedCloud, place: Georeference) -> None:
    """A LAZ file of the cloud in map coordinates."""
    laspy = geo_package("laspy")
    header = laspy.LasHeader(point_format=7, version="1.4")
    g = np.array([place.grid_scale, place.grid_scale, 1.0])
    on_map = np.asarray(place.origin) + cloud.xyz * g
    header.offsets = np.floor(on_map.min(0))
    extent = float((on_map.max(0) - header.offsets).max())
    header.scales = np.full(3, max(1 / _STEPS if place.scale is not None else extent * 1e-7, extent / 2**30))
    if place.epsg is not None:
        header.add_crs(geo_package("pyproj").CRS.from_epsg(place.epsg))
    file = laspy.LasData(header)
    file.x, file.y, file.z = on_map.T
    colors = (np.clip(cloud.rgb, 0, 1) * 65535 + 0.5).astype(np.uint16)
    file.red, file.green, file.blue = colors.T
    file.classification = np.ones(len(on_map), np.uint8)  # processed, not classified
    file.return_number = file.number_of_returns = np.ones(len(on_map), np.uint8)  # LAS counts from 1
    with atomic_path(path) as draft:
        file.write(str(draft))


def origin_comments(place: Georeference) -> tuple[str, ...]:
    """Lines for the head of a file in local coordinates."""
    east, north, height = place.origin
    lines = (f"local coordinates, z up, unit {place.unit}",)
    if place.epsg is not None:
        lines += (f"origin in EPSG:{place.epsg}: {east:.6f} {north:.6f} {height:.6f}",)
    return lines
