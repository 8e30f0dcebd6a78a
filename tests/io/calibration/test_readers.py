"""Calibrations of every format are read as the lens that OpenCV projects with, and others are refused."""

import json
from pathlib import Path

import cv2
import numpy as np
import pytest
import torch

from swimm3r.cameras import Cameras, project
from swimm3r.errors import InputError, Swimm3rError, UsageError
from swimm3r.io.calibration.read import read_calibration, read_calibrations, read_lens

K = np.array([[800.0, 0, 650], [0, 810, 350], [0, 0, 1]])  # center of the first pixel at (0, 0)
RADTAN = [-0.21, 0.06, 0.001, -0.002]
FISHEYE = [0.05, -0.02, 0.004, -0.001]
SIZE = (1280, 720)

KALIBR = """cam0:
  cam_overlaps: []
  camera_model: pinhole
  distortion_coeffs: [{d}]
  distortion_model: {model}
  intrinsics: [800.0, 810.0, 650.0, 350.0]
  resolution: [1280, 720]
  rostopic: /cam0/image_raw
"""
ROS = """image_width: 1280
image_height: 720
camera_name: front
camera_matrix:
  rows: 3
  cols: 3
  data: [800.0, 0.0, 650.0, 0.0, 810.0, 350.0, 0.0, 0.0, 1.0]
distortion_model: {model}
distortion_coefficients:
  rows: 1
  cols: {n}
  data: [{d}]
rectification_matrix:
  rows: 3
  cols: 3
  data: [1, 0, 0, 0, 1, 0, 0, 0, 1]
"""
ECHOED = """header:
  frame_id: front
height: 720
width: 1280
distortion_model: {model}
d: [{d}]
k: [800.0, 0.0, 650.0, 0.0, 810.0, 350.0, 0.0, 0.0, 1.0]
roi: {{x_offset: 0, y_offset: 0, height: 0, width: 0, do_rectify: false}}
---
height: 720
"""
AGISOFT = """<?xml version="1.0" encoding="UTF-8"?>
<calibration>
  <projection>{kind}</projection>
  <width>1280</width>
  <height>720</height>
  <f>810</f>
  <cx>10.5</cx>
  <cy>-9.5</cy>
  <b1>-10</b1>
  {rest}
  <date>2026-01-01T00:00:00Z</date>
</calibration>
"""


def words(values: list[float]) -> str:
    return ", ".join(map(repr, values))


def file_storage(path: Path, distortion: list[float], with_size: bool = True, fisheye: bool = False) -> Path:
    storage = cv2.FileStorage(str(path), cv2.FILE_STORAGE_WRITE)
    if with_size:
        storage.write("image_width", SIZE[0])
        storage.write("image_height", SIZE[1])
    if fisheye:
        storage.write("fisheye_model", 1)
    storage.write("camera_matrix", K)
    storage.write("distortion_coefficients", np.array(distortion)[:, None])
    storage.release()
    return path


def written(path: Path, text: str) -> Path:
    path.write_text(text, encoding="utf-8")
    return path


def nerfstudio(model: str, names: str, values: list[float]) -> str:
    lens = {"w": 1280, "h": 720, "fl_x": 800, "fl_y": 810, "cx": 650.5, "cy": 350.5, "camera_model": model}
    lens |= dict(zip(names.split(), values, strict=True))
    frames = [{"file_path": f"{i}.png", "transform_matrix": np.eye(4).tolist()} for i in range(3)]
    return json.dumps({**lens, "frames": frames})


