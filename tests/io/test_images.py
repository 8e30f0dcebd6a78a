"""Images keep their bits, stand upright, and say which file is broken."""

import base64
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
import tifffile
from PIL import Image

from swimm3r.errors import InputError
from swimm3r.io.images import image_size, jpeg_uri, read_mask, read_rgb, write_rgb

GRADIENT = np.stack(np.meshgrid(np.arange(24) * 10, np.arange(16) * 15), -1).astype(np.uint8)
RGB = np.concatenate([GRADIENT, np.full((16, 24, 1), 77, np.uint8)], -1)
RGB16 = RGB.astype(np.uint16) * 257 + 3


def stored_with(path: Path, array: np.ndarray) -> Path:
    """Written by OpenCV, which takes BGR(A)."""
    order = [2, 1, 0, 3][: array.shape[2]] if array.ndim == 3 else slice(None)
    assert cv2.imwrite(str(path), array[..., order] if array.ndim == 3 else array)
    return path


@pytest.mark.parametrize("image", [RGB, RGB16], ids=["8 bit", "16 bit"])
@pytest.mark.parametrize("suffix", [".png", ".tiff"])
def test_eight_and_sixteen_bits_survive(tmp_path, image, suffix):
    read = read_rgb(stored_with(tmp_path / f"p{suffix}", image))
    assert read.dtype == image.dtype
    np.testing.assert_array_equal(read, image)


@pytest.mark.parametrize("compression", [None, "zlib"])
@pytest.mark.parametrize("planar", ["contig", "separate"])
def test_tiff_layouts_read_alike(tmp_path, compression, planar):
    arrangement = np.moveaxis(RGB16, -1, 0) if planar == "separate" else RGB16
    tifffile.imwrite(tmp_path / "p.tif", arrangement, photometric="rgb", planarconfig=planar, compression=compression)
    np.testing.assert_array_equal(read_rgb(tmp_path / "p.tif"), RGB16)


def test_lzw_tiff_reads_with_all_its_bits(tmp_path):
    assert cv2.imwrite(str(tmp_path / "p.tif"), RGB16[..., ::-1], [cv2.IMWRITE_TIFF_COMPRESSION, 5])
    with tifffile.TiffFile(tmp_path / "p.tif") as tiff:
        assert tiff.pages[0].compression == 5
    np.testing.assert_array_equal(read_rgb(tmp_path / "p.tif"), RGB16)


@pytest.mark.parametrize("scale", [1, 255, 65535])
def test_float_tiff_becomes_sixteen_bits_whatever_its_scale(tmp_path, scale):
    unit = np.linspace(0, 1, 16 * 24 * 3, dtype=np.float32).reshape(16, 24, 3)
    tifffile.imwrite(tmp_path / "p.tif", unit * scale, photometric="rgb")
    read = read_rgb(tmp_path / "p.tif")
    assert read.dtype == np.uint16
    np.testing.assert_allclose(read / 65535, unit, atol=1 / 65535)


def test_half_floats_keep_their_brightest_values(tmp_path):
    unit = np.linspace(0, 1, 16 * 24 * 3, dtype=np.float16).reshape(16, 24, 3)
    tifffile.imwrite(tmp_path / "p.tif", unit, photometric="rgb")
    found = read_rgb(tmp_path / "p.tif")
    np.testing.assert_allclose(found / 65535, unit.astype(np.float64), atol=1e-5)


@pytest.mark.parametrize("mode", ["CMYK", "YCbCr"])
def test_tiff_of_other_colors_becomes_rgb(tmp_path, mode):
    plain = np.full((16, 24, 3), (200, 120, 40), np.uint8)
    Image.fromarray(plain).convert(mode).save(tmp_path / "p.tif")
    np.testing.assert_allclose(read_rgb(tmp_path / "p.tif").astype(int), plain, atol=3)


def test_float_tiff_with_holes_is_refused(tmp_path):
    tifffile.imwrite(tmp_path / "p.tif", np.full((4, 4, 3), np.nan, np.float32), photometric="rgb")
    with pytest.raises(InputError, match=r"p\.tif .* not finite"):
        read_rgb(tmp_path / "p.tif")


@pytest.mark.parametrize("suffix", [".png", ".tiff", ".bmp"])
def test_gray_becomes_three_equal_channels(tmp_path, suffix):
    read = read_rgb(stored_with(tmp_path / f"p{suffix}", RGB[..., 0]))
    np.testing.assert_array_equal(read, RGB[..., [0, 0, 0]])


def test_alpha_is_dropped_and_not_mixed_in(tmp_path):
    alpha = np.full((16, 24, 1), 9, np.uint8)
    read = read_rgb(stored_with(tmp_path / "p.png", np.concatenate([RGB, alpha], -1)))
    np.testing.assert_array_equal(read, RGB)
    Image.fromarray(np.concatenate([RGB[..., :1], alpha], -1), "LA").save(tmp_path / "la.png")
    np.testing.assert_array_equal(read_rgb(tmp_path / "la.png"), RGB[..., [0, 0, 0]])


def test_palette_images_show_their_colors(tmp_path):
    Image.fromarray(RGB).quantize(64).save(tmp_path / "p.png")
    assert np.abs(read_rgb(tmp_path / "p.png").astype(int) - RGB).mean() < 20


