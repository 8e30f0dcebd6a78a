"""COLMAP models survive the way to disk and back, and bad ones are refused in the user's words."""

import signal
import subprocess
import sys
from dataclasses import fields, replace
from pathlib import Path

import numpy as np
import pycolmap
import pytest

from swimm3r.errors import InputError
from swimm3r.io.colmap import model as colmap
from swimm3r.io.colmap.integrity import damaged_file
from swimm3r.io.colmap.model import ColmapModel


def _model(lens: str = "OPENCV", cameras: int = 4, points: int = 30, seed: int = 0) -> ColmapModel:
    rng = np.random.default_rng(seed)
    distortion = {"PINHOLE": [], "SIMPLE_RADIAL": [0.02], "OPENCV": [0.1, -0.02, 1e-3, 2e-3]}
    distortion["OPENCV_FISHEYE"] = [0.01, 0.002, -0.001, 3e-4]
    cam2world = np.tile(np.eye(4), (cameras, 1, 1))
    cam2world[:, :3, :3] = np.linalg.qr(rng.normal(size=(cameras, 3, 3)))[0]
    cam2world[:, :3, :3] *= np.linalg.det(cam2world[:, :3, :3])[:, None, None]
    cam2world[:, :3, 3] = rng.normal(size=(cameras, 3))
    seen = rng.random((points, cameras)) < 0.7
    seen[:, :2] = True
    track_point, track_frame = np.nonzero(seen)
    return ColmapModel(
        names=tuple(f"dive b/{i}.jpg" for i in reversed(range(cameras))),  # not alphabetical: order must survive
        model=lens,
        width=640,
        height=480,
        K=np.tile(np.array([[500.0, 0, 321], [0, 500, 239], [0, 0, 1]]), (cameras, 1, 1)),
        distortion=np.tile(np.array(distortion[lens]), (cameras, 1)),
        cam2world=cam2world,
        xyz=rng.normal(size=(points, 3)),
        rgb=rng.integers(0, 256, (points, 3), dtype=np.uint8),
        error=rng.random(points),
        track_point=track_point,
        track_frame=track_frame,
        track_xy=rng.random((len(track_point), 2)) * 400,
    )


def _assert_equal(a: ColmapModel, b: ColmapModel) -> None:
    for field in fields(ColmapModel):
        left, right = getattr(a, field.name), getattr(b, field.name)
        if isinstance(left, np.ndarray):
            np.testing.assert_allclose(left, right, atol=1e-12, err_msg=field.name)
        else:
            assert left == right, field.name


@pytest.mark.parametrize("lens", ["PINHOLE", "SIMPLE_RADIAL", "OPENCV", "OPENCV_FISHEYE"])
def test_what_was_written_is_read_back_in_the_same_order(tmp_path: Path, lens: str) -> None:
    model = _model(lens)
    colmap.write_model(tmp_path / "sparse", model)
    _assert_equal(colmap.read_model(tmp_path / "sparse"), model)


def test_intrinsics_of_each_frame_survive_when_they_differ(tmp_path: Path) -> None:
    model = _model("SIMPLE_RADIAL")
    K = model.K.copy()
    K[2, 0, 0] = K[2, 1, 1] = 470.0
    model = replace(model, K=K)
    colmap.write_model(tmp_path / "sparse", model)
    _assert_equal(colmap.read_model(tmp_path / "sparse"), model)


def test_a_radial_lens_with_two_focal_lengths_becomes_the_same_lens_in_opencv_terms(tmp_path: Path) -> None:
    model = _model("SIMPLE_RADIAL")
    K = model.K.copy()
    K[:, 1, 1] = 480.0
    colmap.write_model(tmp_path / "sparse", replace(model, K=K))
    read = colmap.read_model(tmp_path / "sparse")
    assert read.model == "OPENCV"
    np.testing.assert_array_equal(read.K, K)
    np.testing.assert_array_equal(read.distortion, np.tile([0.02, 0, 0, 0], (4, 1)))


def test_a_model_in_sparse_0_is_found_from_above(tmp_path: Path) -> None:
    model = _model()
    colmap.write_model(tmp_path / "dive" / "sparse" / "0", model)
    for folder in ("dive", "dive/sparse", "dive/sparse/0"):
        _assert_equal(colmap.read_model(tmp_path / folder), model)


def test_writing_again_replaces_the_model_and_leaves_nothing_beside_it(tmp_path: Path) -> None:
    colmap.write_model(tmp_path / "sparse", _model(seed=1))
    colmap.write_model(tmp_path / "sparse", _model(seed=2))
    _assert_equal(colmap.read_model(tmp_path / "sparse"), _model(seed=2))
    assert [path.name for path in tmp_path.iterdir()] == ["sparse"]


def test_a_folder_without_a_model_is_an_input_error(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="no COLMAP model"):
        colmap.read_model(tmp_path)