def radtan_files(folder: Path) -> dict[str, Path]:
    d, colmap = words(RADTAN), " ".join(map(repr, [800.0, 810.0, 650.5, 350.5, *RADTAN]))
    k1, k2, p1, p2 = RADTAN
    named = {"k1": k1, "k2": k2, "p1": p2, "p2": p1}  # Agisoft's p1 is OpenCV's p2
    agisoft = "".join(f"<{name}>{value}</{name}>" for name, value in named.items())
    return {
        "Kalibr": written(folder / "a.txt", KALIBR.format(model="radtan", d=d)),
        "ROS": written(folder / "b.dat", ROS.format(model="plumb_bob", d=d + ", 0.0", n=5)),
        "ROS echoed": written(folder / "c", ECHOED.format(model="rational_polynomial", d=d + ", 0.0" * 4)),
        "OpenCV YAML": file_storage(folder / "d.yml", RADTAN),
        "OpenCV XML": file_storage(folder / "e.xml", [*RADTAN, 0.0]),
        "OpenCV JSON": file_storage(folder / "f.json", RADTAN),
        "COLMAP": written(folder / "g.yaml", f"# Camera list\n1 OPENCV 1280 720 {colmap}\n"),
        "COLMAP line": written(folder / "h", f"OPENCV 1280 720 {colmap.replace(' ', ',')}"),
        "Agisoft": written(folder / "i.txt", AGISOFT.format(kind="frame", rest=agisoft)),
        "nerfstudio": written(folder / "j", nerfstudio("OPENCV", "k1 k2 p1 p2", RADTAN)),
    }


def fisheye_files(folder: Path) -> dict[str, Path]:
    d, colmap = words(FISHEYE), " ".join(map(repr, [800.0, 810.0, 650.5, 350.5, *FISHEYE]))
    agisoft = "".join(f"<k{i}>{value}</k{i}>" for i, value in enumerate(FISHEYE, 1))
    return {
        "Kalibr": written(folder / "a.txt", KALIBR.format(model="equidistant", d=d)),
        "ROS": written(folder / "b.dat", ROS.format(model="equidistant", d=d, n=4)),
        "OpenCV YAML": file_storage(folder / "d.yml", FISHEYE, fisheye=True),
        "COLMAP": written(folder / "g.yaml", f"1 OPENCV_FISHEYE 1280 720 {colmap}\n"),
        "Agisoft": written(folder / "i.txt", AGISOFT.format(kind="fisheye", rest=agisoft)),
        "nerfstudio": written(folder / "j", nerfstudio("OPENCV_FISHEYE", "k1 k2 k3 k4", FISHEYE)),
    }


def directions() -> np.ndarray:
    x, y = np.meshgrid(np.linspace(-0.7, 0.7, 9), np.linspace(-0.4, 0.4, 7))
    return np.stack([x.ravel(), y.ravel(), np.ones(x.size)], -1)


def pixels_of(lens: Cameras) -> np.ndarray:
    return project(lens, torch.from_numpy(directions())[None])[0][0].numpy()


def opencv_pixels(coefficients: list[float], fisheye: bool = False) -> np.ndarray:
    zero, d = np.zeros(3), np.array(coefficients)
    points, to_pixels = directions()[:, None], cv2.fisheye.projectPoints if fisheye else cv2.projectPoints
    return to_pixels(points, zero, zero, K, d)[0][:, 0]


FORMATS = [
    *("Kalibr", "ROS", "ROS echoed", "OpenCV YAML", "OpenCV XML", "OpenCV JSON"),
    *("COLMAP", "COLMAP line", "Agisoft", "nerfstudio"),
]


@pytest.mark.parametrize("kind", FORMATS)
def test_every_format_gives_opencvs_pixels_half_a_pixel_later(kind: str, tmp_path: Path):
    read = read_lens(radtan_files(tmp_path)[kind], *SIZE)
    assert read.camera.model == "OPENCV"
    assert read.error < 1e-6
    np.testing.assert_allclose(pixels_of(read.camera), opencv_pixels(RADTAN) + 0.5, atol=1e-6)


@pytest.mark.parametrize("kind", ["Kalibr", "ROS", "OpenCV YAML", "COLMAP", "Agisoft", "nerfstudio"])
def test_fisheye_lenses_give_the_pixels_of_opencvs_fisheye_model(kind: str, tmp_path: Path):
    lens = read_lens(fisheye_files(tmp_path)[kind], *SIZE).camera
    assert lens.model == "OPENCV_FISHEYE"
    np.testing.assert_allclose(pixels_of(lens), opencv_pixels(FISHEYE, fisheye=True) + 0.5, atol=1e-6)


