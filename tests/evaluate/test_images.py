"""PSNR, SSIM, blur and sharpness against published numbers, scikit-image and plain limits."""

import json
import math
from typing import Any

import numpy as np
import pytest
import torch
from PIL import Image
from scipy.ndimage import gaussian_filter
from skimage.metrics import peak_signal_noise_ratio, structural_similarity

from swimm3r.evaluate import NotComputed, summary_entries
from swimm3r.evaluate.images import as_8_bit, blur4_psnr, mean_view_scores, psnr, sharpness, ssim, view_scores


def textured(seed: int = 0, side: int = 48) -> torch.Tensor:
    noise = np.random.default_rng(seed).random((side, side, 3))
    smooth = gaussian_filter(noise, (1.5, 1.5, 0))
    return torch.from_numpy((smooth - smooth.min()) / (smooth.max() - smooth.min())).float()


def image(path) -> torch.Tensor:
    return torch.from_numpy(np.asarray(Image.open(path).convert("RGB")).astype(np.float32) / 255)


@pytest.mark.shared
def test_psnr_and_ssim_are_those_of_the_vectors(shared):
    folder = shared / "vectors/metrics"
    for pair, expected in json.loads((folder / "image_metrics.json").read_text()).items():
        render, target = (image(folder / name) for name in pair.split(" vs "))
        assert psnr(render, target) == pytest.approx(expected["psnr"], abs=1e-5)
        assert ssim(render, target) == pytest.approx(expected["ssim_3dgs_zero_pad"], abs=1e-5)
        assert ssim(render, target, "valid") == pytest.approx(expected["ssim_valid"], abs=1e-5)


def test_psnr_of_a_tenth_everywhere_is_twenty_decibels():
    target = torch.full((4, 5, 3), 0.5)
    assert psnr(target + 0.1, target) == pytest.approx(20, abs=1e-5)


def test_scikit_image_agrees():
    a, b = textured(0), (0.7 * textured(0) + 0.3 * textured(1)).clamp(0, 1)
    assert psnr(a, b) == pytest.approx(peak_signal_noise_ratio(b.numpy(), a.numpy(), data_range=1), abs=1e-4)
    similarity: Any = structural_similarity
    _, oracle = similarity(
        a.double().numpy(),
        b.double().numpy(),
        gaussian_weights=True,
        sigma=1.5,
        use_sample_covariance=False,
        data_range=1,
        channel_axis=-1,
        full=True,
    )
    assert ssim(a, b, "valid") == pytest.approx(oracle[5:-5, 5:-5].mean(), abs=1e-7)


def test_equal_images_are_equal_and_ssim_is_symmetric():
    a, b = textured(0), textured(1)
    assert ssim(a, a) == pytest.approx(1)
    assert psnr(a, a) == math.inf
    assert ssim(a, b) == pytest.approx(ssim(b, a))
    assert ssim(a, b) == pytest.approx(ssim(a.flip(-1), b.flip(-1)))


def test_an_infinite_score_is_null_with_a_reason():
    entries = summary_entries({"psnr": psnr(textured(), textured())})
    assert entries == {"psnr": None, "psnr_reason": "the value is inf"}


def test_ssim_without_padding_needs_a_whole_window():
    small = torch.rand(10, 30, 3, generator=torch.Generator().manual_seed(0))
    with pytest.raises(ValueError, match="11 pixels"):
        ssim(small, small, "valid")


def test_8_bit_values_survive_and_others_are_clamped():
    stored = torch.arange(256).float()[:, None, None].expand(256, 1, 3) / 255
    torch.testing.assert_close(as_8_bit(stored), stored, rtol=0, atol=0)
    assert as_8_bit(torch.tensor([[[-0.5, 1.5, 0.5]]])).flatten().tolist() == pytest.approx([0, 1, 128 / 255])


def test_a_blurred_render_gets_the_blur_psnr_and_little_sharpness():
    target = textured(side=96)
    blurred = torch.from_numpy(gaussian_filter(target.double().numpy(), (4, 4, 0)))
    assert psnr(blurred, target) == pytest.approx(blur4_psnr(target))
    little = sharpness(blurred.float(), target)
    assert isinstance(little, float)
    assert little < 0.35


def test_sharpness_is_the_ratio_of_contrasts_and_blind_to_brightness():
    target = textured()
    assert sharpness(target, target) == pytest.approx(1)
    assert sharpness(0.5 * target + 0.2, target) == pytest.approx(0.5, rel=1e-5)
    assert sharpness(target, 0.5 * target + 0.2) == pytest.approx(2, rel=1e-5)


def test_sharpness_of_a_part_is_that_of_its_pixels():
    target, left = textured(), torch.zeros(48, 48, dtype=torch.bool)
    left[:, :20] = True
    half = torch.cat([target[:, :24], 0.5 * target[:, 24:]], 1)
    assert sharpness(half, target, left) == pytest.approx(1)
    whole = sharpness(half, target)
    assert isinstance(whole, float)
    assert whole < 0.9
    assert sharpness(half, target, torch.ones_like(left)) == pytest.approx(whole)


def test_the_direction_of_an_edge_does_not_matter_to_sharpness():
    ramp = torch.arange(32).float()[None, :, None].expand(32, 32, 3) / 64
    assert sharpness(ramp, ramp.transpose(0, 1)) == pytest.approx(1, rel=1e-5)
    slanted = (ramp + ramp.transpose(0, 1)) / 2**0.5
    assert sharpness(slanted, ramp) == pytest.approx(1, rel=1e-5)


def test_sharpness_beside_a_flat_target_is_not_a_number():
    assert isinstance(sharpness(textured(), torch.full((48, 48, 3), 0.3)), NotComputed)


def test_mean_over_views_keeps_the_reason_of_a_missing_score():
    without = NotComputed("LPIPS vgg needs a file")
    views = [view_scores(textured(k), textured(0), without) for k in (1, 2)]
    mean = mean_view_scores(views)
    assert mean.views == 2
    assert mean.psnr == pytest.approx((views[0].psnr + views[1].psnr) / 2)
    assert mean.lpips == without
    with pytest.raises(ValueError, match="no views"):
        mean_view_scores([])
