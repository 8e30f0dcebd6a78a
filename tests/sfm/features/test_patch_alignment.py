"""Patches in images that are affine maps of each other by construction."""

import cv2
import numpy as np
import pytest

from swimm3r.sfm.features.patch_alignment import PATCH_SIDE, align_patches, cut_patches, half_size, smoothed

_TURN = np.array([[0.9, 0.15], [-0.1, 1.05]])  # steps in the second image to steps in the first
_SHIFT = np.array([40.3, 20.7])


def _texture(seed: int = 0, blur: float = 2.0) -> np.ndarray:
    noise = np.random.default_rng(seed).standard_normal((360, 360)).astype(np.float32)
    return cv2.GaussianBlur(noise, (0, 0), blur)


def _turned(image: np.ndarray) -> np.ndarray:
    """The second image, fainter and brighter than the first."""
    warp = np.column_stack([_TURN, _SHIFT])
    return 0.3 + 0.6 * cv2.warpAffine(image, warp, (280, 280), flags=cv2.INTER_CUBIC | cv2.WARP_INVERSE_MAP)


def _places(count: int = 300) -> tuple[np.ndarray, np.ndarray]:
    """The same points in the first and in the second image."""
    second = np.random.default_rng(1).uniform(60, 220, (count, 2))
    return (second - 0.5) @ _TURN.T + _SHIFT + 0.5, second


def _maps(count: int) -> np.ndarray:
    return np.repeat(np.linalg.inv(_TURN)[None], count, 0)


@pytest.mark.parametrize("known", [True, False])
def test_patches_are_found_within_a_tenth_of_a_pixel_whatever_the_light(known: bool):
    image = _texture()
    first, second = _places()
    start = second + np.random.default_rng(2).uniform(-0.7, 0.7, second.shape)
    maps = _maps(len(first)) if known else np.repeat(np.eye(2)[None], len(first), 0)
    found, alike = align_patches(_turned(image), cut_patches(image, first), start, maps)
    sure = alike > 0.9
    assert sure.mean() > 0.97
    assert np.linalg.norm(found - second, axis=1)[sure].max() < 0.08
    assert np.median(np.linalg.norm(found - second, axis=1)[sure]) < 0.03


def test_noise_hardly_moves_patches():
    rng, image = np.random.default_rng(3), _texture()
    first, second = _places()
    noisy = [
        smoothed(im + rng.normal(0, 0.1 * im.std(), im.shape).astype(np.float32)) for im in (image, _turned(image))
    ]
    found, alike = align_patches(noisy[1], cut_patches(noisy[0], first), second, _maps(len(first)))
    assert (alike > 0.8).mean() > 0.97
    assert np.median(np.linalg.norm(found - second, axis=1)) < 0.06


def test_half_the_size_finds_what_is_too_far_away_for_the_whole():
    image = smoothed(_texture(blur=5.0))
    other, (first, second) = smoothed(_turned(image)), _places()
    start = second + 3.2
    _, alike = align_patches(other, cut_patches(image, first), start, _maps(len(first)))
    assert np.isnan(alike).all()  # farther than patches are followed
    halves = cut_patches(half_size(image), first / 2)
    found, alike = align_patches(half_size(other), halves, start / 2, _maps(len(first)))
    assert (alike > 0.9).mean() > 0.9
    assert np.median(np.linalg.norm(2 * found - second, axis=1)) < 0.1


def test_patches_without_texture_or_beyond_the_border_stay_where_they_are():
    image = _texture()
    first, second = _places(4)
    edge = np.array([[5.0, 100.0], [359.0, 100.0]])
    beyond = cut_patches(image, edge)
    assert beyond.shape == (2, PATCH_SIDE, PATCH_SIDE)
    assert np.isnan(beyond).any(axis=(1, 2)).all()
    cases = (
        (_turned(image), cut_patches(np.ones_like(image), first), second),
        (np.ones((280, 280), np.float32), cut_patches(image, first), second),
        (_turned(image), beyond, second[:2]),
        (_turned(image), cut_patches(image, first), np.full((4, 2), 3.0)),
    )
    for other, patches, places in cases:
        found, alike = align_patches(other, patches, places, _maps(len(places)))
        assert np.array_equal(found, places)
        assert np.isnan(alike).all()
    no_map = np.full((4, 2, 2), np.nan)  # of a camera that looks along the surface
    found, alike = align_patches(_turned(image), cut_patches(image, first), second, no_map)
    assert np.array_equal(found, second)
    assert np.isnan(alike).all()


def test_other_ground_is_not_alike():
    first, second = _places()
    _, alike = align_patches(_turned(_texture(5)), cut_patches(_texture(), first), second, _maps(len(first)))
    assert (alike > 0.8).mean() < 0.02
