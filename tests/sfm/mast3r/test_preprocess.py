"""Images reach the network in the published framing, and no pixel loses its way."""

import json
import math
from pathlib import Path

import pytest
import torch

from swimm3r.cameras import Cameras, pixel_grid, project
from swimm3r.sfm.mast3r import preprocess
from swimm3r.sfm.mast3r.preprocess import framing

SIZES = [(1280, 720), (720, 1280), (640, 480), (333, 500), (512, 512), (300, 200)]


def wave(width: int, height: int) -> torch.Tensor:
    """A smooth image whose three channels are different functions of the position, 0..1."""
    x, y = (pixel_grid(height, width) / torch.tensor([width, height])).unbind(-1)
    return torch.stack([x, y, 0.5 + 0.4 * torch.sin(7 * x + 3 * y)], dim=-1)


@pytest.mark.shared
def test_sizes_reproduce_the_reference(shared: Path):
    rows = json.loads((shared / "vectors" / "mast3r" / "preprocess_shapes.json").read_text())["rows"]
    assert len(rows) == 80
    for row in rows:
        f = framing(row["W"], row["H"], row["size"], row["square_ok"])
        assert [f.network_height, f.network_width] == row["out_HW"], row


@pytest.mark.parametrize(("width", "height"), SIZES)
def test_network_image_is_the_center_of_the_resized_image(width: int, height: int):
    f = framing(width, height)
    image = preprocess.to_network(wave(width, height), f)
    assert image.shape == (3, f.network_height, f.network_width)
    # every network pixel shows the place of the image its coordinates say
    xy = preprocess.pixels_to_image(pixel_grid(f.network_height, f.network_width), f)
    x, y = (xy / torch.tensor([width, height])).unbind(-1)
    expected = torch.stack([x, y, 0.5 + 0.4 * torch.sin(7 * x + 3 * y)])
    torch.testing.assert_close((image + 1) / 2, expected, atol=0.012, rtol=0)


@pytest.mark.parametrize(("width", "height"), SIZES)
def test_pixels_and_intrinsics_find_their_way_back(width: int, height: int):
    f = framing(width, height)
    xy = torch.rand(20, 2, generator=torch.Generator().manual_seed(0), dtype=torch.float64) * width
    torch.testing.assert_close(preprocess.pixels_to_image(preprocess.pixels_to_network(xy, f), f), xy)
    K = torch.tensor([[700.0, 0, 310], [0, 690, 250], [0, 0, 1]], dtype=torch.float64)
    torch.testing.assert_close(preprocess.K_to_image(preprocess.K_to_network(K, f), f), K)


def test_intrinsics_and_pixels_are_mapped_alike():
    f = framing(1297, 731)
    K = torch.tensor([[[700.0, 0, 640], [0, 690, 380], [0, 0, 1]]], dtype=torch.float64)
    points = torch.tensor([[[0.3, -0.2, 2.0], [-1.0, 0.4, 3.0]]], dtype=torch.float64)
    pose = torch.eye(4, dtype=torch.float64)[None]
    image = Cameras(K, torch.zeros(1, 0), pose, f.width, f.height)
    network = Cameras(preprocess.K_to_network(K, f), torch.zeros(1, 0), pose, f.network_width, f.network_height)
    expected = preprocess.pixels_to_network(project(image, points)[0], f)
    torch.testing.assert_close(project(network, points)[0], expected)


def test_centerd_camera_stays_centerd():
    f = framing(1280, 720)
    K = preprocess.K_to_network(torch.tensor([[900.0, 0, 640], [0, 900, 360], [0, 0, 1]]), f)
    torch.testing.assert_close(K, torch.tensor([[360.0, 0, 256], [0, 360, 144], [0, 0, 1]]))


def test_network_image_spans_minus_one_to_one():
    f = framing(640, 480)
    for value, expected in ((0.0, -1.0), (1.0, 1.0)):
        image = preprocess.to_network(torch.full((480, 640, 3), value), f)
        torch.testing.assert_close(image, torch.full((3, 384, 512), expected))


def test_image_of_another_size_is_refused():
    with pytest.raises(ValueError, match="images of 640 x 480 pixels, got 480 x 640"):
        preprocess.to_network(torch.zeros(640, 480, 3), framing(640, 480))


def test_sliver_is_refused():
    with pytest.raises(ValueError, match="2000 x 30 pixels is too narrow"):
        framing(2000, 30)


def test_thin_masked_line_survives_the_resize():
    mask = torch.ones(720, 1280, dtype=torch.bool)
    mask[:, 641] = False
    small = preprocess.mask_to_network(mask, framing(1280, 720))
    columns = (~small).all(dim=0).nonzero()[:, 0].tolist()
    assert columns == [256]
    assert small.sum() == small.numel() - 288


def test_wide_image_keeps_its_field_of_view():
    f = framing(1920, 1080)
    K = preprocess.K_to_network(torch.tensor([[1000.0, 0, 960], [0, 1000, 540], [0, 0, 1]]), f)
    assert math.atan(256 / K[0, 0]) == pytest.approx(math.atan(960 / 1000), abs=1e-6)
