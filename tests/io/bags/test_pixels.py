"""Image messages of every encoding give the pixels that were put in; others are refused by name."""

from pathlib import Path
from types import SimpleNamespace

import cv2
import numpy as np
import pytest

from swimm3r.errors import InputError
from swimm3r.io.bags.pixels import compressed_image_of, image_of, is_camera_encoding, is_camera_format

RGB = np.random.default_rng(0).integers(0, 256, (6, 10, 3), dtype=np.uint8)
RGB16 = np.random.default_rng(1).integers(0, 65536, (6, 10, 3), dtype=np.uint16)
ALPHA = np.full((6, 10, 1), 9, np.uint8)


def message(pixels: np.ndarray, encoding: str, pad: int = 0, **changes):
    height, width = pixels.shape[:2]
    rows = np.pad(np.ascontiguousarray(pixels).view(np.uint8).reshape(height, -1), ((0, 0), (0, pad)))
    about = {"height": height, "width": width, "encoding": encoding, "step": rows.shape[1], "data": rows.ravel()}
    return SimpleNamespace(**{**about, "is_bigendian": int(pixels.dtype.byteorder == ">"), **changes})


@pytest.mark.parametrize(
    ("encoding", "pixels", "expected"),
    [
        ("rgb8", RGB, RGB),
        ("bgr8", RGB[..., ::-1], RGB),
        ("8UC3", RGB[..., ::-1], RGB),
        ("rgba8", np.concatenate([RGB, ALPHA], -1), RGB),
        ("bgra8", np.concatenate([RGB[..., ::-1], ALPHA], -1), RGB),
        ("mono8", RGB[..., :1], RGB[..., [0, 0, 0]]),
        ("mono16", RGB16[..., :1], RGB16[..., [0, 0, 0]]),
        ("rgb16", RGB16, RGB16),
        ("rgb16", RGB16.astype(">u2"), RGB16),
        ("bgr16", RGB16[..., ::-1], RGB16),
    ],
)
@pytest.mark.parametrize("pad", [0, 5])
def test_pixels_come_back_bit_by_bit(encoding: str, pixels: np.ndarray, expected: np.ndarray, pad: int):
    found = image_of(message(pixels, encoding, pad - pad % pixels.itemsize))
    assert found.dtype == expected.dtype
    np.testing.assert_array_equal(found, expected)


@pytest.mark.parametrize(("bits", "kind"), [(8, np.uint8), (16, np.uint16)])
@pytest.mark.parametrize("pattern", ["rggb", "bggr", "gbrg", "grbg"])
def test_a_bayer_pattern_of_one_color_gives_that_color(pattern: str, bits: int, kind: type):
    color = dict(zip("rgb", np.array([200, 120, 40]) * (1 if bits == 8 else 257), strict=True))
    values = np.zeros((8, 12), kind)
    for k, letter in enumerate(pattern):
        values[k // 2 :: 2, k % 2 :: 2] = color[letter]
    found = image_of(message(values, f"bayer_{pattern}{bits}"))
    np.testing.assert_array_equal(found, np.broadcast_to(np.array([*color.values()], kind), (8, 12, 3)))


def test_a_smooth_image_survives_its_mosaic():
    y, x = np.mgrid[:48, :64]
    smooth = np.stack([100 + 80 * np.sin(x / 9), 120 + 60 * np.cos(y / 7), 90 + x + y], -1).astype(np.uint8)
    values = smooth[..., 1].copy()
    values[::2, ::2], values[1::2, 1::2] = smooth[::2, ::2, 0], smooth[1::2, 1::2, 2]
    found = image_of(message(values, "bayer_rggb8"))[2:-2, 2:-2].astype(int)
    assert np.abs(found - smooth[2:-2, 2:-2]).mean() < 1.0


def test_both_orders_of_yuv_give_the_color():
    gray = np.full((4, 6), 128, np.uint8)
    for encoding, pixels in (("yuv422", [128, 90]), ("yuv422_yuy2", [90, 128])):
        found = image_of(message(np.tile(np.array(pixels, np.uint8), (4, 6, 1)), encoding))
        assert np.abs(found.astype(int) - round((90 - 16) * 255 / 219)).max() <= 1
        assert found.shape == (*gray.shape, 3)


@pytest.mark.parametrize("suffix", [".png", ".jpg", ".tiff"])
def test_a_compressed_image_is_that_of_its_file(suffix: str, tmp_path: Path):
    smooth = cv2.GaussianBlur(RGB.repeat(8, 0).repeat(8, 1), (0, 0), 6)
    data = cv2.imencode(suffix, smooth[..., ::-1])[1].tobytes()
    found = compressed_image_of(SimpleNamespace(format=f"rgb8; {suffix[1:]} compressed bgr8", data=data), tmp_path)
    assert np.abs(found.astype(int) - smooth).max() <= (6 if suffix == ".jpg" else 0)


def test_a_compressed_mosaic_is_interpolated(tmp_path: Path):
    values = np.zeros((8, 12), np.uint8)
    values[::2, ::2] = 200  # red alone
    data = cv2.imencode(".png", values)[1].tobytes()
    found = compressed_image_of(SimpleNamespace(format="bayer_rggb8; png compressed", data=data), tmp_path)
    np.testing.assert_array_equal(found, np.broadcast_to(np.array([200, 0, 0], np.uint8), (8, 12, 3)))


@pytest.mark.parametrize("encoding", ["32FC1", "16UC1", "bayer_xyzw8", "nonsense", ""])
def test_other_encodings_are_refused_by_name(encoding: str):
    assert not is_camera_encoding(encoding)
    with pytest.raises(ValueError, match=f"encoding '{encoding}'"):
        image_of(message(RGB[..., 0], encoding))


@pytest.mark.parametrize(
    "changes", [{"step": 9}, {"height": 60}, {"width": 0}, {"encoding": "rgb16"}, {"data": np.zeros(0, np.uint8)}]
)
def test_a_size_that_its_data_do_not_have_is_refused(changes: dict):
    with pytest.raises(ValueError, match="do not fit"):
        image_of(message(RGB, **{"encoding": "rgb8", **changes}))


def test_depth_maps_and_video_streams_are_no_images_of_a_camera():
    assert is_camera_format("jpeg")
    assert is_camera_format("bgr8; png compressed bgr8")
    assert not any(map(is_camera_format, ("16UC1; compressedDepth png", "32FC1; compressedDepth", "h264")))


def test_a_damaged_compressed_image_names_its_bag(tmp_path: Path):
    with pytest.raises(InputError, match=r"dive\.bag:/cam"):
        compressed_image_of(SimpleNamespace(format="jpeg", data=b"\xff\xd8\xff broken"), Path("dive.bag:/cam"))
