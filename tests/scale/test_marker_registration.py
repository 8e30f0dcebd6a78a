"""Corners of a marker from all edges of its pattern, on squares whose place is known."""

import cv2
import numpy as np
import pytest
import torch

from swimm3r.cameras import Cameras, directions
from swimm3r.scale.marker_registration import pattern_edges, registered_corners

CELLS = 6
DARK, BRIGHT = 0.1, 0.7
SIZE = 96  # pixels of the image
FINER = 8  # samples of a pixel along each axis


def pattern(marker: int = 7) -> np.ndarray:
    dictionary = cv2.aruco.getPredefinedDictionary(cv2.aruco.DICT_4X4_50)
    return cv2.aruco.generateImageMarker(dictionary, marker, CELLS) > 127


def camera(focal: float = 100.0, k1: float = 0.0) -> Cameras:
    K = torch.tensor([[focal, 0, SIZE / 2], [0, focal, SIZE / 2], [0, 0, 1]]).double()
    return Cameras(K[None], torch.tensor([[k1]]).double(), torch.eye(4).double()[None], SIZE, SIZE, "SIMPLE_RADIAL")


def rays(through: Cameras, pixels: np.ndarray) -> np.ndarray:
    flat = torch.from_numpy(pixels.reshape(1, -1, 2).astype(np.float64))
    return directions(through, flat)[0].numpy().reshape(*pixels.shape[:-1], 3)


def seen(corners: np.ndarray, bright: np.ndarray, blur: float = 0.8, through: Cameras | None = None) -> np.ndarray:
    """Linear light of an image of a marker with these corners on a bright ground."""
    lens = through or camera()
    square = np.array([[0, 0], [CELLS, 0], [CELLS, CELLS], [0, CELLS]], np.float32)
    plane = np.linalg.inv(cv2.getPerspectiveTransform(square, rays(lens, corners)[:, :2].astype(np.float32)))
    places = (np.arange(SIZE * FINER) + 0.5) / FINER
    xyw = rays(lens, np.stack(np.meshgrid(places, places), -1)) @ plane.T
    cells = np.nan_to_num(np.floor(xyw[..., :2] / xyw[..., 2:]), nan=-1)  # the lens may not reach the image's corners
    column, row = np.moveaxis(cells.astype(int), -1, 0)
    inside = (column >= 0) & (column < CELLS) & (row >= 0) & (row < CELLS)
    dark = inside & ~bright[row.clip(0, CELLS - 1), column.clip(0, CELLS - 1)]
    light = np.where(dark, DARK, BRIGHT).reshape(SIZE, FINER, SIZE, FINER).mean((1, 3))
    return cv2.GaussianBlur(light, (0, 0), blur)


def oblique(side: float = 48.0) -> np.ndarray:
    """Corners of a turned square seen at an angle."""
    square = side * np.array([[-0.5, -0.42], [0.5, -0.5], [0.44, 0.5], [-0.42, 0.36]])
    cos, sin = np.cos(0.6), np.sin(0.6)
    return square @ np.array([[cos, sin], [-sin, cos]]) + (47.3, 48.6)


def near(corners: np.ndarray) -> np.ndarray:
    return corners + np.random.default_rng(0).uniform(-1.2, 1.2, (4, 2))


def test_edges_of_a_pattern_of_one_bright_cell():
    edges = pattern_edges(np.array([[False, False, False], [False, True, False], [False, False, False]]))
    assert len(edges.places) == 4 * 3 + 4
    middle = edges.places.mean(1)
    inner = np.abs(middle - 1.5).max(1) < 1
    assert inner.sum() == 4
    outward = ((middle - 1.5) * edges.to_bright).sum(1)
    assert (outward[~inner] == 1.5).all()
    assert (outward[inner] == -0.5).all()


@pytest.mark.parametrize(("side", "most"), [(18.0, 0.06), (30.0, 0.03), (48.0, 0.01)])
def test_corners_are_found_to_a_few_hundredths_of_a_pixel(side, most):
    corners, bright = oblique(side), pattern()
    found = registered_corners(seen(corners, bright, blur=0.6), camera(), near(corners), bright)
    assert found is not None
    assert np.abs(found - corners).max() < most


@pytest.mark.parametrize("exponent", [0.45, 2.0])
def test_an_unknown_response_of_the_camera_moves_no_corner(exponent):
    corners, bright = oblique(), pattern()
    found = registered_corners(seen(corners, bright) ** exponent, camera(), near(corners), bright)
    assert found is not None
    assert np.abs(found - corners).max() < 0.06  # a line through outer edges alone is 0.2 pixels off


def test_a_lens_that_bends_straight_edges_moves_no_corner():
    wide, bright = camera(60.0, -0.25), pattern()
    corners = oblique(30.0) + np.array([18.0, -16.0])
    light = seen(corners, bright, 0.6, wide)
    found = registered_corners(light, wide, near(corners), bright)
    straight = registered_corners(light, camera(60.0), near(corners), bright)
    assert found is not None
    assert straight is not None
    assert np.abs(found - corners).max() < 0.03
    assert np.abs(straight - corners).max() > 0.2


def test_light_that_fades_along_the_marker_moves_no_corner():
    corners, bright = oblique(), pattern()
    light = seen(corners, bright) * np.linspace(0.6, 1.0, SIZE) + 0.1
    found = registered_corners(light, camera(), near(corners), bright)
    assert found is not None
    assert np.abs(found - corners).max() < 0.04


def test_sand_over_one_corner_is_left_out():
    corners, bright = oblique(), pattern()
    light = seen(corners, bright)
    x, y = corners[2]
    light[int(y) - 9 : int(y) + 9, int(x) - 9 : int(x) + 9] = 0.45
    found = registered_corners(light, camera(), near(corners), bright)
    assert found is not None
    assert np.abs(found - corners).max() < 0.1


@pytest.mark.parametrize("what", ["covered", "cut", "flat"])
def test_a_pattern_that_is_not_there_has_no_corners(what):
    corners, bright = oblique(), pattern()
    light = seen(corners, bright)
    if what == "covered":
        light[:, :54] = 0.5
    if what == "flat":
        light[:] = 0.5
    start = corners + np.array([40.0, 0.0]) if what == "cut" else near(corners)
    assert registered_corners(light, camera(), start, bright) is None
