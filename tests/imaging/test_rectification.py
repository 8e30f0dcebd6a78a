"""Images of a lens that no program knows, as a pinhole camera sees them."""

import numpy as np
import pytest
import torch

from swimm3r.cameras import DISTORTION_PARAMETERS, EXPONENTS, Cameras, directions, image_directions
from swimm3r.imaging.rectification import Rectification, from_key, rectification_of

SIZE = 160, 120


def stretching_lens(width: int = SIZE[0], height: int = SIZE[1], stretch: float = 0.4) -> Cameras:
    """A lens in pixels 1.4 times as wide as high, that stretches to the sides and presses together up and down."""
    bend = torch.zeros(1, len(DISTORTION_PARAMETERS["POLYNOMIAL"]), dtype=torch.float64)
    bend[0, EXPONENTS.index((3, 0))] = stretch
    bend[0, len(EXPONENTS) + EXPONENTS.index((0, 3))] = -0.2
    K = torch.tensor([[[0.875 * width, 0, 0.53 * width], [0, 0.83 * height, 0.48 * height], [0, 0, 1]]]).double()
    return Cameras(K, bend, torch.eye(4, dtype=torch.float64)[None], width, height, "POLYNOMIAL")


def scenery(rays: torch.Tensor) -> np.ndarray:
    """A smooth pattern at infinity along rays in the axes of the lens."""
    x, y = rays[..., 0] / rays[..., 2], rays[..., 1] / rays[..., 2]
    waves = [0.5 + 0.4 * torch.sin(4 * x + y), 0.5 + 0.4 * torch.cos(3 * y), 0.5 + 0.3 * torch.sin(5 * x)]
    return torch.stack(waves, -1).float().numpy()


@pytest.fixture(scope="module")
def way() -> Rectification:
    return rectification_of(stretching_lens())


def test_a_rectified_image_is_what_the_pinhole_sees(way: Rectification):
    filmed = scenery(image_directions(way.lens))
    wanted = scenery(image_directions(way.pinhole).double() @ way.turn.mT)
    assert np.abs(way.image(filmed) - wanted)[2:-2, 2:-2].max() < 0.003
    assert np.abs(filmed[: wanted.shape[0], : wanted.shape[1]] - wanted[: filmed.shape[0]]).max() > 0.3


def test_the_pinhole_has_square_pixels_looks_ahead_and_keeps_its_rows(way: Rectification):
    K = way.pinhole.K[0]
    assert K[0, 0] == K[1, 1]
    assert K[:2, 2].tolist() == [way.pinhole.width / 2, way.pinhole.height / 2]
    torch.testing.assert_close(way.turn.mT @ way.turn, torch.eye(3, dtype=torch.float64))
    assert torch.linalg.det(way.turn) > 0
    middle = directions(way.lens, torch.tensor([[[80.0, 60.0], [84.0, 60.0]]], dtype=torch.float64))[0] @ way.turn
    assert abs(middle[1, 1] / middle[1, 2] - middle[0, 1] / middle[0, 2]) < 0.002  # a row stays a row
    pixels = way.pinhole.width * way.pinhole.height
    assert 0.8 < pixels / (SIZE[0] * SIZE[1]) < 1.1  # as many pixels to the solid angle


def test_the_image_is_filled_and_as_large_as_can_be(way: Rectification):
    whole = way.mask(np.ones(SIZE[::-1], bool))
    assert whole.all()
    wider = Rectification(way.lens, rectified(way, way.pinhole.width + 12, way.pinhole.height), way.turn)
    higher = Rectification(way.lens, rectified(way, way.pinhole.width, way.pinhole.height + 12), way.turn)
    for larger in (wider, higher):
        assert not larger.mask(np.ones(SIZE[::-1], bool)).all()


def rectified(way: Rectification, width: int, height: int) -> Cameras:
    focal = way.pinhole.K[0, 0, 0].item()
    K = torch.tensor([[[focal, 0, width / 2], [0, focal, height / 2], [0, 0, 1]]], dtype=torch.float64)
    return Cameras(K, torch.zeros(1, 0).double(), torch.eye(4).double()[None], width, height)


def test_a_mask_moves_with_its_image(way: Rectification):
    usable = np.zeros(SIZE[::-1], bool)
    usable[:, 100:] = True
    image = np.repeat(usable[..., None], 3, 2).astype(np.uint8) * 255
    assert ((way.image(image)[..., 0] > 127) == way.mask(usable)).mean() > 0.99


def test_its_numbers_are_the_whole_of_it(way: Rectification):
    again = from_key(*way.key)
    assert again.key == way.key
    image = (255 * scenery(image_directions(way.lens))).astype(np.uint8)
    np.testing.assert_array_equal(again.image(image), way.image(image))


def test_images_of_another_size_go_the_same_way(way: Rectification):
    large = way.resized(2 * SIZE[0], 2 * SIZE[1])
    assert (large.pinhole.width, large.pinhole.height) == (2 * way.pinhole.width, 2 * way.pinhole.height)
    wanted = scenery(image_directions(large.pinhole).double() @ large.turn.mT)
    assert np.abs(large.image(scenery(image_directions(large.lens))) - wanted)[2:-2, 2:-2].max() < 0.003
    assert way.resized(*SIZE) is way


def test_any_image_of_the_camera_becomes_one_of_the_pinhole_and_no_other_does(way: Rectification):
    large = scenery(image_directions(stretching_lens(2 * SIZE[0], 2 * SIZE[1])))
    small = way.image(scenery(image_directions(way.lens)))
    assert np.abs(way.any_image(large) - small)[2:-2, 2:-2].max() < 0.01
    already = np.zeros((way.pinhole.height, way.pinhole.width, 3), np.float32)
    assert way.any_image(already) is already


def test_a_lens_that_fills_no_image_is_refused():
    with pytest.raises(ValueError, match="filled by this lens"):
        rectification_of(stretching_lens(12, 10, stretch=0.0))


def test_a_lens_that_folds_is_refused():
    with pytest.raises(ValueError, match=r"folds|filled"):
        rectification_of(stretching_lens(stretch=-4.0))


def test_a_mask_goes_back_to_where_it_was_filmed(way: Rectification):
    usable = np.ones(SIZE[::-1], bool)
    usable[40:70, 60:110] = False
    back = way.mask_as_filmed(way.mask(usable))
    assert (back == usable).mean() > 0.99
    assert back[0, 0]  # where the pinhole's image shows nothing