def test_a_lens_is_scaled_about_the_corner_of_the_image(tmp_path: Path):
    """Half the image: pixel u (center at u + 0.5 of the corner) is at (u + 0.5) / 2."""
    lens = read_lens(radtan_files(tmp_path)["OpenCV YAML"], 640, 360).camera
    np.testing.assert_allclose(pixels_of(lens), (opencv_pixels(RADTAN) + 0.5) / 2, atol=1e-6)


def test_higher_terms_become_the_nearest_lens_and_say_how_near(tmp_path: Path):
    rational = [-0.21, 0.06, 0.001, -0.002, 0.002, 0.003, -0.001, 0.0005]
    read = read_lens(file_storage(tmp_path / "a.yml", rational), *SIZE)
    off = np.abs(pixels_of(read.camera) - (opencv_pixels(rational) + 0.5)).max()
    assert 1e-4 < off <= read.error * 1.05 < 0.5
    with pytest.raises(InputError, match="pixels away from any that is supported"):
        read_lens(file_storage(tmp_path / "b.yml", [*RADTAN, 0.8]), *SIZE)


def test_a_file_without_a_size_needs_one(tmp_path: Path):
    path = file_storage(tmp_path / "a.yml", RADTAN, with_size=False)
    with pytest.raises(UsageError, match="does not say at which image size") as refused:
        read_calibration(path)
    assert "--calibration-size" in refused.value.hint
    np.testing.assert_allclose(
        pixels_of(read_lens(path, 640, 360, size=SIZE).camera), (opencv_pixels(RADTAN) + 0.5) / 2, atol=1e-6
    )
    text = written(tmp_path / "b", "SIMPLE_RADIAL 800,640,360,-0.1")
    assert read_lens(text, *SIZE, size=SIZE).camera.model == "SIMPLE_RADIAL"


def test_a_size_beside_another_one_in_the_file_is_refused(tmp_path: Path):
    with pytest.raises(UsageError, match=r"1280x720, and --calibration-size says 1920x1080"):
        read_calibration(radtan_files(tmp_path)["ROS"], size=(1920, 1080))


@pytest.mark.parametrize("size", [(960, 720), (720, 1280), (1280, 800)])
def test_frames_of_another_shape_are_refused_with_both_sizes(size: tuple[int, int], tmp_path: Path):
    with pytest.raises(InputError, match=f"1280x720, and the prepared frames are {size[0]}x{size[1]}"):
        read_lens(radtan_files(tmp_path)["Kalibr"], *size)


def test_frames_whose_size_was_rounded_are_accepted(tmp_path: Path):
    assert read_lens(radtan_files(tmp_path)["Kalibr"], 855, 481).camera.height == 481


def test_of_several_cameras_one_must_be_named(tmp_path: Path):
    first = KALIBR.format(model="radtan", d=words(RADTAN))
    path = written(tmp_path / "chain.yaml", first + first.replace("cam0", "cam1").replace("800.0", "777.0"))
    with pytest.raises(UsageError, match="holds 2 cameras: cam0, cam1"):
        read_calibration(path)
    with pytest.raises(UsageError, match="no camera cam2, but cam0, cam1"):
        read_calibration(path, "cam2")
    assert read_lens(path, *SIZE, "cam1").camera.K[0, 0, 0] == 777


def test_stereo_matrices_are_two_cameras(tmp_path: Path):
    storage = cv2.FileStorage(str(tmp_path / "stereo.yml"), cv2.FILE_STORAGE_WRITE)
    for i, k1 in ((1, -0.2), (2, -0.1)):
        storage.write(f"M{i}", K)
        storage.write(f"D{i}", np.array([[k1, 0.0, 0.0, 0.0, 0.0]]))
    storage.release()
    found = read_calibrations(tmp_path / "stereo.yml")
    assert [(one.name, one.k[0]) for one in found] == [("1", -0.2), ("2", -0.1)]


