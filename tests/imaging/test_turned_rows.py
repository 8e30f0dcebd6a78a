"""Images of a camera that turned while their rows were exposed: moved to half time and back, pixel by pixel."""

import cv2
import numpy as np
import pytest
import torch
from jaxtyping import Float
from scipy.spatial.transform import Rotation

from swimm3r.cameras import Cameras, directions, pixel_grid, project
from swimm3r.imaging.turned_rows import (
    at_half_time,
    filmed_pixels,
    half_time_pixels,
    mask_as_filmed,
    mask_at_half_time,
)

WIDTH, HEIGHT = 160, 120
TURN = np.array([0.02, -0.03, 0.015])


def camera(k: float = -0.1) -> Cameras:
    K = torch.tensor([[[150.0, 0, 80], [0, 150, 60], [0, 0, 1]]], dtype=torch.float64)
    distortion = torch.tensor([[k]], dtype=torch.float64)
    return Cameras(K, distortion, torch.eye(4, dtype=torch.float64)[None], WIDTH, HEIGHT, "SIMPLE_RADIAL")


def texture(rays: np.ndarray) -> Float[np.ndarray, "p 3"]:
    """Colors 0..1 of directions, smooth over some pixels."""
    x, y = rays[:, 0] / rays[:, 2], rays[:, 1] / rays[:, 2]
    waves = [np.sin(17 * x + 9 * y), np.cos(13 * y - 5 * x), np.sin(11 * x) * np.cos(8 * y)]
    return 0.5 + 0.4 * np.stack(waves, -1)


def rendered(turn: np.ndarray) -> Float[np.ndarray, "h w 3"]:
    """An image whose rows are exposed while the camera turns: each row through a camera of its own."""
    rays = directions(camera(), pixel_grid(HEIGHT, WIDTH).reshape(1, -1, 2).double())[0].numpy()
    share = (np.arange(HEIGHT) + 0.5) / HEIGHT - 0.5
    rows = Rotation.from_rotvec(np.repeat(share, WIDTH)[:, None] * turn)
    return texture(rows.apply(rays)).reshape(HEIGHT, WIDTH, 3).astype(np.float32)


def test_pixels_of_half_time_are_those_of_the_rows_own_camera():
    xy = torch.tensor([[20.0, 10.0], [80.0, 60.0], [150.0, 110.0]], dtype=torch.float64)
    moved = half_time_pixels(camera(), xy, TURN)
    for filmed, found in zip(xy, moved, strict=True):
        R = Rotation.from_rotvec((filmed[1].item() / HEIGHT - 0.5) * TURN)
        ray = torch.from_numpy(R.apply(directions(camera(), filmed[None, None])[0].numpy()))
        torch.testing.assert_close(found, project(camera(), ray[None])[0][0, 0])
    assert (moved[1] == xy[1]).all() or torch.allclose(moved[1], xy[1], atol=1e-9)  # the middle row is at half time


def test_filmed_pixels_lead_back():
    xy = pixel_grid(HEIGHT, WIDTH).reshape(-1, 2)[::37].double()
    there = half_time_pixels(camera(), xy, TURN)
    assert (there - xy).norm(dim=-1).max() > 1.5
    torch.testing.assert_close(filmed_pixels(camera(), there, TURN), xy, atol=1e-4, rtol=0)


def test_an_image_at_half_time_is_that_of_a_camera_at_rest():
    still, filmed = rendered(np.zeros(3)), rendered(TURN)
    straight = at_half_time(filmed, camera(), TURN)
    inside = mask_at_half_time(np.ones((HEIGHT, WIDTH), bool), camera(), TURN)
    inside = cv2.erode(inside.astype(np.uint8), np.ones((9, 9))) > 0  # beside the border interpolation knows less
    assert inside.mean() > 0.8
    before, after = (np.abs(image - still)[inside].max() for image in (filmed, straight))
    assert after < 0.01 < 0.1 < before


def test_a_camera_that_does_not_turn_changes_nothing():
    image = (255 * rendered(np.zeros(3))).astype(np.uint8)
    np.testing.assert_array_equal(at_half_time(image, camera(), np.zeros(3)), image)
    assert mask_at_half_time(np.ones((HEIGHT, WIDTH), bool), camera(), np.zeros(3)).all()


def test_a_mask_leads_back_to_the_filmed_image():
    usable = np.ones((HEIGHT, WIDTH), bool)
    usable[20:50, 30:70] = False
    straight = mask_at_half_time(usable, camera(), TURN)
    back = mask_as_filmed(straight, camera(), TURN)
    inner = np.s_[10:-10, 10:-10]
    assert (back[inner] != usable[inner]).mean() < 0.01
    assert mask_as_filmed(np.ones((HEIGHT, WIDTH), bool), camera(), TURN).all()


def test_more_than_one_camera_is_refused():
    with pytest.raises(ValueError, match="one camera turns"):
        half_time_pixels(camera()[[0, 0]], torch.zeros(1, 2), TURN)
