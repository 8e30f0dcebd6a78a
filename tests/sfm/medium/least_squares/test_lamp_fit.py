"""A lamp's light from points that a moving camera sees, with the truth of the synthetic dive's lamp."""

from dataclasses import replace

import numpy as np
import pytest
import torch
from torch.nn.functional import normalize

from swimm3r.errors import InputError
from swimm3r.io.medium_json import load_medium
from swimm3r.lamp import LightEvidence, log_light
from swimm3r.medium import MediumFit, add_water, backscatter, remove_water, rescale, transmittances
from swimm3r.sfm.medium.least_squares.lamp_fit import image_parts, noise_by_light, of_average_color, seen_nearby
from swimm3r.sfm.medium.light import judge_light, share_to_explain
from swimm3r.sfm.medium.samples import WaterSamples
from swimm3r.sfm.medium.seathru import fit_medium
from swimm3r.sfm.medium.settings import SeathruSettings
from swimm3r.synthetic.lamp_light import lamp_backscatter, lamp_of, light_on
from swimm3r.synthetic.settings import LampSettings

SETTINGS = SeathruSettings()
LAMP = lamp_of(LampSettings(strength=1.0))


def lamp_samples(
    medium,
    *,
    points: int = 700,
    views: int = 8,
    open_water: int = 400,
    nearest: tuple[float, float] = (1.2, 3.7),
    spread: float = 0.7,
    across: float = 2.0,
) -> tuple[WaterSamples, dict]:
    """Points seen `views` times each from 1 to 6 m at any place of the image, with pixel noise of 0.004.

    `nearest` is the range of the points' least distances, `spread` the logarithm of a point's largest over its least,
    `across` the part of the image's width, which is 2, that points move over as their frames sway.
    """
    g = torch.Generator().manual_seed(7)
    count = points * views
    track = torch.arange(points).repeat_interleave(views)
    frame = torch.randint(0, 32, (count,), generator=g)
    place = 2 * torch.rand(count, 2, generator=g) - 1
    if across < 2:
        column = (2 - across) * (torch.rand(points, generator=g) - 0.5)
        place[:, 0] = column[track] + (across * (torch.rand(32, generator=g) - 0.5))[frame]
    rays = torch.cat([place * torch.tensor([0.53, 0.36]), torch.ones(count, 1)], -1)
    near = nearest[0] + (nearest[1] - nearest[0]) * torch.rand(points, generator=g)
    z = near[track] * torch.exp(spread * torch.rand(count, generator=g))
    gray = 0.1 + 0.7 * torch.rand(points, 1, generator=g)
    gray[torch.rand(points, generator=g) < 0.03] = 0.0
    J = (gray * (0.8 + 0.4 * torch.rand(points, 3, generator=g)))[track]
    light = light_on(rays[None], z[None], LAMP, medium)[0]
    glow = lamp_backscatter(rays[None], z[None], LAMP, medium)[0]
    I = J * light * transmittances(z, medium)[0] + glow
    I = (I + 0.004 * torch.randn(I.shape, generator=g)).clamp(0, 1)
    sea_rays = rays[:open_water]
    sea = lamp_backscatter(sea_rays[None], torch.zeros(1, len(sea_rays)), LAMP, medium)[0]
    sea = sea + 0.004 * torch.randn(sea.shape, generator=g)
    direction, toward = normalize(rays, dim=-1), normalize(sea_rays, dim=-1)
    samples = WaterSamples(I, z, frame, track, sea, direction=direction, water_direction=toward)
    return samples, {"J": J, "light": light, "backscatter": glow}


@pytest.fixture(scope="module")
def water(request):
    medium = request.getfixturevalue("teal")
    return replace(medium, Binf=0.35 * medium.Binf)


@pytest.fixture(scope="module")
def drawn(water):
    return lamp_samples(water)


@pytest.fixture(scope="module")
def fit(drawn):
    return fit_medium(drawn[0], SETTINGS, "srgb", "lamp")


def test_attenuation_and_backscatter_are_recovered_under_a_lamp(drawn, water, fit):
    samples, truth = drawn
    z = samples.ray_depth
    T_D = transmittances(z, fit.at(z))[0] - transmittances(z, water)[0]
    B = backscatter(z, fit.at(z, samples.direction)) - truth["backscatter"]
    assert T_D.abs().mean(0).max() < 0.03
    assert B.abs().mean(0).max() < 0.02


def test_the_light_is_recovered_up_to_its_strength(drawn, fit):
    samples, _ = drawn
    points = samples.direction * samples.ray_depth[:, None]
    off = log_light(points, fit.lamp) - log_light(points, LAMP)
    assert off.std() < 0.005


