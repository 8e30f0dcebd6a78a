"""Sizes are judged by the file and the free memory, and nothing is decoded that fits neither."""

import struct
import zlib

import cv2
import numpy as np
import pytest
from PIL import Image

from swimm3r import memory
from swimm3r.errors import InputError
from swimm3r.io.image_header import ImageSizeError, capture_time, read_header
from swimm3r.io.images import read_mask, read_rgb


def png_promising(path, width, height):
    """A PNG whose header promises more than its few bytes hold."""

    def chunk(kind, data):
        return struct.pack(">I", len(data)) + kind + data + struct.pack(">I", zlib.crc32(kind + data))

    header = struct.pack(">IIBBBBB", width, height, 8, 2, 0, 0, 0)
    parts = (chunk(b"IHDR", header), chunk(b"IDAT", zlib.compress(bytes(100))), chunk(b"IEND", b""))
    path.write_bytes(b"\x89PNG\r\n\x1a\n" + b"".join(parts))
    return path


def bmp_promising(path, width, height):
    header = struct.pack("<IiiHHIIiiII", 40, width, height, 1, 24, 0, 0, 0, 0, 0, 0)
    path.write_bytes(b"BM" + struct.pack("<IHHI", 54 + 100, 0, 0, 54) + header + bytes(100))
    return path


@pytest.mark.parametrize("size", [(60000, 60000), (2**31 - 1, 2**31 - 1)])
def test_a_header_that_promises_more_than_the_file_holds_is_refused(tmp_path, size):
    path = png_promising(tmp_path / "bomb.png", *size)
    for read in (read_header, read_rgb, read_mask):
        with pytest.raises(ImageSizeError, match=rf"bomb\.png has {size[0]}x{size[1]} pixels by its header"):
            read(path)


def test_it_is_the_same_for_every_format(tmp_path):
    with pytest.raises(ImageSizeError, match="by its header"):
        read_header(bmp_promising(tmp_path / "bomb.bmp", 60000, 60000))
    jpeg = tmp_path / "bomb.jpg"
    cv2.imwrite(str(jpeg), np.zeros((8, 8, 3), np.uint8))
    data = jpeg.read_bytes()
    at = data.index(b"\xff\xc0") + 5  # height and width in the frame header
    jpeg.write_bytes(data[:at] + struct.pack(">HH", 60000, 60000) + data[at + 4 :])
    with pytest.raises(ImageSizeError, match="by its header"):
        read_header(jpeg)


@pytest.mark.parametrize("suffix", [".png", ".jpg", ".tif", ".bmp"])
def test_pixels_that_the_memory_cannot_hold_are_refused_and_not_decoded(tmp_path, monkeypatch, suffix):
    path = tmp_path / f"mosaic{suffix}"
    Image.fromarray(np.random.default_rng(0).integers(0, 255, (300, 400, 3), np.uint8)).save(path)
    assert read_header(path).decoding_bytes == 400 * 300 * 3 * 3
    monkeypatch.setattr(memory, "available_mb", lambda: 1.0)
    monkeypatch.setattr(cv2, "imdecode", lambda *_: pytest.fail("decoded"))
    for read in (read_header, read_rgb, read_mask):
        with pytest.raises(ImageSizeError, match="400x300 pixels, and decoding them takes"):
            read(path)


def test_a_mosaic_over_pillows_limit_is_read(tmp_path, monkeypatch):
    monkeypatch.setattr(Image, "MAX_IMAGE_PIXELS", 1000)  # Pillow refuses twice as many
    image = np.random.default_rng(0).integers(0, 255, (48, 64, 3), np.uint8)
    for name in ("mosaic.png", "mosaic.tif", "mosaic.bmp"):
        Image.fromarray(image).save(tmp_path / name)
        assert capture_time(tmp_path / name) is None
        np.testing.assert_array_equal(read_rgb(tmp_path / name), image)


def test_what_exhausts_the_memory_after_all_is_an_input_error(tmp_path, monkeypatch):
    path = tmp_path / "a.png"
    Image.fromarray(np.zeros((48, 64, 3), np.uint8)).save(path)

    def exhausted(*_):
        raise MemoryError

    monkeypatch.setattr(cv2, "imdecode", exhausted)
    with pytest.raises(ImageSizeError, match="GB of memory"):
        read_rgb(path)

    def refused(*_):
        raise cv2.error("over the limit of 2^30 pixels")

    monkeypatch.setattr(cv2, "imdecode", refused)
    with pytest.raises(InputError, match="do not decode"):
        read_rgb(path)
