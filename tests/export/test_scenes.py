"""Clouds, data sets, trajectories and depth, opened by trimesh, pycolmap, evo, OpenCV, tifffile and Pillow."""

import json
from pathlib import Path

import cv2
import numpy as np
import pycolmap
import pytest
import tifffile
import trimesh
from evo.tools import file_interface
from PIL import Image
from plyfile import PlyData
from tests.export.conftest import BALANCE, COUNT, HEIGHT, TIMES, WIDTH, cameras

import swimm3r
from swimm3r.errors import InputError, StorageError, UsageError
from swimm3r.export import export_run
from swimm3r.export.settings import (
    FORMATS,
    CamerasSettings,
    ColmapExportSettings,
    DepthSettings,
    FormatName,
    GlbSettings,
    KittiSettings,
    NerfstudioSettings,
    TumSettings,
)
from swimm3r.io.cameras_json import read_cameras
from swimm3r.io.depth import read_depth
from swimm3r.io.imports.read import read_foreign

WITHOUT_A_MAP: tuple[FormatName, ...] = (
    "glb",
    "colmap",
    "nerfstudio",
    "tum",
    "kitti",
    "rosbag",
    "rosbag2",
    "depth",
    "cameras",
)
FOLDERS = ("colmap", "nerfstudio", "rosbag2", "depth")


@pytest.fixture(scope="module")
def rec(sfm_run: Path) -> swimm3r.Reconstruction:
    return swimm3r.load_reconstruction(sfm_run / "sfm")


@pytest.mark.parametrize("colors", ["shown", "physical", "raw"])
def test_a_glb_is_read_by_trimesh(colors, sfm_run: Path, rec: swimm3r.Reconstruction, tmp_path: Path):
    export_run(sfm_run, tmp_path / "p.glb", GlbSettings(colors=colors))
    scene = trimesh.load_scene(tmp_path / "p.glb")
    (points,) = scene.geometry.values()
    (node,) = scene.graph.nodes_geometry
    assert rec.cloud is not None
    np.testing.assert_array_equal(np.asarray(points.vertices, np.float32), rec.cloud.xyz.numpy())
    np.testing.assert_allclose(scene.graph[node][0], np.diag([1, -1, -1, 1]), atol=1e-12)  # y up
    stored = {"shown": rec.cloud.shown(BALANCE), "physical": rec.cloud.restored, "raw": rec.cloud.raw}[colors].numpy()
    linear = np.where(stored <= 0.04045, stored / 12.92, ((stored + 0.055) / 1.055) ** 2.4)  # as glTF wants them
    assert np.abs(np.asarray(points.colors)[:, :3] / 255 - linear).max() < 1.01 / 255  # trimesh keeps 8 bits


def test_a_glb_of_fewer_points_says_so(sfm_run: Path, tmp_path: Path):
    done = export_run(sfm_run, tmp_path / "p.glb", GlbSettings(point_limit=100))
    assert "100 of 500 points" in str(done)
    (points,) = trimesh.load_scene(tmp_path / "p.glb").geometry.values()
    assert len(points.vertices) == 100


@pytest.mark.parametrize("text", [False, True])
def test_a_colmap_data_set_is_read_by_colmap(text: bool, sfm_run: Path, rec, tmp_path: Path):
    export_run(sfm_run, tmp_path / "c", ColmapExportSettings(text=text))
    assert (tmp_path / "c" / "sparse" / "0" / f"images.{'txt' if text else 'bin'}").is_file()
    model = pycolmap.Reconstruction(str(tmp_path / "c" / "sparse" / "0"))
    placed = cameras()
    for image in model.images.values():
        i = rec.names.index(image.name)
        with Image.open(tmp_path / "c" / "images" / image.name) as opened:
            assert opened.size == (WIDTH, HEIGHT)
        inverse = np.linalg.inv(placed.cam2world[i].numpy())
        np.testing.assert_allclose(image.cam_from_world().matrix(), inverse[:3], atol=1e-9)
        for seen in image.points2D:  # COLMAP's own projection of its point lands on the observation
            there = image.project_point(model.points3D[seen.point3D_id].xyz)
            np.testing.assert_allclose(there, seen.xy, atol=1e-4)
    assert len(model.images) == COUNT
    assert len(model.points3D) == 30