def test_surfaces_reflect_half_on_average_and_a_few_bright_ones_do_not_change_that(drawn, fit):
    samples, _ = drawn
    points = samples.direction * samples.ray_depth[:, None]
    off = log_light(points, fit.lamp) - log_light(points, LAMP)
    assert float(off.mean()) == pytest.approx(np.log(0.43 * SETTINGS.lsac_f), abs=0.15)  # 0.43 is the mean of J
    bright = (samples.track < 7)[:, None]  # one of a hundred, of which many have J beyond 1
    shining = replace(samples, I=torch.where(bright, (2.5 * samples.I).clamp(max=0.97), samples.I))
    found = fit_medium(shining, SETTINGS, "srgb", "lamp")
    assert abs(np.log(found.lamp.strength / fit.lamp.strength)) < 0.05


def test_a_strength_that_went_astray_follows_the_average_color(fit):
    log_means = np.log([0.02, 0.025, 0.02])  # of a lamp e^3 times as strong, of clear colors around 0.5
    found = of_average_color(replace(fit.lamp, strength=float(np.exp(3.0))), log_means, SETTINGS)
    change = np.log(found.strength) - 3.0
    assert np.log(found.strength) == pytest.approx(0.0, abs=0.2)
    assert np.exp(log_means - change).mean() == pytest.approx(1 / SETTINGS.lsac_f, rel=0.15)
    off = [
        (np.log(found.strength) + d) ** 2
        + np.sum((log_means - change - d + np.log(SETTINGS.lsac_f)) ** 2) / SETTINGS.mean_reflectance_std**2
        for d in (-0.05, 0.0, 0.05)
    ]
    assert off[1] < min(off[0], off[2])


def test_points_seen_from_afar_alone_are_left_out():
    rows, point = np.array([4, 1, 2, 0, 3]), np.array([0, 0, 1, 2, 2])
    z = np.array([0.5, 2.0, 1.8, 1.9, 1.0])
    kept, numbered = seen_nearby(rows, point, z)
    assert kept.tolist() == [4, 1, 0, 3]
    assert numbered.tolist() == [0, 0, 1, 1]


def test_colors_are_restored_evenly_lit(drawn, fit):
    samples, truth = drawn
    medium = fit.at(samples.ray_depth, samples.direction)
    told = truth["light"] * transmittances(samples.ray_depth, fit.at(samples.ray_depth))[0] > 0.1
    J = remove_water(samples.I, samples.ray_depth, medium)
    gain = (J * truth["J"])[told].sum() / J[told].square().sum()
    assert (gain * J - truth["J"])[told].abs().mean() < 0.03
    torch.testing.assert_close(add_water(J, samples.ray_depth, medium)[told], samples.I[told], rtol=0, atol=1e-4)
    assert float(np.quantile(J[told], 0.98)) < 1.05


def test_level_ground_seen_from_one_height_is_restored_evenly_lit(water):
    samples, truth = lamp_samples(water, open_water=0, nearest=(2.0, 2.0), spread=0.03)
    fit = fit_medium(samples, SETTINGS, "srgb", "lamp")
    told = truth["light"].amin(-1) > 0.1
    J = remove_water(samples.I, samples.ray_depth, fit.at(samples.ray_depth, samples.direction))
    gain = (J * truth["J"])[told].sum(0) / J[told].square().sum(0)
    assert (gain * J - truth["J"])[told].abs().mean() < 0.03
    assert not fit.identifiable["beta_D"].any()


def evenness(samples: WaterSamples, J_true: torch.Tensor) -> float:
    """Largest over least share of the true clear colors in columns of the images."""
    fit = fit_medium(samples, SETTINGS, "srgb", "lamp")
    J = remove_water(samples.I, samples.ray_depth, fit.at(samples.ray_depth, samples.direction))
    column = (samples.direction[:, 0] / samples.direction[:, 2] / 0.53 * 3 + 3).long().clamp(0, 5)
    shares = torch.stack([(J / J_true)[(column == k) & (J_true.amin(-1) > 0.1)].median() for k in range(6)])
    return float(shares.max() / shares.min())


@pytest.mark.parametrize("change", [0.0, 0.05])
def test_a_strip_along_one_axis_is_restored_evenly_lit_whatever_beam_its_exposures_tell_of(water, change: float):
    """Exposures that change by 5 % had led to clear colors 6 times as bright at one side as at the other."""
    level = {"open_water": 0, "nearest": (2.0, 2.0), "spread": 0.03}
    samples, truth = lamp_samples(water, points=1000, views=5, across=0.04, **level)
    exposure = (change * torch.randn(32, generator=torch.Generator().manual_seed(1))).exp()
    assert evenness(replace(samples, I=samples.I * exposure[samples.frame, None]), truth["J"]) < 1.35


