"""Votes of other frames on the pixels of a frame, and the pixels that surely move."""

import numpy as np
import pytest
import torch

from swimm3r.cameras import Cameras
from swimm3r.sfm.moving.comparison import Pair, SmallView
from swimm3r.sfm.moving.occluders import Layer, evidence_on, votes_on

HEIGHT, WIDTH = 60, 80
OBJECT = (slice(20, 40), slice(30, 55))
GROUND = 3.0
CAMERA = Cameras(
    torch.tensor([[[80.0, 0, WIDTH / 2], [0, 80, HEIGHT / 2], [0, 0, 1]]]),
    torch.zeros(1, 0),
    torch.eye(4, dtype=torch.float64)[None],
    WIDTH,
    HEIGHT,
)
ALIKE = Pair(np.ones(3), 0.06)  # frames of one exposure


def ground() -> np.ndarray:
    """Sand: patches of a few pixels, without sharp edges."""
    y, x = np.mgrid[:HEIGHT, :WIDTH] / 4
    waves = np.stack([np.sin(x + 2 * y), np.sin(2 * x - y + 1), np.sin(x - y)], -1)
    return (0.5 + 0.08 * waves).astype(np.float32)


def layer(rgb: np.ndarray, z_depth: float = GROUND, rows: slice = slice(None)) -> Layer:
    """A surface that another frame measured at every pixel of some rows."""
    pixel = np.arange(HEIGHT * WIDTH).reshape(HEIGHT, WIDTH)[rows].reshape(-1)
    return Layer(view(rgb), pixel, pixel, np.full(len(pixel), z_depth, np.float32))


def view(rgb: np.ndarray, z_depth: float = 0.0) -> SmallView:
    """A frame, all of it usable; without depth unless it is given."""
    return SmallView(CAMERA, rgb, np.full(rgb.shape[:2], z_depth, np.float32), np.ones(rgb.shape[:2], bool))


@pytest.fixture
def with_object() -> np.ndarray:
    rgb = ground()
    rgb[OBJECT] = (0.1, 0.05, 0.05)
    return rgb


@pytest.fixture
def truth() -> np.ndarray:
    found = np.zeros((HEIGHT, WIDTH), bool)
    found[OBJECT] = True
    return found


def test_an_object_before_measured_ground_is_found(with_object: np.ndarray, truth: np.ndarray) -> None:
    found = evidence_on(view(with_object), [layer(ground())] * 4)
    assert (found.moving & truth).sum() > 0.8 * truth.sum()
    assert (found.moving & ~truth).sum() < 0.1 * truth.sum()
    assert not (found.still & truth).any()


def test_ground_that_nobody_measured_decides_nothing(with_object: np.ndarray) -> None:
    found = evidence_on(view(with_object), [layer(ground(), rows=slice(0, 32))] * 4)
    assert not found.moving[33:].any()
    assert not found.still[33:].any()


def test_nothing_moves_where_frames_show_the_same() -> None:
    found = evidence_on(view(ground()), [layer(ground())] * 4)
    assert not found.moving.any()
    assert found.still[1:-1, 1:-1].all()


def test_exposure_and_white_balance_are_no_movement() -> None:
    brighter = ground() * np.array([1.3, 1.1, 0.9], np.float32)
    assert not evidence_on(view(brighter), [layer(ground())] * 4).moving.any()


def test_places_are_known_to_a_pixel_in_both_frames(with_object: np.ndarray) -> None:
    shifted = np.roll(with_object, 2, axis=1)
    assert not votes_on(view(shifted), [layer(with_object)], [ALIKE]).different.any()
    assert votes_on(view(np.roll(shifted, 2, axis=1)), [layer(with_object)], [ALIKE]).different.any()


def test_a_measured_surface_hides_what_lies_behind_it(with_object: np.ndarray) -> None:
    near = view(with_object, GROUND / 2)
    assert not votes_on(near, [layer(ground())] * 4, [ALIKE] * 4).different.any()
    assert not evidence_on(near, [layer(ground())] * 4).moving.any()


def test_an_object_that_a_minority_saw_elsewhere_is_no_reason_to_doubt_the_frame(with_object: np.ndarray) -> None:
    assert not evidence_on(view(ground()), [layer(ground())] * 3 + [layer(with_object)]).moving.any()


def test_one_frame_alone_decides_nothing(with_object: np.ndarray) -> None:
    assert not evidence_on(view(with_object), [layer(ground())]).moving.any()


def test_pixels_that_are_not_to_be_used_are_no_objects(with_object: np.ndarray, truth: np.ndarray) -> None:
    unusable = SmallView(CAMERA, with_object, np.zeros((HEIGHT, WIDTH), np.float32), ~truth)
    assert not evidence_on(unusable, [layer(ground())] * 4).moving.any()


def test_packed_evidence_is_the_same(with_object: np.ndarray) -> None:
    found = evidence_on(view(with_object), [layer(ground())] * 4)
    again = found.packed().unpacked()
    assert np.array_equal(again.moving, found.moving)
    assert np.array_equal(again.still, found.still)
