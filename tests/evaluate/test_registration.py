"""Displacement and recolored PSNR: known shifts, known recoloring, and images that have no texture."""

import cv2
import numpy as np
import pytest
import torch
from scipy.ndimage import gaussian_filter

from swimm3r.appearance import ORDERS, shading_gains
from swimm3r.evaluate import NotComputed
from swimm3r.evaluate.images import psnr
from swimm3r.evaluate.registration import (
    Displacement,
    displacement,
    fit_colors,
    psnr_affine,
    recolored_by_halves,
    recolored_by_tiles,
)

HEIGHT, WIDTH = 180, 240
INNER = torch.zeros(HEIGHT, WIDTH, dtype=torch.bool)
INNER[8:-8, 8:-8] = True
RECOLOR = torch.tensor([[0.8, 0.1, 0.02], [0.05, 0.9, 0.1], [-0.05, 0.1, 0.7]])


@pytest.fixture(scope="module")
def ground() -> torch.Tensor:
    """A texture of several scales, in three channels that are not each other's copies."""
    rng = np.random.default_rng(0)
    layers = [gaussian_filter(rng.standard_normal((HEIGHT, WIDTH, 3)), (s, s, 0)) * s for s in (1.2, 3.0, 8.0)]
    smooth = np.sum(layers, axis=0)
    return torch.from_numpy((0.5 + 0.1 * smooth / smooth.std()).clip(0.05, 0.95)).float()


def moved(image: torch.Tensor, x: float, y: float) -> torch.Tensor:
    move = np.array([[1, 0, x], [0, 1, y]], np.float32)
    size = (image.shape[1], image.shape[0])
    shown = cv2.warpAffine(image.numpy(), move, size, flags=cv2.INTER_CUBIC, borderMode=cv2.BORDER_REFLECT)
    return torch.from_numpy(shown)


def found(render: torch.Tensor, target: torch.Tensor, where: torch.Tensor = INNER) -> Displacement:
    measured = displacement(render, target, where)
    assert isinstance(measured, Displacement), measured
    return measured


@pytest.mark.parametrize("shift", [(0.3, 0.2), (0.7, -0.5), (1.5, 1.0), (-3.2, 2.4)])
def test_a_known_shift_is_the_displacement(ground, shift):
    measured = found(moved(ground, *shift), ground)
    assert measured.median == pytest.approx(float(np.hypot(*shift)), abs=0.06)
    assert measured.p90 == pytest.approx(float(np.hypot(*shift)), abs=0.12)