def test_the_reference_point_has_the_lamps_light_and_far_water_on_the_axis_the_veiling_light(fit):
    axis, z = torch.tensor([0.0, 0.0, 1.0]), torch.tensor(fit.lamp.reference)
    unlit, lit = fit.at(z), fit.at(z, axis)
    way = torch.linalg.vector_norm(axis * z - fit.lamp.position.float())
    share = transmittances(z, lit)[0] / (transmittances(z, unlit)[0] * torch.exp(-unlit.beta_D * way))
    torch.testing.assert_close(share, log_light(axis * z, fit.lamp).exp().expand(3).float())
    far = torch.tensor(15 * fit.lamp.reference)
    torch.testing.assert_close(backscatter(far, fit.at(far, axis)), fit.Binf, rtol=0.02, atol=0)


def test_the_form_that_maps_give_backscatter_is_near_to_light_scattered_once(drawn, fit):
    samples, _ = drawn
    z, direction = samples.ray_depth, samples.direction
    lit = fit.at(z, direction)
    of_map = fit.open_water(direction) * -torch.expm1(-fit.beta_B * z[:, None])
    off = (of_map - backscatter(z, lit)) / transmittances(z, lit)[0]
    told = transmittances(z, lit)[0] > 0.1
    assert off[told].abs().mean() < 0.015  # in clear colors
    far = backscatter(torch.full_like(z, 15 * fit.lamp.reference), fit.at(15 * fit.lamp.reference + 0 * z, direction))
    assert (fit.open_water(direction) - far).abs().mean() < 0.005


def test_a_lamp_is_not_told_from_single_pixels(drawn):
    samples, _ = drawn
    alone = replace(samples, track=torch.full_like(samples.track, -1))
    with pytest.raises(InputError, match="lamp"):
        fit_medium(alone, SETTINGS, "srgb", "lamp")


def test_a_lamp_is_not_told_from_points_seen_from_afar_alone(drawn):
    samples, _ = drawn
    z = samples.ray_depth
    beyond = torch.where(torch.arange(len(z)) % 8 < 6, z.clamp(max=1.0), 3 * z)
    afar = replace(samples, ray_depth=beyond, track=torch.where(beyond > 1, samples.track, -1))
    with pytest.raises(InputError, match="lamp"):
        fit_medium(afar, SETTINGS, "srgb", "lamp")


def test_a_lamp_is_kept_in_the_file_of_the_water(fit, tmp_path):
    evidence = LightEvidence("lamp", 0.5, 0.2, 1200)
    replace(fit, light=evidence).save(tmp_path / "medium.json")
    again = load_medium(tmp_path / "medium.json")
    assert isinstance(again, MediumFit)
    assert again.light == evidence
    z, axis = torch.tensor([2.0, 4.0]), normalize(torch.tensor([[0.1, 0.2, 1.0], [0.0, 0.0, 1.0]]), dim=-1)
    for found, kept in zip(vars(again.at(z, axis)).values(), vars(fit.at(z, axis)).values(), strict=True):
        torch.testing.assert_close(found, kept.float(), rtol=1e-4, atol=1e-5)


def test_stretching_the_scene_leaves_the_images_of_a_lamp(fit):
    z, axis = torch.tensor([2.0, 4.0]), normalize(torch.tensor([[0.1, 0.2, 1.0], [0.0, 0.0, 1.0]]), dim=-1)
    near, far = fit.at(z, axis), rescale(fit, 5.0).at(5 * z, axis)
    torch.testing.assert_close(transmittances(5 * z, far)[0], transmittances(z, near)[0])
    torch.testing.assert_close(backscatter(5 * z, far), backscatter(z, near))


def test_image_parts_hold_about_as_many_pixels_each():
    g = torch.Generator().manual_seed(1)
    rays = torch.cat([torch.rand(2400, 2, generator=g) ** 2, torch.ones(2400, 1)], -1)
    part = image_parts(normalize(rays, dim=-1).double().numpy())
    counts = np.bincount(part)
    assert len(counts) == 24
    assert counts.min() > 60
    assert counts.max() < 140
    assert image_parts(np.tile([[0.0, 0.0, 1.0]], (9, 1))).max() == 0


def test_a_lamp_is_told_from_the_sun_by_the_light_of_points(drawn, water):
    samples, truth = drawn
    sunlit = add_water(truth["J"], samples.ray_depth, water)
    daylight = replace(samples, I=sunlit, open_water=torch.zeros(0, 3), water_direction=torch.zeros(0, 3))
    for light, seen in (("lamp", samples), ("sun", daylight)):
        evidence = judge_light(seen, fit_medium(seen, SETTINGS, "srgb"), SETTINGS)
        assert evidence.light == light