@pytest.mark.parametrize("name", ["cameras.bin", "images.bin", "points3D.bin", "rigs.bin", "frames.bin"])
@pytest.mark.parametrize("left", [0, 1, 9, -1])
def test_a_truncated_model_is_an_input_error(tmp_path: Path, name: str, left: int) -> None:
    colmap.write_model(tmp_path / "sparse", _model())
    file = tmp_path / "sparse" / name
    file.write_bytes(file.read_bytes()[:left])
    with pytest.raises(InputError, match=f"is not a readable COLMAP model \\({name} is not whole") as caught:
        colmap.read_model(tmp_path / "sparse")
    assert caught.value.exit_code == 3


def test_a_model_with_a_rig_of_two_cameras_is_whole(tmp_path: Path) -> None:
    rig, lens = pycolmap.Rig(rig_id=1), pycolmap.SensorType.CAMERA
    rig.add_ref_sensor(pycolmap.sensor_t(lens, 1))
    rig.add_sensor(pycolmap.sensor_t(lens, 2), pycolmap.Rigid3d())
    model = pycolmap.Reconstruction()
    for camera_id in (1, 2):
        camera = pycolmap.Camera(model="PINHOLE", width=64, height=48, params=[50, 50, 32, 24], camera_id=camera_id)
        model.add_camera(camera)
    model.add_rig(rig)
    model.write_binary(str(tmp_path))
    assert damaged_file(tmp_path) is None


def test_names_that_leave_the_folder_are_refused(tmp_path: Path) -> None:
    model = _model()
    colmap.write_model(tmp_path / "sparse", replace(model, names=("aa/x.jpg", *model.names[1:])))
    images = tmp_path / "sparse" / "images.bin"
    images.write_bytes(images.read_bytes().replace(b"aa/x.jpg", b"../x.jpg"))
    with pytest.raises(InputError, match="outside"):
        colmap.read_model(tmp_path / "sparse")


@pytest.mark.parametrize(
    ("lens", "params", "expected", "distortion"),
    [
        ("SIMPLE_PINHOLE", [500, 320, 240], "PINHOLE", []),
        ("RADIAL", [500, 320, 240, 0.1, 0.02], "OPENCV", [0.1, 0.02, 0, 0]),
    ],
)
def test_lenses_without_a_name_here_are_read_as_the_wider_model(lens, params, expected, distortion) -> None:
    import pycolmap

    out = pycolmap.Reconstruction()
    out.add_camera_with_trivial_rig(pycolmap.Camera(model=lens, width=640, height=480, params=params, camera_id=1))
    out.add_image_with_trivial_frame(pycolmap.Image(name="a.jpg", camera_id=1, image_id=1), pycolmap.Rigid3d())
    read = colmap.from_pycolmap(out)
    assert read.model == expected
    np.testing.assert_array_equal(read.distortion, [distortion])
    np.testing.assert_array_equal(read.K, [[[500, 0, 320], [0, 500, 240], [0, 0, 1]]])


@pytest.mark.parametrize(
    ("second", "message"),
    [(("FOV", 640, [500, 500, 320, 240, 0.9]), "lenses"), (("PINHOLE", 320, [5, 5, 2, 2]), "sizes")],
)
def test_mixed_sizes_and_foreign_lenses_are_input_errors(second, message) -> None:
    import pycolmap

    out = pycolmap.Reconstruction()
    cameras = (("PINHOLE", 640, [500, 500, 320, 240]), second)
    for i, (lens, width, params) in enumerate(cameras, start=1):
        camera = pycolmap.Camera(model=lens, width=width, height=480, params=params, camera_id=i)
        out.add_camera_with_trivial_rig(camera)
        image = pycolmap.Image(name=f"{i}.jpg", camera_id=i, image_id=i)
        out.add_image_with_trivial_frame(image, pycolmap.Rigid3d())
    with pytest.raises(InputError, match=message):
        colmap.from_pycolmap(out)


@pytest.mark.shared
@pytest.mark.parametrize(("clip", "frames"), [("ruie_murky", 17), ("rov_vent_a", 20)])
def test_the_models_of_the_real_clips_project_their_points_where_they_were_seen(shared, clip, frames) -> None:
    model = colmap.read_model(shared / "data" / clip / "sparse" / "0")
    assert len(model.names) == frames
    world2cam = np.linalg.inv(model.cam2world)[model.track_frame]
    xyz = np.einsum("oij,oj->oi", world2cam[:, :3, :3], model.xyz[model.track_point]) + world2cam[:, :3, 3]
    xy = xyz[:, :2] / xyz[:, 2:]
    xy = xy * (1 + model.distortion[0, 0] * (xy**2).sum(-1, keepdims=True))
    pixels = xy * model.K[0, [0, 1], [0, 1]] + model.K[0, :2, 2]
    error = np.linalg.norm(pixels - model.track_xy, axis=1)
    per_point = np.bincount(model.track_point, error) / np.bincount(model.track_point)
    np.testing.assert_allclose(per_point, model.error, atol=1e-3)


def test_a_process_that_is_told_to_end_prints_no_stack_trace() -> None:
    script = (
        "import os, signal\n"
        "from swimm3r.io.colmap.model import silence_log\n"
        "silence_log()\n"
        "os.kill(os.getpid(), signal.SIGTERM)\n"
    )
    ended = subprocess.run([sys.executable, "-c", script], capture_output=True, text=True, timeout=60)
    assert ended.returncode == -signal.SIGTERM
    assert ended.stderr == ""
