"""Cloud and mesh of an analytic seabed, read back by the readers of others."""

from pathlib import Path
from typing import Any

import laspy
import numpy as np
import plyfile
import pytest
import trimesh
from tests.products.conftest import ORIGIN, Seabed, color, height

from swimm3r.errors import InputError
from swimm3r.products import ProductSettings, write_products
from swimm3r.products.record import ProductsRecord
from swimm3r.products.solids.cloud import OrientedCloud, normals
from swimm3r.products.solids.mesh import poisson_mesh, voxel_means
from swimm3r.products.survey import Survey
from swimm3r.progress import silent
from swimm3r.scene.georeference import Georeference

FROM_GLTF = np.array([[1.0, 0, 0], [0, 0, -1], [0, 1, 0]])  # y up to z up
PLACE = Georeference(None, (0.0, 0.0, 0.0), ((1.0, 0.0, 0.0), (0.0, 1.0, 0.0), (0.0, 0.0, 1.0)), None)


@pytest.fixture(scope="module")
def made(seabed: Seabed, tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, ProductsRecord]:
    out = tmp_path_factory.mktemp("solids") / "products"
    return out, write_products(seabed.folder, out, ProductSettings(), silent)


def true_normals(x: np.ndarray, y: np.ndarray) -> np.ndarray:
    step = 1e-5
    east = (height(x + step, y) - height(x - step, y)) / (2 * step)
    north = (height(x, y + step) - height(x, y - step)) / (2 * step)
    found = np.stack([-east, -north, np.ones_like(east)], -1)
    return found / np.linalg.norm(found, axis=-1, keepdims=True)


def test_the_cloud_has_local_coordinates_and_normals_that_face_the_cameras(made: tuple[Path, ProductsRecord]):
    data = plyfile.PlyData.read(str(made[0] / "cloud.ply"))
    points = data["vertex"]
    x, y, z = (np.asarray(points[axis], np.float64) for axis in "xyz")
    np.testing.assert_allclose(z, height(x, y), atol=1e-4)
    found = np.stack([points[name] for name in ("nx", "ny", "nz")], -1)
    angle = np.degrees(np.arccos(np.clip((found * true_normals(x, y)).sum(1), -1, 1)))
    assert np.median(angle) < 2
    assert np.quantile(angle, 0.99) < 20
    assert any("EPSG:32631: 500000.000000 5000000.000000" in line for line in data.comments)


def test_the_laz_cloud_keeps_map_coordinates_in_double_precision(made: tuple[Path, ProductsRecord]):
    cloud: Any = laspy.read(made[0] / "cloud.laz")
    x, y, z = (
        np.asarray(axis, np.float64) - origin for axis, origin in zip((cloud.x, cloud.y, cloud.z), ORIGIN, strict=True)
    )
    np.testing.assert_allclose(z, height(x, y), atol=2e-4)  # 32-bit floats at five million metres step by 0.5
    assert cloud.header.parse_crs().to_epsg() == 32631
    assert (np.asarray(cloud.return_number) == 1).all()
    assert cloud.header.number_of_points_by_return[0] == len(x)
    clear = color(x, y)
    assert np.abs(np.stack([cloud.red, cloud.green, cloud.blue], -1) / 65535 - clear).mean() < 0.01


def test_the_mesh_lies_on_the_seabed_and_ends_where_it_was_not_seen(made: tuple[Path, ProductsRecord]):
    mesh: Any = trimesh.load(made[0] / "mesh.ply", process=False)
    x, y, z = np.asarray(mesh.vertices, np.float64).T
    error = np.abs(z - height(x, y))
    assert np.median(error) < 2e-3
    assert np.quantile(error, 0.95) < 0.015
    assert -1.0 < x.min() < x.max() < 2.0  # Poisson's own surface would be closed
    assert mesh.area == pytest.approx(made[1].area, rel=0.15)
    assert (np.asarray(mesh.vertex_normals)[:, 2] > 0).mean() > 0.99


@pytest.mark.parametrize("name", ["mesh.glb", "mesh.obj"])
def test_the_texture_shows_the_colors_of_the_ground(made: tuple[Path, ProductsRecord], name: str):
    mesh: Any = trimesh.load(made[0] / name, force="mesh", process=False)
    vertices = np.asarray(mesh.vertices, np.float64)
    vertices = vertices @ FROM_GLTF.T if name == "mesh.glb" else vertices
    material = mesh.visual.material
    image = np.asarray((material.baseColorTexture if name == "mesh.glb" else material.image).convert("RGB"), np.float64)
    middle, uv = (np.asarray(values)[np.asarray(mesh.faces)].mean(1) for values in (vertices, mesh.visual.uv))
    rows, columns = image.shape[:2]
    found = image[((1 - uv[:, 1]) * rows).astype(int), (uv[:, 0] * columns).astype(int)] / 255
    error = np.abs(found - color(middle[:, 0], middle[:, 1])).mean(1)
    assert np.median(error) < 0.04
    assert np.quantile(error, 0.9) < 0.12


def test_every_file_is_listed(made: tuple[Path, ProductsRecord]):
    assert {path.name for path in made[0].iterdir()} >= set(made[1].files)
    assert {"cloud.ply", "cloud.laz", "mesh.glb", "mesh.obj", "mesh.mtl", "mesh.png", "mesh.ply"} <= set(made[1].files)


def test_normals_of_a_wall_face_the_cameras_that_saw_it():
    rng = np.random.default_rng(0)
    wall = np.stack([np.zeros(500), rng.uniform(0, 1, 500), rng.uniform(0, 1, 500)], -1)
    found = normals(wall, np.array([[-2.0, 0.5, 0.5]]))
    np.testing.assert_allclose(found, np.tile([-1.0, 0, 0], (500, 1)), atol=1e-9)


def test_cubes_hold_one_mean_point_and_drop_normals_that_contradict():
    xyz = np.array([[0.1, 0.1, 0.1], [0.3, 0.1, 0.1], [5.1, 0.1, 0.1], [5.2, 0.1, 0.1]])
    up, down = [0.0, 0, 1], [0.0, 0, -1]
    thinned = voxel_means(OrientedCloud(xyz, np.array([up, up, up, down]), np.ones((4, 3))), 1.0)
    np.testing.assert_allclose(thinned.xyz, [[0.2, 0.1, 0.1]])


def test_points_that_make_no_surface_are_refused():
    rng = np.random.default_rng(0)
    scattered = OrientedCloud(rng.uniform(0, 100, (30, 3)), np.tile([0.0, 0, 1], (30, 1)), np.ones((30, 3)))
    with pytest.raises(InputError, match="no surface"):
        poisson_mesh(scattered, 0.01, PLACE)


def test_a_run_without_a_cloud_says_so(seabed: Seabed, tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    from swimm3r.products.solids import cloud

    monkeypatch.setattr(cloud, "oriented_cloud", lambda survey: None)
    record = write_products(seabed.folder, tmp_path / "out", ProductSettings(), silent)
    assert isinstance(seabed.survey(), Survey)
    assert any("no dense cloud" in note for note in record.notes)
    assert not (tmp_path / "out" / "cloud.ply").exists()