def rough(samples: WaterSamples, share: float) -> WaterSamples:
    """Samples whose colors are off by a share of themselves, as patches of ground seen from several places are."""
    g = torch.Generator().manual_seed(3)
    return replace(samples, I=(samples.I * (share * torch.randn(len(samples.I), 1, generator=g)).exp()).clamp(0, 1))


def dark_corners(samples: WaterSamples, J: torch.Tensor, water, share: float) -> WaterSamples:
    """The same ground in daylight, through a lens that takes a share of the light from the corners."""
    sunlit = add_water(J, samples.ray_depth, water)
    corner = (samples.direction[:, :2] / samples.direction[:, 2:]).square().sum(-1) / (0.53**2 + 0.36**2)
    darkened = sunlit * (1 - share * corner)[:, None]
    return replace(samples, I=darkened, open_water=torch.zeros(0, 3), water_direction=torch.zeros(0, 3))


def judged(samples: WaterSamples) -> LightEvidence:
    evidence = judge_light(samples, fit_medium(samples, SETTINGS, "srgb"), SETTINGS)
    assert evidence is not None
    return evidence


def told_power(evidence: LightEvidence) -> tuple[float, float]:
    assert evidence.fall_off is not None
    assert evidence.fall_off_std is not None
    return evidence.fall_off, evidence.fall_off_std


@pytest.mark.parametrize("share", [0.25, 0.55])
def test_the_corners_of_a_lens_are_not_taken_for_a_lamp(drawn, water, share: float):
    samples, truth = drawn
    assert judged(dark_corners(samples, truth["J"], water, share)).light == "sun"


def test_a_pattern_that_explains_little_is_a_lamps_where_the_light_falls_with_distance(drawn, water):
    samples, truth = drawn
    lit, lens = (judged(rough(one, 0.15)) for one in (samples, dark_corners(samples, truth["J"], water, 0.55)))
    assert SETTINGS.lamp_explained < lit.explained < SETTINGS.lamp_alone
    assert lens.explained > SETTINGS.lamp_explained
    assert (lit.light, lens.light) == ("lamp", "sun")
    assert told_power(lens)[0] < SETTINGS.lamp_fall_off < told_power(lit)[0]


def test_over_level_ground_a_pattern_alone_tells_a_lamp_if_it_is_strong(water):
    samples, _ = lamp_samples(water, spread=0.0)
    strong, weak = judged(samples), judged(rough(samples, 0.2))
    assert (strong.fall_off, weak.fall_off) == (None, None)
    assert strong.explained > SETTINGS.lamp_alone > weak.explained > SETTINGS.lamp_explained
    assert (strong.light, weak.light) == ("lamp", "sun")


def test_the_error_of_the_power_is_told_by_groups_of_frames(drawn):
    samples, _ = drawn
    exposure = (0.3 * torch.randn(32, 1, generator=torch.Generator().manual_seed(2))).exp()
    noisy = rough(replace(samples, I=samples.I * (0.5 * exposure).clamp(max=1)[samples.frame]), 0.15)
    (steady, std), (changing, larger) = (told_power(judged(one)) for one in (samples, noisy))
    assert 0 < std < 0.5 * larger
    assert abs(steady - changing) < 0.2


def test_two_frames_tell_no_power(drawn):
    samples, _ = drawn
    assert judged(replace(samples, frame=samples.frame % 2)).fall_off is None


@pytest.mark.parametrize(
    ("fall_off", "std", "share"),
    [
        (None, None, SETTINGS.lamp_alone),
        (0.5, 2.0, SETTINGS.lamp_alone),
        (1.6, 2.0, SETTINGS.lamp_alone),
        (3.2, 1.5, SETTINGS.lamp_explained),
        (1.2, 0.1, SETTINGS.lamp_explained),
        (0.2, 0.1, np.inf),
        (-0.7, 0.3, np.inf),
    ],
)
def test_a_pattern_must_explain_more_where_the_power_does_not_tell(fall_off, std, share):
    assert share_to_explain(fall_off, std, SETTINGS) == share


def test_noise_is_told_apart_from_what_goes_with_the_light():
    rng = np.random.default_rng(0)
    light = np.exp(rng.uniform(np.log(1e-3), np.log(0.5), 20_000))
    true = np.hypot(0.002, 0.03 * light)
    found = noise_by_light(true * rng.standard_normal(len(light)), light, 0.02)
    assert np.abs(np.log(found / true)).max() < 0.1
    outliers = np.where(rng.random(len(light)) < 0.05, 0.3, 0.0)
    assert (
        np.abs(np.log(noise_by_light(true * rng.standard_normal(len(light)) + outliers, light, 0.02) / true)).max()
        < 0.2
    )
    assert noise_by_light(100 * true, light, 0.02).max() == 0.02
    assert noise_by_light(np.zeros_like(light), light, 0.02).min() > 0
