"""Clouds come back as they were written; a damaged one says so."""

import numpy as np
import pytest

from swimm3r.errors import InputError
from swimm3r.io.ply import read_points, write_points

XYZ = np.random.default_rng(1).normal(size=(7, 3))
RGB = np.linspace(0, 1, 21).reshape(7, 3)


def test_points_return_in_place_and_color(tmp_path):
    write_points(tmp_path / "a" / "p.ply", XYZ, RGB)
    xyz, rgb = read_points(tmp_path / "a" / "p.ply")
    assert xyz.dtype == rgb.dtype == np.float32
    np.testing.assert_array_equal(xyz, XYZ.astype(np.float32))
    np.testing.assert_allclose(rgb, RGB, atol=0.5 / 255 + 1e-6)
    assert [p.name for p in (tmp_path / "a").iterdir()] == ["p.ply"]


def test_the_file_is_what_other_tools_read(tmp_path):
    """15 bytes a point behind the header, as the format says."""
    write_points(tmp_path / "p.ply", np.array([[1.0, 2.0, 3.0]]), np.array([[1.0, 0.0, 2.0]]))
    head, body = (tmp_path / "p.ply").read_bytes().split(b"end_header\n")
    assert head.startswith(b"ply\nformat binary_little_endian 1.0\nelement vertex 1\nproperty float x\n")
    assert body == np.array([1, 2, 3], "<f4").tobytes() + bytes([255, 0, 255])


def test_an_empty_cloud_is_a_cloud(tmp_path):
    write_points(tmp_path / "p.ply", np.zeros((0, 3)), np.zeros((0, 3)))
    assert read_points(tmp_path / "p.ply")[0].shape == (0, 3)


def test_clouds_of_other_tools_are_read(tmp_path):
    record = np.dtype([("x", "<f8"), ("y", "<f8"), ("z", "<f8"), ("nx", "<f4"), *((c, "u1") for c in "rgb")])
    points = np.zeros(2, record)
    points["z"], points["g"] = [1.5, 2.5], 255
    (tmp_path / "p.ply").write_bytes(
        b"ply\nformat binary_little_endian 1.0\ncomment by hand\nelement vertex 2\nproperty double x\n"
        b"property double y\nproperty double z\nproperty float nx\nproperty uchar red\nproperty uchar green\n"
        b"property uchar blue\nelement face 0\nproperty list uchar int vertex_indices\nend_header\n" + points.tobytes()
    )
    xyz, rgb = read_points(tmp_path / "p.ply")
    np.testing.assert_array_equal(xyz[:, 2], [1.5, 2.5])
    np.testing.assert_array_equal(rgb, [[0, 1, 0], [0, 1, 0]])


@pytest.mark.parametrize("damage", [lambda b: b[:-4], lambda b: b[:20], lambda b: b"text", lambda b: b[4:]])
def test_a_damaged_cloud_names_its_file(tmp_path, damage):
    write_points(tmp_path / "p.ply", XYZ, RGB)
    (tmp_path / "p.ply").write_bytes(damage((tmp_path / "p.ply").read_bytes()))
    with pytest.raises(InputError, match=r"p\.ply"):
        read_points(tmp_path / "p.ply")


def test_a_cloud_without_colors_is_refused(tmp_path):
    (tmp_path / "p.ply").write_bytes(
        b"ply\nformat binary_little_endian 1.0\nelement vertex 0\n"
        b"property float x\nproperty float y\nproperty float z\nend_header\n"
    )
    with pytest.raises(InputError, match="red"):
        read_points(tmp_path / "p.ply")