def test_sensors_of_a_metashape_project_are_cameras(tmp_path: Path):
    sensor = (
        '<sensor id="{i}" label="GoPro {i}"><calibration type="frame" class="adjusted"><resolution width="1280"'
        ' height="720"/><f>{f}</f><k1>-0.1</k1></calibration></sensor>'
    )
    sensors = "".join(sensor.format(i=i, f=800 + i) for i in range(2))
    path = written(tmp_path / "a", f"<document><chunk><sensors>{sensors}</sensors></chunk></document>")
    assert [one.name for one in read_calibrations(path)] == ["GoPro 0", "GoPro 1"]
    K = read_lens(path, 640, 360, "GoPro 1").camera.K[0]
    assert K.tolist() == [[400.5, 0, 320], [0, 400.5, 180], [0, 0, 1]]


GOOD = KALIBR.format(model="radtan", d=words(RADTAN))


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("", "it is empty"),
        ("time,x,y\n1,2,3\n", "no calibration that is known"),
        ("<gpx><trk/></gpx>", "neither an OpenCV FileStorage nor"),
        (GOOD[:150], "has no intrinsics|no camera matrix|no YAML"),
        (GOOD.replace("  distortion_coeffs", "  other"), "it has no distortion_coeffs"),
        (ROS.format(model="plumb_bob", d="0", n=1).split("distortion_coeff")[0], "no distortion coefficients beside"),
        (GOOD.replace("800.0", ".nan"), "not finite"),
        (GOOD.replace("800.0", "-800.0"), "focal lengths of -800 and 810"),
        (GOOD.replace("650.0, 350.0]", "650.0]"), "3 intrinsics"),
        (GOOD.replace("[1280, 720]", "[1280, -720]"), "images of 1280x-720"),
        (GOOD.replace("[1280, 720]", "[1280, x]"), "something else than numbers"),
        (GOOD.replace("650.0", "2650.0"), "principal point"),
        (GOOD.replace("-0.21", "-21.0"), "distortion is that of a lens"),
        (GOOD.replace("pinhole", "omni"), "lens of the model omni"),
        (GOOD.replace("radtan", "fov"), "lens of the model fov"),
        ("1 THIN_PRISM_FISHEYE 1280 720 800 800 640 360 0 0 0 0 0 0 0 0", "the model THIN_PRISM_FISHEYE"),
        ("1 OPENCV 1280 720 800 800 640 360 0 0 0", "9 parameters|7 parameters|8 are expected"),
        ("1 OPENCV 1280 720 800 nan 640 360 0 0 0 0", "not finite"),
        (AGISOFT.format(kind="spherical", rest=""), "of type spherical"),
        (AGISOFT.format(kind="frame", rest="")[:200], "no XML"),
        (AGISOFT.format(kind="frame", rest="").replace("<f>810</f>", "<fx>810</fx>"), "older Agisoft"),
        ('{"fl_x": 800', "line 1"),
        ('{"fl_x": 800}', "there is no w"),
        (ROS.format(model="plumb_bob", d=words(RADTAN), n=4).replace("800.0", "0.0"), "focal lengths of 0"),
        (ROS.format(model="plumb_bob", d="0.1, 0.2, 0.3", n=3), "3 coefficients"),
        (ECHOED.format(model="plumb_bob", d=words(RADTAN)).replace("width: 0", "width: 64"), "roi"),
    ],
)
def test_files_that_are_no_usable_calibration_are_refused(text: str, message: str, tmp_path: Path):
    with pytest.raises(InputError, match=message) as refused:
        read_lens(written(tmp_path / "lens", text), *SIZE)
    assert refused.value.exit_code == 3


def test_other_things_in_the_place_of_a_file_are_refused(tmp_path: Path):
    (tmp_path / "picture.png").write_bytes(b"\x89PNG\r\n\xff\xfe")
    for path in (tmp_path, tmp_path / "none.yaml", tmp_path / "picture.png"):
        with pytest.raises(Swimm3rError) as refused:
            read_calibrations(path)
        assert refused.value.exit_code == 3