@pytest.mark.parametrize("orientation", range(1, 9))
@pytest.mark.parametrize("suffix", [".png", ".jpg", ".tif", "lzw.tif"])
def test_every_orientation_stands_upright(tmp_path, orientation, suffix):
    path = tmp_path / f"p{suffix}"
    upright = np.zeros((32, 48, 3), np.uint8)
    upright[:16, :24], upright[:16, 24:], upright[16:, :24] = (250, 0, 0), (0, 250, 0), (0, 0, 250)
    undo = {1: 1, 2: 2, 3: 3, 4: 4, 5: 5, 6: 8, 7: 7, 8: 6}[orientation]  # the inverse of each orientation
    methods = {2: Image.Transpose.FLIP_LEFT_RIGHT, 3: Image.Transpose.ROTATE_180, 4: Image.Transpose.FLIP_TOP_BOTTOM}
    methods |= {5: Image.Transpose.TRANSPOSE, 6: Image.Transpose.ROTATE_270, 7: Image.Transpose.TRANSVERSE}
    methods |= {8: Image.Transpose.ROTATE_90}
    sensor = Image.fromarray(upright) if undo == 1 else Image.fromarray(upright).transpose(methods[undo])
    exif = Image.Exif()
    exif[274] = orientation
    if suffix == ".tif":
        tifffile.imwrite(path, np.asarray(sensor), photometric="rgb", extratags=[(274, "H", 1, orientation, True)])
    elif suffix == "lzw.tif":
        sensor.save(path, compression="tiff_lzw", tiffinfo={274: orientation})
    else:
        options: dict[str, Any] = {"quality": 100, "subsampling": 0} if suffix == ".jpg" else {}
        sensor.save(path, exif=exif, **options)
    read = read_rgb(path)
    assert image_size(path) == (48, 32) == read.shape[1::-1]
    assert np.abs(read.astype(int) - upright).max() < 10


def test_what_is_written_is_read_back(tmp_path):
    for image in (RGB, RGB16):
        write_rgb(tmp_path / "deep" / "p.png", image)
        np.testing.assert_array_equal(read_rgb(tmp_path / "deep" / "p.png"), image)
    write_rgb(tmp_path / "f.png", RGB / 255.0)
    np.testing.assert_array_equal(read_rgb(tmp_path / "f.png"), RGB)
    write_rgb(tmp_path / "f.png", np.full((2, 2, 3), [-1.0, 0.5, 9.0]))
    np.testing.assert_array_equal(read_rgb(tmp_path / "f.png")[0, 0], [0, 128, 255])


def test_only_png_is_written(tmp_path):
    with pytest.raises(ValueError, match="PNG"):
        write_rgb(tmp_path / "p.jpg", RGB)
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize("suffix", [".png", ".jpg", ".tiff", ".bmp"])
def test_a_cut_off_image_names_its_file(tmp_path, suffix):
    noise = np.random.default_rng(0).integers(0, 255, (64, 64, 3), dtype=np.uint8)
    path = stored_with(tmp_path / f"broken{suffix}", noise)
    path.write_bytes(path.read_bytes()[: path.stat().st_size * 2 // 3])
    with pytest.raises(InputError, match="broken"):
        read_rgb(path)


@pytest.mark.parametrize("content", [b"", b"a letter to a diver", b"%PDF-1.7 ...", b"II*\x00\x08\x00"])
def test_what_is_no_image_is_refused_by_name(tmp_path, content):
    path = tmp_path / "letter.jpg"
    path.write_bytes(content)
    for read in (read_rgb, read_mask, image_size):
        with pytest.raises(InputError, match=r"letter\.jpg"):
            read(path)


def test_a_missing_image_is_refused_by_name(tmp_path):
    with pytest.raises(InputError, match=r"none\.png"):
        read_rgb(tmp_path / "none.png")


def test_masks_are_usable_where_not_zero(tmp_path):
    usable = RGB[..., 0] > 100
    for name, stored in {
        "bool.png": usable.astype(np.uint8) * 255,
        "ones.png": usable.astype(np.uint8),
        "deep.png": usable.astype(np.uint16),
        "color.png": np.repeat(usable[..., None], 3, 2).astype(np.uint8) * [0, 0, 255],
        "alpha.png": np.dstack([usable * 255, usable * 255, usable * 255, np.full(usable.shape, 255)]),
    }.items():
        kept = stored if stored.dtype == np.uint16 else stored.astype(np.uint8)
        np.testing.assert_array_equal(read_mask(stored_with(tmp_path / name, kept)), usable)
    Image.fromarray(usable).save(tmp_path / "bit.png")
    np.testing.assert_array_equal(read_mask(tmp_path / "bit.png"), usable)


def test_sixteen_bit_lzw_tiff_stands_upright(tmp_path):
    Image.fromarray(RGB16[..., 0]).save(tmp_path / "p.tif", compression="tiff_lzw", tiffinfo={274: 6})
    read = read_rgb(tmp_path / "p.tif")
    np.testing.assert_array_equal(read, np.rot90(RGB16[..., [0, 0, 0]], -1))


def test_an_image_in_a_page_is_its_own_data_scaled_to_fit():
    image = np.zeros((300, 800, 3), np.uint8)
    image[..., 0] = 200
    uri = jpeg_uri(image, long_side=400)
    stored = cv2.imdecode(np.frombuffer(base64.b64decode(uri.split(",")[1]), np.uint8), cv2.IMREAD_COLOR)
    assert stored.shape == (150, 400, 3)
    assert abs(int(stored[70, 200, 2]) - 200) <= 2  # BGR
