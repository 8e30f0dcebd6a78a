"""UIQM and UCIQE to published numbers; water scores from waters whose error is known."""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import pytest
import torch
from PIL import Image
from skimage.color import rgb2lab
from torch import Tensor

from swimm3r.evaluate import NotComputed
from swimm3r.evaluate.underwater import (
    WaterScores,
    _lab_from_srgb,
    clear_psnr,
    lit_enough,
    strength_gain,
    uciqe,
    uiqm,
    view_water_errors,
    water_scores_from_errors,
)
from swimm3r.medium import AttenuationCurve, Medium, MediumFit, add_water, backscatter, remove_water

# name: UICM, UISM, UIConM, UIQM, UIQM after 256 x 256 bicubic, UCIQE (README of the vectors)
PUBLISHED = {
    "euvp_1_raw_256.png": (1.416124, 7.559176, 0.230712, 3.097023, 3.097023, 22.624668),
    "euvp_1_ref_256.png": (1.713420, 7.878755, 0.146440, 2.898482, 2.898482, 24.962227),
    "euvp_1_ref_crop_73x59.png": (0.662568, 7.777964, 0.158891, 2.883599, 2.962050, 22.299984),
    "flsea_a_484x304.png": (3.728021, 6.622034, 0.261165, 2.994361, 3.063713, 24.473536),
}
Z = torch.linspace(0.5, 6, 40).reshape(5, 8)
WATER = Medium(torch.tensor([0.1, 0.3, 0.4]), torch.tensor([0.6, 0.2, 0.15]), torch.tensor([0.5, 0.3, 0.2]))


def image(path) -> torch.Tensor:
    return torch.from_numpy(np.asarray(Image.open(path).convert("RGB")).astype(np.float32) / 255)


def fit_of(medium: Medium) -> MediumFit:
    """A fit that found exactly this water."""
    zero = torch.zeros(3)
    return MediumFit(
        **vars(medium),
        curve=AttenuationCurve(medium.beta_D, zero, zero, zero),
        std=Medium(zero, zero, zero),
        identifiable={name: torch.ones(3, dtype=torch.bool) for name in ("Binf", "beta_D", "beta_B")},
        z_range=(0.1, 10.0),
        encoding="srgb",
    )


@pytest.mark.shared
@pytest.mark.parametrize("name", PUBLISHED)
def test_uiqm_is_that_of_the_vectors(shared, name):
    uicm, uism, uiconm, native, resized, _ = PUBLISHED[name]
    rgb = image(shared / "vectors/metrics" / name)
    score = uiqm(rgb)
    assert score.uicm == pytest.approx(uicm, abs=1e-3)
    assert score.uism == pytest.approx(uism, abs=1e-5)
    assert score.uiconm == pytest.approx(uiconm, abs=1e-5)
    assert score.uiqm == pytest.approx(native, abs=1e-5)
    assert score.variant == "FUnIE-GAN, native size"
    assert uiqm(rgb, size=(256, 256)).uiqm == pytest.approx(resized, abs=1e-4)


@pytest.mark.shared
@pytest.mark.parametrize("name", PUBLISHED)
def test_uciqe_is_that_of_the_vectors(shared, name):
    assert uciqe(image(shared / "vectors/metrics" / name)) == pytest.approx(PUBLISHED[name][-1], abs=1e-5)


def test_lab_is_that_of_scikit_image():
    rgb = torch.randint(0, 256, (30, 31, 3), generator=torch.Generator().manual_seed(0)).to(torch.uint8)
    rgb[0, :3] = torch.tensor([[0, 0, 0], [255, 255, 255], [3, 0, 5]])
    torch.testing.assert_close(_lab_from_srgb(rgb), torch.from_numpy(rgb2lab(rgb.numpy())), rtol=0, atol=1e-9)


def test_flat_and_gray_images_have_finite_scores():
    flat = torch.full((40, 40, 3), 0.4)
    assert uiqm(flat).uiqm == pytest.approx(0, abs=1e-9)
    assert uciqe(torch.zeros(20, 20, 3)) == 0
    assert uciqe(flat) == pytest.approx(0, abs=0.01)


def test_a_contrast_stretch_raises_uciqe():
    dull = 0.4 + 0.2 * torch.rand(40, 40, 3, generator=torch.Generator().manual_seed(0))
    assert uciqe((dull - 0.4) / 0.2) > uciqe(dull) + 10


def test_uiqm_needs_one_whole_block():
    with pytest.raises(ValueError, match="10 pixels"):
        uiqm(torch.zeros(9, 40, 3))


def water_scores(fit: MediumFit, ray_depths: Sequence[Tensor], true: Medium) -> WaterScores:
    """The scores of a fit over views of these depths."""
    errors = [view_water_errors(z, fit.at(z), true) for z in ray_depths]
    return water_scores_from_errors(errors, fit.constant(), fit.identifiable, true)


def test_the_true_water_has_no_error():
    scores = water_scores(fit_of(WATER), [Z, 2 * Z], WATER)
    for errors in (scores.T_D_abs, scores.B_abs, scores.Binf_abs, scores.beta_D_rel, scores.beta_B_rel):
        assert errors == pytest.approx([0, 0, 0], abs=1e-6)