def test_nerfstudio_sees_the_points_where_colmap_sees_them(sfm_run: Path, rec, tmp_path: Path):
    """By nerfstudio's documented conventions: OpenGL cameras in the world that `applied_transform` leads to."""
    export_run(sfm_run, tmp_path / "n", NerfstudioSettings())
    export_run(sfm_run, tmp_path / "c", ColmapExportSettings())
    document = json.loads((tmp_path / "n" / "transforms.json").read_text())
    cloud = PlyData.read(tmp_path / "n" / document["ply_file_path"])["vertex"]
    xyz = np.stack([cloud[axis] for axis in "xyz"], -1).astype(float)
    model = pycolmap.Reconstruction(str(tmp_path / "c" / "sparse" / "0"))
    by_name = {image.name: image for image in model.images.values()}
    lens = pycolmap.Camera(
        model=document["camera_model"], width=document["w"], height=document["h"],
        params=[document[key] for key in ("fl_x", "fl_y", "cx", "cy", "k1", "k2", "p1", "p2")],
    )  # fmt: skip
    points = np.stack([model.points3D[i].xyz for i in sorted(model.point3D_ids())])
    applied = np.array(document["applied_transform"])
    np.testing.assert_allclose(points @ applied[:, :3].T + applied[:, 3], xyz, atol=1e-5)
    assert np.linalg.det(applied[:, :3]) == pytest.approx(1)
    for frame in document["frames"]:
        assert (tmp_path / "n" / frame["file_path"]).is_file()
        seen = (xyz - np.array(frame["transform_matrix"])[:3, 3]) @ np.array(frame["transform_matrix"])[:3, :3]
        assert (seen[:, 2] < 0).all()  # OpenGL looks along -z
        image = by_name[frame["file_path"].removeprefix("images/")]
        theirs, ours = np.stack([image.project_point(point) for point in points]), lens.img_from_cam(seen * [1, -1, -1])
        assert ours is not None
        np.testing.assert_allclose(ours, theirs, atol=1e-3)


def test_the_nerfstudio_data_set_comes_back_through_the_importer(sfm_run: Path, rec, tmp_path: Path):
    export_run(sfm_run, tmp_path / "n", NerfstudioSettings(with_images="none"))
    again = read_foreign(tmp_path / "n" / "transforms.json").model
    np.testing.assert_allclose(again.cam2world, rec.cameras.cam2world.numpy(), atol=1e-12)
    np.testing.assert_allclose(again.xyz, rec.points.xyz.numpy(), atol=1e-5)
    assert not (tmp_path / "n" / "images").exists()


def test_restored_images_stand_in_for_those_as_filmed(sfm_run: Path, tmp_path: Path):
    for format in (ColmapExportSettings(with_images="restored"), NerfstudioSettings(with_images="restored")):
        folder = tmp_path / type(format).__name__
        export_run(sfm_run, folder, format)
        for i in range(COUNT):
            with Image.open(folder / "images" / "deck" / f"{i:04d}.png") as opened:
                assert opened.getpixel((3, 3)) == (40 * i,) * 3


def test_a_tum_trajectory_is_read_by_evo(sfm_run: Path, tmp_path: Path):
    export_run(sfm_run, tmp_path / "t.txt", TumSettings())
    found = file_interface.read_tum_trajectory_file(str(tmp_path / "t.txt"))
    np.testing.assert_allclose(found.timestamps, TIMES)
    np.testing.assert_allclose(np.stack(found.poses_se3), cameras().cam2world.numpy(), atol=1e-7)


def test_a_kitti_trajectory_is_read_by_evo_and_its_times_lie_beside_it(sfm_run: Path, tmp_path: Path):
    export_run(sfm_run, tmp_path / "k.txt", KittiSettings())
    found = file_interface.read_kitti_poses_file(str(tmp_path / "k.txt"))
    np.testing.assert_allclose(np.stack(found.poses_se3), cameras().cam2world.numpy(), atol=1e-8)
    np.testing.assert_allclose(np.loadtxt(tmp_path / "k_times.txt"), TIMES)


