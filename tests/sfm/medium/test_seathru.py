"""The water from pixels and depths: recovery, invariances, and honesty about what cannot be known."""

from dataclasses import replace

import cv2
import numpy as np
import pytest
import torch

from swimm3r.errors import InputError
from swimm3r.medium import Medium, add_water, backscatter, rescale, srgb_from_linear, transmittances
from swimm3r.sfm.medium import seathru
from swimm3r.sfm.medium.least_squares.channel_fit import Pixels, daylight, evidence_of, fit_channel, prior_residuals
from swimm3r.sfm.medium.samples import WaterSamples
from swimm3r.sfm.medium.seathru import estimate_medium, fit_medium
from swimm3r.sfm.medium.settings import SeathruSettings

SETTINGS = SeathruSettings()


def draw_samples(
    medium: Medium,
    *,
    spread: float = 0.3,
    gains: float = 0.0,
    open_water: int = 0,
    points: int = 1500,
    encoding: str = "srgb",
) -> WaterSamples:
    """Points seen six times each from distances that differ by exp(+-spread), with pixel noise of 0.005."""
    g = np.random.default_rng(5)
    track, frame = np.repeat(np.arange(points), 6), np.tile(np.arange(24), points * 6 // 24)
    place, view = g.normal(0, 0.5 * spread, points), spread * np.sin(np.arange(24) * 1.3)
    z = 2.5 * np.exp(place[track] + view[frame])
    gray = np.where(g.random(points) < 0.03, 0.0, g.uniform(0.1, 0.8, points))
    J = torch.from_numpy((gray[:, None] * g.uniform(0.8, 1.2, (points, 3))).astype(np.float32))[track]
    I = add_water(J, torch.from_numpy(z.astype(np.float32)), medium)
    if encoding == "linear":
        I = srgb_from_linear(I)
    gain = torch.from_numpy(np.exp(gains * g.normal(0, 1, 24)).astype(np.float32))[frame]
    I = (I * gain[:, None] + 0.005 * torch.from_numpy(g.normal(0, 1, I.shape).astype(np.float32))).clamp(0, 1)
    sea = medium.Binf + 0.005 * torch.from_numpy(g.normal(0, 1, (open_water, 3)).astype(np.float32))
    return WaterSamples(
        I, torch.from_numpy(z.astype(np.float32)), torch.from_numpy(frame), torch.from_numpy(track), sea
    )


def errors(fit, medium, z) -> tuple[float, float]:
    """Worst channel's mean absolute error of T_D and of B."""
    found = fit.at(z)
    T_D = (transmittances(z, found)[0] - transmittances(z, medium)[0]).abs().mean(0).max()
    return float(T_D), float((backscatter(z, found) - backscatter(z, medium)).abs().mean(0).max())


def test_the_water_is_recovered_from_points_seen_at_several_distances(teal):
    samples = draw_samples(teal, open_water=1000)
    T_D, B = errors(fit_medium(samples, SETTINGS, "srgb"), teal, samples.ray_depth)
    assert T_D < 0.03
    assert B < 0.015


def test_exposure_that_changes_from_frame_to_frame_does_not_pass_for_water(teal):
    samples = draw_samples(teal, gains=0.1, open_water=1000)
    T_D, B = errors(fit_medium(samples, SETTINGS, "srgb"), teal, samples.ray_depth)
    assert T_D < 0.05
    assert B < 0.03


def test_water_that_acts_on_linear_light_is_recovered_in_linear_light(teal):
    samples = draw_samples(teal, encoding="linear")
    fit = fit_medium(samples, SETTINGS, "linear")
    T_D, B = errors(fit, teal, samples.ray_depth)
    assert fit.encoding == "linear"
    assert T_D < 0.05
    assert B < 0.03


def test_stretching_the_scene_divides_the_coefficients(teal):
    samples = draw_samples(teal)
    longer = WaterSamples(samples.I, samples.ray_depth * 8, samples.frame, samples.track, samples.open_water)
    one, eight = (fit_medium(s, SETTINGS, "srgb") for s in (samples, longer))
    expected = rescale(one, 8.0)
    for name in ("Binf", "beta_D", "beta_B"):
        torch.testing.assert_close(getattr(eight, name), getattr(expected, name), rtol=1e-3, atol=1e-5)
        torch.testing.assert_close(getattr(eight.std, name), getattr(expected.std, name), rtol=1e-2, atol=1e-5)
        assert torch.equal(eight.identifiable[name], one.identifiable[name])


def test_the_same_samples_give_the_same_water(teal):
    samples = draw_samples(teal)
    a, b = (fit_medium(samples, SETTINGS, "srgb") for _ in range(2))
    assert torch.equal(a.beta_D, b.beta_D)
    assert torch.equal(a.std.Binf, b.std.Binf)


def test_swapping_channels_swaps_the_coefficients(teal):
    samples = draw_samples(teal)
    swapped = WaterSamples(
        samples.I.flip(-1), samples.ray_depth, samples.frame, samples.track, samples.open_water.flip(-1)
    )
    a, b = (fit_medium(s, SETTINGS, "srgb") for s in (samples, swapped))
    torch.testing.assert_close(a.beta_D, b.beta_D.flip(-1), rtol=1e-4, atol=1e-6)


def test_a_single_distance_identifies_no_attenuation(teal):
    fit = fit_medium(draw_samples(teal, spread=0.004), SETTINGS, "srgb")
    assert not fit.identifiable["beta_D"].any()
    assert not fit.identifiable["beta_B"].any()


def test_many_distances_identify_attenuation_and_what_is_identified_is_right(teal):
    fit = fit_medium(draw_samples(teal, spread=0.4, open_water=1000), SETTINGS, "srgb")
    assert fit.identifiable["beta_D"].all()
    assert ((fit.beta_D - teal.beta_D).abs() / teal.beta_D < 0.15).all()


def test_open_water_settles_the_veiling_light(teal):
    near = draw_samples(teal, spread=0.1)
    shown = draw_samples(teal, spread=0.1, open_water=1000)
    blind, seeing = (fit_medium(s, SETTINGS, "srgb") for s in (near, shown))
    assert (seeing.std.Binf < blind.std.Binf).all()
    assert ((seeing.Binf - teal.Binf).abs() < 0.03).all()


def test_backscatter_stays_below_the_dark_envelope_where_pixels_are_seen_once(teal):
    tracked = draw_samples(teal)
    samples = WaterSamples(
        tracked.I, tracked.ray_depth, tracked.frame, torch.full_like(tracked.track, -1), tracked.open_water
    )
    B = backscatter(samples.ray_depth, fit_medium(samples, SETTINGS, "srgb").at(samples.ray_depth))
    assert ((samples.I - B) < -0.03).float().mean() < 0.03


def test_ground_that_lacks_a_color_bounds_the_backscatter_of_that_color(teal):
    """Green leaves that are brighter than the darkest stones leave nothing of red and blue but the water."""
    g = np.random.default_rng(3)
    z = torch.from_numpy((2.5 * np.exp(g.normal(0, 0.15, 20_000))).astype(np.float32))
    J = g.uniform(0.15, 0.6, (len(z), 1)).repeat(3, 1)
    J[:1000] = (0.0, 0.6, 0.0)
    I = add_water(torch.from_numpy(J.astype(np.float32)), z, teal)
    once = torch.zeros(len(z), dtype=torch.long)
    fit = fit_medium(WaterSamples(I, z, once, once - 1, torch.zeros(0, 3)), SETTINGS, "srgb")
    too_bright = (backscatter(z, fit.at(z)) - backscatter(z, teal)).mean(0)
    assert too_bright[[0, 2]].abs().max() < 0.01  # 0.04 and 0.11 by the darkest of all channels together
    assert too_bright[1] > 0.05


def test_beta_D_is_the_curve_at_the_median_depth(teal):
    samples = draw_samples(teal)
    fit = fit_medium(samples, SETTINGS, "srgb")
    middle = samples.ray_depth.double().median().float()
    torch.testing.assert_close(fit.beta_D, fit.curve.at(middle), rtol=1e-3, atol=1e-5)


def test_surfaces_hundreds_of_times_as_far_as_the_rest_do_no_harm(teal):
    """T_D below the smallest number; numerical warnings are errors here."""
    near, g = draw_samples(teal, points=400), torch.Generator().manual_seed(0)
    far = torch.linspace(100.0, 2000.0, 1000)
    nothing = torch.zeros(len(far), dtype=torch.long)
    samples = WaterSamples(
        torch.cat([near.I, teal.Binf + 0.01 * torch.rand(len(far), 3, generator=g)]),
        torch.cat([near.ray_depth, far]),
        torch.cat([near.frame, nothing]),
        torch.cat([near.track, nothing - 1]),
        near.open_water,
    )
    T_D, B = errors(fit_medium(samples, SETTINGS, "srgb"), teal, near.ray_depth)
    assert T_D < 0.05
    assert B < 0.03


def gray_copy(samples: WaterSamples) -> WaterSamples:
    def gray(colors: torch.Tensor) -> torch.Tensor:
        return colors.mean(-1, keepdim=True).expand_as(colors).contiguous()

    return replace(samples, I=gray(samples.I), open_water=gray(samples.open_water), gray=True)


def test_distances_that_no_light_comes_back_from_say_nothing_of_the_surfaces():
    g = np.random.default_rng(2)
    z, J = np.linspace(0.3, 6, 4000), g.uniform(0.1, 0.7, 4000)
    Binf, beta_D, beta_B = 0.3, 2.0, 1.0
    I = J * np.exp(-beta_D * z) - Binf * np.expm1(-beta_B * z) + 0.004 * g.normal(0, 1, 4000)
    measured = np.ones(4000, dtype=bool)
    pixels = Pixels(I, daylight(z), np.zeros(4000, dtype=np.int64), np.full(300, Binf), measured)
    true = np.array([Binf, np.log(beta_B), np.log(beta_D), 0.0, 0.1, np.log(0.4)])
    averages = prior_residuals(true, evidence_of(pixels, SETTINGS), SETTINGS)[SETTINGS.range_bins : -5]
    assert np.abs(averages).max() < 0.2  # 1.7 where the logarithm of no light was compared


def test_of_a_gray_clip_one_channel_is_fitted_and_stands_for_all(teal, monkeypatch: pytest.MonkeyPatch):
    fitted = []

    def counted(*arguments):
        fitted.append(arguments)
        return fit_channel(*arguments)

    monkeypatch.setattr(seathru, "fit_channel", counted)
    samples = draw_samples(Medium(*(v.mean().expand(3) for v in vars(teal).values())), open_water=1000)
    fit = fit_medium(gray_copy(samples), SETTINGS, "srgb")
    assert len(fitted) == 1
    for value in (fit.Binf, fit.beta_D, fit.beta_B, fit.std.beta_D, fit.curve.a):
        assert torch.equal(value, value[:1].expand(3))
    assert torch.equal(fit.identifiable["beta_D"], torch.ones(3, dtype=torch.bool))
    fit_medium(samples, SETTINGS, "srgb")
    assert len(fitted) == 1 + 3


def test_too_few_pixels_are_an_error_in_plain_words(teal):
    samples = draw_samples(teal)
    few = WaterSamples(*(value[:20] for value in list(vars(samples).values())[:5]))
    with pytest.raises(InputError, match="20 pixels"):
        fit_medium(few, SETTINGS, "srgb")


def test_the_water_of_a_dive_is_estimated_from_its_frames(dive):
    fit = estimate_medium(dive.rec, dive.frames, SETTINGS, "srgb")
    T_D, B = errors(fit, dive.medium, torch.linspace(1.0, 4.0, 50))
    assert T_D < 0.05
    assert B < 0.03


@pytest.mark.shared
def test_backscatter_explains_the_darkest_pixels_of_real_frames(shared):
    """Mean |I - B| over the darkest 1 % of each of 10 range bins, eight FLSea frames, each fitted alone."""
    residuals = []
    for path in sorted((shared / "data/flsea_samples/rgb").glob("*.tiff")):
        image = cv2.imread(str(path))[::4, ::4, ::-1].astype(np.float32) / 255
        depth = cv2.imread(str(path.parents[1] / "depth" / f"{path.stem}_depth.tif"), cv2.IMREAD_UNCHANGED)[::4, ::4]
        I, z = torch.from_numpy(image[depth > 0]), torch.from_numpy(depth[depth > 0].astype(np.float32))
        alone = torch.zeros(len(z), dtype=torch.long)
        fit = fit_medium(WaterSamples(I, z, alone, alone - 1, torch.zeros(0, 3)), SETTINGS, "srgb")
        edges = torch.linspace(float(z.quantile(0.002)), float(z.quantile(0.998)), 11)
        bins = torch.bucketize(z, edges[1:-1])
        for k in bins.unique():
            inside = torch.nonzero(bins == k)[:, 0]
            darkest = inside[I[inside].mean(-1).argsort()[: max(1, len(inside) // 100)]]
            residuals.append((I[darkest] - backscatter(z[darkest], fit.at(z[darkest]))).abs().mean())
    assert len(residuals) > 60
    assert torch.stack(residuals).mean() < 0.02