def test_errors_are_per_channel_and_those_of_the_formula():
    wrong = replace(
        WATER, beta_D=WATER.beta_D * torch.tensor([1.0, 1.5, 1.0]), Binf=WATER.Binf + torch.tensor([0, 0, 0.1])
    )
    scores = water_scores(fit_of(wrong), [Z], WATER)
    z = Z.double()
    expected = (torch.exp(-0.3 * z) - torch.exp(-0.2 * z)).abs().mean().item()
    assert scores.T_D_abs == pytest.approx([0, expected, 0], abs=1e-6)
    assert scores.B_abs == pytest.approx([0, 0, (0.1 * (1 - torch.exp(-0.2 * z))).mean().item()], abs=1e-6)
    assert scores.Binf_abs == pytest.approx([0, 0, 0.1], abs=1e-6)
    assert scores.beta_D_rel == pytest.approx([0, 0.5, 0], abs=1e-6)


def test_every_pixel_counts_alike_and_those_without_a_surface_do_not():
    wrong = fit_of(replace(WATER, beta_D=2 * WATER.beta_D))
    near, far = torch.full((1, 1), 1.0), torch.full((1, 3), 4.0)
    together = water_scores(wrong, [near, far], WATER)
    alone = [water_scores(wrong, [z], WATER).T_D_abs for z in (near, far)]
    assert together.T_D_abs == pytest.approx([(a + 3 * b) / 4 for a, b in zip(*alone, strict=True)])
    holed = torch.tensor([[1.0, 0.0, torch.inf, torch.nan]])
    assert water_scores(wrong, [holed], WATER).T_D_abs == pytest.approx(alone[0])
    with pytest.raises(ValueError, match="no pixel"):
        water_scores(wrong, [torch.zeros(2, 2)], WATER)


def test_coefficients_that_are_not_identifiable_are_null_with_a_reason():
    fit = fit_of(WATER)
    fit.identifiable["beta_D"][1:] = False
    entries = water_scores(fit, [Z], WATER).summary()
    assert entries["beta_D_rel"] == [pytest.approx(0, abs=1e-6), None, None]
    assert entries["beta_D_rel_reason"] == "not identifiable in G, B"
    assert "beta_B_rel_reason" not in entries
    assert entries["T_D_abs"] == pytest.approx([0, 0, 0], abs=1e-6)


def test_a_medium_that_varies_over_the_image_is_scored_at_its_pixels():
    varying = Medium(*(v.expand(5, 8, 3).clone() for v in (WATER.Binf, WATER.beta_D, WATER.beta_B)))
    varying.Binf[:, :4] += 0.1
    scores = water_scores_from_errors([view_water_errors(Z, varying, WATER)], WATER, fit_of(WATER).identifiable, WATER)
    expected = 0.1 * (1 - torch.exp(-WATER.beta_B[0] * Z[:, :4])).sum().item() / 40
    assert scores.B_abs[0] == pytest.approx(expected, rel=1e-5)
    assert scores.T_D_abs == pytest.approx([0, 0, 0], abs=1e-6)


def test_clear_psnr_counts_only_channels_with_light_left():
    J = torch.rand(5, 8, 3, generator=torch.Generator().manual_seed(0))
    dark = torch.exp(-WATER.beta_D * Z[..., None]) <= 0.05
    assert dark[..., 0].any()
    assert not dark[..., 1:].any()
    restored = torch.where(dark, 0.0, (J + 0.1).clamp(0, 1))
    restored = torch.where((~dark) & (J > 0.9), J - 0.1, restored)
    assert clear_psnr(restored, J, Z, WATER) == pytest.approx(20, abs=1e-4)


def test_clear_psnr_is_of_the_image_as_shown_and_of_known_pixels():
    J = torch.full((5, 8, 3), 0.9)
    overshoot = J.clone()
    overshoot[0] = 7.0
    z = Z.clone()
    z[1:] = 0
    assert clear_psnr(overshoot, J, z, WATER) == pytest.approx(20, abs=1e-4)
    assert isinstance(clear_psnr(J, J, torch.zeros_like(Z), WATER), NotComputed)
    with pytest.raises(ValueError, match="not numbers"):
        clear_psnr(J * torch.nan, J, Z, WATER)


def test_the_true_water_restores_the_clear_image():
    J = torch.rand(5, 8, 3, generator=torch.Generator().manual_seed(0))
    restored = remove_water(add_water(J, Z, WATER), Z, WATER)
    score = clear_psnr(restored, J, Z, WATER)
    assert isinstance(score, float)
    assert score > 80


def test_colors_under_a_lamp_are_compared_after_its_one_unknown_gain():
    J = torch.rand(5, 8, 3, generator=torch.Generator().manual_seed(0))
    counted = lit_enough(Z, WATER)
    gain = strength_gain([(0.5 * J, J, counted), (0.5 * J.flip(0), J.flip(0), counted)])
    assert gain == pytest.approx(2.0, rel=1e-5)


def test_pixels_count_where_enough_of_a_lamps_light_arrives():
    dim = torch.full((5, 8, 3), 0.1)
    assert lit_enough(Z, WATER, light=dim).sum() < lit_enough(Z, WATER).sum()
    assert torch.equal(lit_enough(Z, WATER, light=torch.ones_like(dim)), lit_enough(Z, WATER))


def test_backscatter_under_a_lamp_is_compared_with_the_given_one():
    glow = torch.full((5, 8, 3), 0.25)
    errors = [view_water_errors(Z, WATER, WATER, backscatter(Z, WATER) + glow)]
    scores = water_scores_from_errors(errors, WATER, fit_of(WATER).identifiable, WATER)
    assert scores.B_abs == pytest.approx([0.25] * 3, rel=1e-4)
    assert scores.T_D_abs == [0, 0, 0]