def test_refined_poses_are_written_where_there_are_any(wall_run: Path, tmp_path: Path):
    moved = cameras()
    moved.cam2world[:, 0, 3] += 1
    with pytest.raises(InputError, match="no poses of its own"):
        export_run(wall_run, tmp_path / "t.txt", TumSettings(refined=True))
    names = tuple(f"deck/{i:04d}.png" for i in range(COUNT))
    moved.save(wall_run / "splat" / "cameras.json", names, TIMES)
    try:
        export_run(wall_run, tmp_path / "c.json", CamerasSettings(refined=True))
    finally:
        (wall_run / "splat" / "cameras.json").unlink()
    table = read_cameras(tmp_path / "c.json")
    np.testing.assert_allclose(table.cam2world, moved.cam2world.numpy(), atol=1e-12)
    assert table.times == TIMES


def test_cameras_are_plain_numbers_with_times(sfm_run: Path, tmp_path: Path):
    export_run(sfm_run, tmp_path / "c.json", CamerasSettings())
    document = json.loads((tmp_path / "c.json").read_text())
    assert [frame["time"] for frame in document["frames"]] == list(TIMES)
    assert document["units"] == "metres"
    np.testing.assert_allclose([frame["c2w"] for frame in document["frames"]], cameras().cam2world.numpy())


def test_depth_in_png_has_the_unit_that_its_json_says(sfm_run: Path, rec, tmp_path: Path):
    export_run(sfm_run, tmp_path / "d", DepthSettings())
    about = json.loads((tmp_path / "d" / "depth.json").read_text())
    assert (about["kind"], about["unit"], about["level"], about["unknown"]) == ("z_depth", "metres", 0.001, 0)
    for name in rec.names:
        path = tmp_path / "d" / about["files"][name]
        stored = cv2.imread(str(path), cv2.IMREAD_UNCHANGED)
        assert stored is not None
        with Image.open(path) as opened:
            assert (np.asarray(opened) == stored).all()
        assert stored.dtype == np.uint16
        z = rec.depth[name].z_depth.numpy()
        assert ((stored == 0) == (z == 0)).all()
        assert np.abs(stored * about["level"] - z).max() <= 0.0005 + 1e-6
        np.testing.assert_allclose(read_depth(path), stored / 1000, rtol=1e-6)


def test_depth_in_tiff_is_the_depth_itself(sfm_run: Path, rec, tmp_path: Path):
    export_run(sfm_run, tmp_path / "d", DepthSettings(type="tiff"))
    for name in rec.names:
        path = (tmp_path / "d" / name).with_suffix(".tif")
        z = rec.depth[name].z_depth.numpy()
        assert (tifffile.imread(path) == z).all()
        stored = cv2.imread(str(path), cv2.IMREAD_UNCHANGED)
        assert stored is not None
        assert (stored == z).all()
        with Image.open(path) as opened:
            assert (np.asarray(opened) == z).all()


@pytest.mark.parametrize("format", WITHOUT_A_MAP)
def test_a_second_export_replaces_its_own_file_and_no_other(format: FormatName, sfm_run: Path, tmp_path: Path):
    path = tmp_path / "out"
    export_run(sfm_run, path, FORMATS[format])
    if format in FOLDERS:
        with pytest.raises(StorageError, match="other things lie in it"):
            export_run(sfm_run, path, FORMATS[format])
        return
    export_run(sfm_run, path, FORMATS[format])
    path.write_text("1 2 my own notes\n")
    with pytest.raises(UsageError, match="exists and is no"):
        export_run(sfm_run, path, FORMATS[format])
    assert path.read_text() == "1 2 my own notes\n"


def test_a_list_beside_a_kitti_trajectory_is_not_replaced(sfm_run: Path, tmp_path: Path):
    (tmp_path / "k_times.txt").write_text("shopping\n")
    with pytest.raises(UsageError, match="no list of times"):
        export_run(sfm_run, tmp_path / "k.txt", KittiSettings())
    assert not (tmp_path / "k.txt").exists()


def test_without_a_place_given_an_export_goes_into_the_run(wall_run: Path):
    for format, settings in FORMATS.items():
        done = export_run(str(wall_run), None, settings)
        assert done.path == wall_run / settings.file_name, format
        assert done.bytes > 0