def test_the_percentile_tells_of_the_part_that_is_displaced(ground):
    half = ground.clone()
    half[:, 3 * WIDTH // 4 :] = moved(ground, 0.0, 2.0)[:, 3 * WIDTH // 4 :]
    measured = found(half, ground)
    assert measured.median < 0.1
    assert measured.p90 == pytest.approx(2.0, abs=0.15)


@pytest.mark.parametrize("shift", [(0.0, 0.0), (0.7, -0.5)])
def test_neither_an_affine_recoloring_nor_a_smooth_gain_displaces_anything(ground, shift):
    seen = moved(ground, *shift)
    lit = seen * torch.linspace(0.75, 1.25, WIDTH)[None, :, None]
    for other in (seen @ RECOLOR.mT + 0.05, lit):
        assert found(other, ground).median == pytest.approx(found(seen, ground).median, abs=0.04)


def test_an_affine_recoloring_leaves_the_recolored_psnr(ground):
    noisy = (ground + 0.02 * torch.randn(ground.shape, generator=torch.Generator().manual_seed(0))).clamp(0, 1)
    before = psnr_affine(noisy, ground, INNER)
    after = psnr_affine(noisy @ RECOLOR.mT + 0.05, ground, INNER)
    assert isinstance(before, float)
    assert isinstance(after, float)
    assert psnr((noisy @ RECOLOR.mT + 0.05)[INNER], ground[INNER]) < before - 10
    assert after == pytest.approx(before, abs=0.1)  # 8 bits of a darker image hold a little less


def test_the_fit_finds_the_map_that_made_the_colors(ground):
    fit = fit_colors(ground, ground @ RECOLOR.mT + 0.05)
    torch.testing.assert_close(fit.matrix.float(), RECOLOR, atol=2e-3, rtol=0)
    torch.testing.assert_close(fit(ground), ground @ RECOLOR.mT + 0.05, atol=2e-4, rtol=0)


def test_a_shift_does_not_pass_for_a_color(ground):
    shifted = moved(ground, 2.0, 1.0)
    recolored = psnr_affine(shifted, ground, INNER)
    assert isinstance(recolored, float)
    assert recolored < psnr(shifted[INNER], ground[INNER]) + 3


def test_noise_on_flat_water_is_no_texture(ground):
    rng = torch.Generator().manual_seed(0)
    scene = ground.clone()
    scene[:, WIDTH // 2 :] = 0.4
    scene += 0.004 * torch.randn(scene.shape, generator=rng)
    left = INNER.clone()
    left[:, WIDTH // 2 - 8 :] = False
    assert found(scene, scene, left).share > 0.9
    right = INNER & ~left
    right[:, : WIDTH // 2 + 8] = False
    nothing = displacement(scene, scene, right)
    assert isinstance(nothing, NotComputed) or nothing.share < 0.1
    assert isinstance(displacement(torch.full_like(ground, 0.4), torch.full_like(ground, 0.4), INNER), NotComputed)


def test_large_images_are_measured_at_the_common_size(ground):
    large = torch.nn.functional.interpolate(ground.permute(2, 0, 1)[None], scale_factor=4.0, mode="bicubic")[0]
    large = large.permute(1, 2, 0)
    everywhere = torch.ones(large.shape[:2], dtype=torch.bool)
    assert found(moved(large, 4.0, 0.0), large, everywhere).median == pytest.approx(2.0, abs=0.1)


def test_recoloring_by_halves_undoes_an_affine_map(ground):
    target = ground @ RECOLOR.mT + 0.05
    after = recolored_by_halves(ground, target, torch.ones(HEIGHT, WIDTH, dtype=torch.bool))
    assert psnr(after, target) > 35 > psnr(ground, target) + 10


def test_no_pixel_is_compared_in_colors_that_it_was_fitted_to(ground):
    everywhere = torch.ones(HEIGHT, WIDTH, dtype=torch.bool)
    left = slice(None, WIDTH // 2)
    other = ground.clone()
    other[:, left] = other[:, left].flip(-1) * 0.5
    first, second = (recolored_by_halves(ground, target, everywhere) for target in (ground, other))
    torch.testing.assert_close(first[:, left], second[:, left])
    assert (first[:, WIDTH // 2 :] - second[:, WIDTH // 2 :]).abs().mean() > 0.05


def test_a_half_that_nobody_trusts_recolors_nothing(ground):
    nowhere = torch.zeros(HEIGHT, WIDTH, dtype=torch.bool)
    assert torch.equal(recolored_by_halves(ground, 0.5 * ground, nowhere), ground)


def test_recoloring_by_tiles_undoes_a_smooth_gain(ground):
    shading = 0.06 * torch.randn(len(ORDERS), 1, generator=torch.Generator().manual_seed(1)).expand(-1, 3)
    everywhere = torch.ones(HEIGHT, WIDTH, dtype=torch.bool)
    target = (ground @ RECOLOR.mT + 0.05) * shading_gains(shading, HEIGHT, WIDTH).permute(1, 2, 0)
    after = recolored_by_tiles(ground, target, everywhere)
    assert psnr(after, target) > psnr(recolored_by_halves(ground, target, everywhere), target) + 6
    assert psnr(after, target) > 35


def test_no_tile_is_compared_in_colors_that_it_was_fitted_to(ground):
    everywhere = torch.ones(HEIGHT, WIDTH, dtype=torch.bool)
    row, column = torch.arange(HEIGHT)[:, None] // 30, torch.arange(WIDTH) // 30
    dark = (row + column) % 2 == 0
    other = torch.where(dark[..., None], 0.5 * ground.flip(-1), ground)
    first, second = (recolored_by_tiles(ground, target, everywhere) for target in (ground, other))
    torch.testing.assert_close(first[dark], second[dark])
    assert (first[~dark] - second[~dark]).abs().mean() > 0.05


def test_a_gain_finer_than_the_tiles_is_not_taken_for_one(ground):
    noise = torch.randn(HEIGHT, WIDTH, 3, generator=torch.Generator().manual_seed(2))
    target = ground + 0.03 * noise
    everywhere = torch.ones(HEIGHT, WIDTH, dtype=torch.bool)
    assert abs(psnr(recolored_by_tiles(ground, target, everywhere), target) - psnr(ground, target)) < 0.1
