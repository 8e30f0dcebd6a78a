"""A pinhole camera's image, masks and pixels, taken from those of a lens with distortion."""

from dataclasses import replace

import pytest
import torch

from swimm3r.cameras import Cameras, image_directions, pixel_grid
from swimm3r.imaging.undistortion import (
    covering_pinholes,
    distorted_pixels,
    nearest_pixels,
    pinhole_grid,
    shown_pixels,
    undistorted,
    undistorted_matches,
    undistorted_pixels,
)

MODELS = [
    ("OPENCV", [-0.25, 0.05, 0.001, -0.002]),
    ("OPENCV_FISHEYE", [0.05, -0.01, 0.0, 0.0]),
    ("OPENCV_FISHEYE", [0.0, 0.0, 0.0, 0.0]),
    ("SIMPLE_RADIAL", [-0.1]),
]


def lens(width: int = 96, height: int = 64, k: float = -0.15) -> Cameras:
    K = torch.tensor([[[70.0, 0, 49], [0, 70, 31], [0, 0, 1]]], dtype=torch.float64)
    pose = torch.eye(4, dtype=torch.float64)[None]
    return Cameras(K, torch.tensor([[k]], dtype=torch.float64), pose, width, height, "SIMPLE_RADIAL")


def scenery(camera: Cameras) -> torch.Tensor:
    """A smooth pattern at infinity, as a camera sees it."""
    x, y, _ = image_directions(camera).float().unbind(-1)
    return torch.stack(
        [0.5 + 0.4 * torch.sin(4 * x + y), 0.5 + 0.4 * torch.cos(3 * y), 0.5 + 0.3 * torch.sin(5 * x)], -1
    )


@pytest.mark.parametrize("long_side", [0, 48])
def test_an_undistorted_image_shows_what_a_pinhole_camera_would(long_side: int):
    camera = lens()
    canvas = camera.pinhole(long_side)
    assert max(canvas.width, canvas.height) == (long_side or 96)
    got, seen = undistorted(scenery(camera), torch.ones(64, 96, dtype=torch.bool), camera, canvas)
    assert seen.double().mean() > 0.95
    inner = seen[2:-2, 2:-2]
    error = (got - scenery(canvas))[2:-2, 2:-2][inner].abs()
    assert error.max() < (0.02 if long_side else 0.005)


def test_an_image_without_distortion_keeps_its_bits():
    camera = replace(lens(), distortion=torch.zeros(1, 1, dtype=torch.float64))
    image = torch.rand(64, 96, 3)
    got, seen = undistorted(image, torch.ones(64, 96, dtype=torch.bool), camera, camera.pinhole())
    assert torch.equal(got, image)
    assert seen.all()


def test_what_the_lens_did_not_see_is_not_seen():
    """A pincushion lens's image does not reach the corners of its pinhole canvas."""
    camera = lens(k=0.3)
    _, seen = undistorted(scenery(camera), torch.ones(64, 96, dtype=torch.bool), camera, camera.pinhole())
    assert not seen[0, 0]
    assert seen[32, 48]


def test_a_mask_is_undistorted_with_its_image():
    camera = lens()
    mask = torch.ones(64, 96, dtype=torch.bool)
    mask[:, :48] = False
    _, seen = undistorted(scenery(camera), mask, camera, camera.pinhole())
    assert not seen[:, :46].any()
    assert seen[20:40, 52:80].all()


def of_model(model: str, parameters: list[float]) -> Cameras:
    K = torch.tensor([[[110.0, 0, 82], [0, 112, 59], [0, 0, 1]]], dtype=torch.float64)
    pose = torch.eye(4, dtype=torch.float64)[None]
    return Cameras(K, torch.tensor([parameters], dtype=torch.float64), pose, 160, 120, model)


@pytest.mark.parametrize(("model", "parameters"), MODELS)
def test_every_pixel_shows_what_the_lens_saw_along_its_ray(model: str, parameters: list[float]):
    camera = of_model(model, parameters)
    # an image whose value at a pixel is the pixel: undistorted, it says where each pinhole pixel was seen
    image, everywhere = pixel_grid(120, 160), torch.ones(120, 160, dtype=torch.bool)
    image = torch.cat([image, torch.zeros(120, 160, 1)], dim=-1)
    flat, seen = undistorted(image, everywhere, camera, camera.pinhole())
    assert seen[40:80, 50:110].all()
    expected = distorted_pixels(camera, pixel_grid(120, 160))
    off = (flat[..., :2].double() - expected)[seen].abs()
    assert off.max() < 1 / 60  # OpenCV interpolates in steps of 1/32 pixel


@pytest.mark.parametrize(("model", "parameters"), MODELS)
def test_pixels_go_to_the_pinhole_image_and_back(model: str, parameters: list[float]):
    camera = of_model(model, parameters)
    xy = pixel_grid(120, 160)[20:100:9, 30:130:9].reshape(-1, 2).double()
    torch.testing.assert_close(distorted_pixels(camera, undistorted_pixels(camera, xy)), xy, atol=1e-6, rtol=0)


def test_matches_of_several_cameras_are_undistorted_each_by_its_own():
    one, other = lens(k=-0.15), lens(k=0.1)
    both = replace(
        one,
        K=torch.cat([one.K, other.K]),
        distortion=torch.cat([one.distortion, other.distortion]),
        cam2world=torch.cat([one.cam2world, other.cam2world]),
    )
    xy = torch.tensor([[10.0, 12.0], [10.0, 12.0], [70.0, 50.0]])
    straight = undistorted_matches(both, torch.tensor([0, 1, 1]), xy, K=2 * both.K)
    expected = [
        undistorted_pixels(camera, p[None], 2 * one.K[0]) for camera, p in zip((one, other, other), xy, strict=True)
    ]
    torch.testing.assert_close(straight, torch.cat(expected))
    assert not torch.allclose(straight[0], straight[1])


def test_the_nearest_pixel_of_the_frame_is_named_by_row_and_column():
    camera = lens(k=0.0)
    row, column = nearest_pixels(camera, camera.pinhole())
    assert torch.equal(row[:, 5], torch.arange(64))
    assert torch.equal(column[7], torch.arange(96))


@pytest.mark.parametrize("k", [-0.15, 0.3])
def test_a_covering_pinhole_image_has_a_place_for_every_pixel_of_the_frame(k: float):
    camera = lens(k=k)
    pinhole = covering_pinholes(camera, 96)
    assert pinhole.width % 2 == 0
    assert pinhole.height % 2 == 0
    column, row = (torch.from_numpy(a).reshape(64, 96) for a in pinhole_grid(camera, pinhole))
    assert column.min() > -0.5
    assert row.min() > -0.5
    assert column.max() < pinhole.width - 0.5
    assert row.max() < pinhole.height - 0.5
    inside = shown_pixels(camera, pinhole)[row[9, 9].round().long(), column[9, 9].round().long()]
    assert bool(inside)


def test_without_distortion_nothing_of_the_covering_image_is_missing():
    camera = lens(k=0.0)
    assert shown_pixels(camera, covering_pinholes(camera, 48)).all()
