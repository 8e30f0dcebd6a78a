"""Water that is not determined, or cannot be: it is said, and images do not pretend."""

from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
import torch

from swimm3r.appearance import FrameColors
from swimm3r.cameras import image_directions
from swimm3r.io import images
from swimm3r.lamp import Lamp
from swimm3r.medium import AttenuationCurve, Medium, MediumFit, remove_water
from swimm3r.scene.frames import Frames
from swimm3r.scene.reconstruction import DenseCloud
from swimm3r.scene.white_balance import WhiteBalance
from swimm3r.sfm.medium import apply, restore
from swimm3r.sfm.medium.dense_cloud import dense_cloud, restored_points
from swimm3r.sfm.medium.dense_tracks import fuse_depth
from swimm3r.sfm.medium.plausibility import (
    attenuation_is_a_guess,
    optical_depth,
    water_warnings,
    with_like_channels,
)
from swimm3r.sfm.medium.restore import (
    RestoredImage,
    display_gains,
    milder_gains,
    restore_image,
    white_balance,
    within_white,
)
from swimm3r.sfm.medium.settings import RestoreSettings, TrackSettings
from swimm3r.sfm.settings import ColmapSettings

TINT = torch.tensor([0.6, 1.0, 0.9])


def fit_of(medium: Medium, std: float, known: bool, z_range: tuple[float, float] = (1.0, 4.0)) -> MediumFit:
    """A fit whose optical depth at the middle of the depths has this standard deviation in every channel."""
    zero = torch.zeros(3)
    of_beta = torch.full((3,), std / (z_range[0] * z_range[1]) ** 0.5)
    flags = {name: torch.full((3,), known) for name in ("Binf", "beta_D", "beta_B")}
    curve = AttenuationCurve(medium.beta_D, zero, zero, zero)
    spread = Medium(zero, of_beta, zero)
    return MediumFit(**vars(medium), curve=curve, std=spread, identifiable=flags, z_range=z_range, encoding="srgb")


def said(fit: MediumFit, *, gray: bool = False) -> str:
    return " ".join(warning.what for warning in water_warnings(fit, gray=gray))


def test_water_that_is_determined_and_takes_red_first_raises_no_warning(teal):
    assert water_warnings(fit_of(teal, 0.05, known=True), gray=False) == ()


def backscatter_share(fit: MediumFit, mean_color: torch.Tensor) -> torch.Tensor:
    z = (fit.z_range[0] * fit.z_range[1]) ** 0.5
    return fit.Binf * (1 - torch.exp(-fit.beta_B * z)) / mean_color


def test_water_of_which_a_coefficient_is_determined_keeps_its_channels(teal):
    fit = fit_of(teal, 0.3, known=False)
    fit.identifiable["Binf"][2] = True
    assert with_like_channels(fit, TINT / 2) is fit


def test_channels_that_nothing_tells_apart_are_drawn_together_around_their_mean(teal):
    fit, color = fit_of(teal, 0.3, known=False), TINT / 2
    fit = replace(fit, std=replace(fit.std, Binf=torch.full((3,), 0.1)))
    alike = with_like_channels(fit, color)
    for before, after in (
        (optical_depth(fit)[0], optical_depth(alike)[0]),
        (backscatter_share(fit, color), backscatter_share(alike, color)),
    ):
        torch.testing.assert_close(after.mean(), before.mean())
        assert after.var() < before.var()
        assert after.argsort().tolist() == before.argsort().tolist()
    z = torch.tensor(2.0)
    torch.testing.assert_close(alike.curve.at(z), alike.beta_D)  # a constant curve follows its number


@pytest.mark.parametrize(("std", "factor"), [(1e-6, 1.0), (1e6, 0.0)])
def test_channels_without_error_stay_and_those_of_any_error_become_alike(teal, std: float, factor: float):
    fit, color = fit_of(teal, std, known=False), TINT / 2
    fit = replace(fit, std=replace(fit.std, Binf=torch.full((3,), std)))
    alike = with_like_channels(fit, color)
    before, after = optical_depth(fit)[0], optical_depth(alike)[0]
    torch.testing.assert_close(after - after.mean(), factor * (before - before.mean()), rtol=1e-3, atol=1e-4)
    share = backscatter_share(fit, color)
    expected = factor * (share - share.mean())
    found = backscatter_share(alike, color)
    torch.testing.assert_close(found - found.mean(), expected, rtol=1e-3, atol=1e-4)


def test_water_whose_backscatter_alone_is_told_has_one_color_where_it_ends(teal):
    z, B = torch.tensor(2.0), torch.tensor([0.05, 0.06, 0.06])
    beta_B = torch.tensor([0.01, 0.2, 0.5])
    fit = fit_of(replace(teal, Binf=B / -torch.expm1(-beta_B * z), beta_B=beta_B), 0.3, known=False)
    alike = with_like_channels(replace(fit, std=replace(fit.std, beta_B=100 * beta_B)), B * 5)
    assert fit.Binf[0] > 10 * fit.Binf[2]
    torch.testing.assert_close(alike.Binf / alike.Binf.sum(), B / B.sum(), rtol=1e-3, atol=0)
    torch.testing.assert_close(backscatter_share(alike, B * 5), torch.full((3,), 0.2), rtol=1e-3, atol=0)


def test_a_channel_without_light_or_backscatter_stays_finite(teal):
    dark = replace(teal, Binf=torch.tensor([0.0, 0.5, 0.4]))
    alike = with_like_channels(fit_of(dark, 0.3, known=False), torch.tensor([0.0, 0.5, 0.4]))
    for value in (alike.Binf, alike.beta_D, alike.curve.at(torch.tensor(2.0))):
        assert bool(value.isfinite().all())
        assert bool((value >= 0).all())


def test_a_surface_of_the_mean_color_keeps_its_hue_in_water_that_is_not_determined(teal):
    color, z = TINT / 2, torch.tensor(2.0)
    fit = fit_of(teal, 1e6, known=False)
    fit = replace(fit, std=replace(fit.std, Binf=torch.full((3,), 1e6)))
    alike = with_like_channels(fit, color)
    J = remove_water(color, z, alike.at(z))
    torch.testing.assert_close(J / J.sum(), color / color.sum())


def test_the_optical_depth_does_not_depend_on_the_unit_of_length(teal):
    longer = Medium(teal.Binf, teal.beta_D / 10, teal.beta_B / 10)
    one, ten = fit_of(teal, 0.3, known=True), fit_of(longer, 0.3, known=True, z_range=(10.0, 40.0))
    for a, b in zip(optical_depth(one), optical_depth(ten), strict=True):
        torch.testing.assert_close(a, b)
    torch.testing.assert_close(optical_depth(one)[0], 2 * teal.beta_D)
    torch.testing.assert_close(optical_depth(one)[1], torch.full((3,), 0.3))


def test_attenuation_that_is_a_guess_in_every_channel_is_said_with_its_size_and_advice(teal):
    warning = water_warnings(fit_of(teal, 0.9, known=False), gray=False)[0]
    assert "factor of up to 2.5" in warning.what
    assert "as filmed" in warning.what
    assert "near and from far" in warning.advice
    assert "adapter" in water_warnings(fit_of(teal, 0.9, known=False), gray=False, predicted=True)[0].advice
    one_known = fit_of(teal, 0.9, known=False)
    one_known.std.beta_D[1] = 0.01
    assert not attenuation_is_a_guess(one_known)


def test_curves_without_a_determined_coefficient_are_said_to_give_no_true_colors(teal):
    fit = fit_of(teal, 0.1, known=False)
    assert not attenuation_is_a_guess(fit)
    assert "not balanced to gray" in said(fit)
    assert "11% uncertain" in said(fit)
    fit.identifiable["beta_D"][2] = True
    assert said(fit) == ""


def test_attenuation_that_linear_light_leaves_open_in_every_channel_is_said(teal):
    fit, linear = fit_of(teal, 0.05, known=True), fit_of(teal, 0.05, known=True)
    assert water_warnings(fit, gray=False, linear=linear) == ()
    linear.identifiable["beta_D"][:] = False
    (warning,) = water_warnings(fit, gray=False, linear=linear)
    assert "attenuation is not determined in any color channel" in warning.what
    assert "near and from far" in warning.advice


@pytest.mark.parametrize("known", [True, False])
def test_red_attenuated_least_is_implausible_in_every_natural_water(teal, known: bool):
    odd = Medium(teal.Binf, torch.tensor([0.03, 0.04, 0.05]), teal.beta_B)
    assert "red least" in said(fit_of(odd, 0.1, known=known))
    coastal = Medium(teal.Binf, torch.tensor([0.3, 0.25, 0.6]), teal.beta_B)  # dissolved matter takes blue first
    assert "red least" not in said(fit_of(coastal, 0.1, known=known))
    assert "red least" not in said(fit_of(odd, 0.1, known=known), gray=True)


def written(dive, fit: MediumFit, folder: Path, monkeypatch: pytest.MonkeyPatch) -> dict[str, np.ndarray]:
    """The dive's frame 2 as filmed, physically restored and as shown, 0..1, where this is the water found."""
    monkeypatch.setattr(apply, "fit_medium", lambda *_: fit)
    monkeypatch.setattr(apply, "dense_cloud", lambda *given: tinted(dense_cloud(*given)))
    apply.with_water(dive.rec, dive.frames, ColmapSettings(), folder)
    name = f"{dive.rec.names[2]}.png"
    physical = cv2.imread(str(folder / "restored_physical" / name), cv2.IMREAD_UNCHANGED)
    assert physical is not None
    return {
        "filmed": dive.frames.image(2).numpy(),
        "physical": physical[..., ::-1] / 65535,
        "shown": images.read_rgb(folder / "restored" / name) / 255,
    }


def tinted(cloud: DenseCloud) -> DenseCloud:
    """As under the light that reaches a few metres of depth."""
    return replace(cloud, restored=cloud.restored * TINT)


def test_where_attenuation_is_a_guess_frames_are_shown_as_filmed(dive, tmp_path: Path, monkeypatch):
    found = written(dive, fit_of(dive.medium, 0.9, known=False), tmp_path, monkeypatch)
    assert abs(found["shown"] - found["filmed"]).max() < 1 / 255
    assert abs(found["physical"] - found["filmed"]).mean() > 0.02  # what a map starts on: the inverse of its water


def test_the_cloud_as_shown_has_the_mean_color_of_the_restored_frames(dive, tmp_path: Path, monkeypatch):
    """And of the frames as filmed where those are shown."""
    monkeypatch.setattr(apply, "dense_cloud", lambda *given: tinted(dense_cloud(*given)))
    monkeypatch.setattr(restore, "restore_image", lambda *given: tinted_image(restore_image(*given), given[5]))
    for std in (0.1, 0.9):
        monkeypatch.setattr(apply, "fit_medium", lambda *_, std=std: fit_of(dive.medium, std, known=std < 0.5))
        rec = apply.with_water(dive.rec, dive.frames, ColmapSettings(), tmp_path)
        assert rec.cloud is not None
        known = [(dive.rec.depth[name].z_depth > 0).numpy() for name in rec.names]
        shown = [images.read_rgb(tmp_path / "restored" / f"{name}.png") / 255 for name in rec.names]
        of_frames = np.concatenate([image[k] for image, k in zip(shown, known, strict=True)]).mean(0)
        of_cloud = rec.cloud.shown(rec.white_balance).numpy().mean(0)
        assert abs(of_cloud / of_frames - 1).max() < 0.05
        other = rec.cloud.restored if std < 0.5 else rec.cloud.shown(replace(rec.white_balance, source="restored"))
        assert abs(other.numpy().mean(0) / of_frames - 1).max() > 0.1


def tinted_image(image: RestoredImage, gains: torch.Tensor) -> RestoredImage:
    clear = image.clear * TINT
    return replace(image, clear=clear, shown=(clear * gains).clamp(0, 1))


def test_where_nothing_of_the_water_is_determined_frames_are_not_balanced_to_neutral_grays(
    dive, tmp_path: Path, monkeypatch
):
    unsure = written(dive, fit_of(dive.medium, 0.1, known=False), tmp_path, monkeypatch)
    assert abs(unsure["shown"] - unsure["filmed"]).mean() > 0.02
    sure = written(dive, fit_of(dive.medium, 0.1, known=True), tmp_path, monkeypatch)
    assert abs(sure["shown"] - unsure["shown"]).mean() > 0.01


FILMED = torch.linspace(0.1, 0.5, 300)[:, None]


@pytest.mark.parametrize(
    ("filmed", "restored", "shown"),
    [
        ((1, 1, 1), (1.4, 1, 0.8), (1, 1, 1)),  # balanced for the water by the camera
        ((1, 1, 1.2), (1.4, 1, 1), None),  # beside gray
        ((0.6, 1, 1), (0.8, 1, 1), (0.8, 1, 1)),  # on its way to gray, as far as the water explains
        ((0.6, 1, 1), (1.5, 1, 1), (1, 1, 1)),  # through gray
        ((1, 1, 0.8), (1, 1, 0.6), (1, 1, 0.8)),  # away from gray
    ],
)
def test_hues_of_undetermined_water_are_the_grayest_between_filmed_and_restored(filmed, restored, shown):
    a, b = (torch.tensor(tint, dtype=torch.float32) for tint in (filmed, restored))
    found = b * milder_gains(FILMED * a, FILMED * b)
    hue = [tint.log() - tint.log().mean() for tint in (a, b, found)]
    assert hue[2].norm() <= min(hue[0].norm(), hue[1].norm()) + 1e-4
    along = (hue[2] - hue[0]).norm() + (hue[1] - hue[2]).norm()
    assert along == pytest.approx(float((hue[1] - hue[0]).norm()), abs=1e-4)  # on the line between the two
    if shown is not None:
        c = torch.tensor(shown, dtype=torch.float32)
        torch.testing.assert_close(found / found.mean(), c / c.mean(), atol=2e-3, rtol=0)
    torch.testing.assert_close(found.log().mean(), b.log().mean(), atol=1e-4, rtol=0)  # as bright


def test_gains_need_water_that_is_determined_and_somebody_who_wants_them(dive):
    fit = fit_of(dive.medium, 0.1, known=True)
    cloud = restored_points(dive.rec, dive.frames, fuse_depth(dive.rec, dive.frames, TrackSettings()), fit)
    rec = replace(dive.rec, medium=fit, cloud=cloud)
    torch.testing.assert_close(white_balance(rec, RestoreSettings()).factors, display_gains(cloud.restored))
    assert white_balance(rec, RestoreSettings(white_balance=False)) == WhiteBalance()
    unsure = replace(rec, medium=fit_of(dive.medium, 0.1, known=False))
    torch.testing.assert_close(
        white_balance(unsure, RestoreSettings()).factors, milder_gains(cloud.raw, cloud.restored)
    )
    assert white_balance(unsure, RestoreSettings(white_balance=False)) == WhiteBalance()
    guessed = replace(rec, medium=fit_of(dive.medium, 0.9, known=False))
    assert white_balance(guessed, RestoreSettings()) == WhiteBalance(source="filmed")
    lit = replace(guessed, medium=under_a_lamp(guessed.medium))
    assert white_balance(lit, RestoreSettings(white_balance=False)) == WhiteBalance()
    hues = [brightest(cloud.restored) * white_balance(lit, RestoreSettings()).factors, brightest(cloud.raw)]
    torch.testing.assert_close(hues[0] / hues[0].mean(), hues[1] / hues[1].mean(), atol=1e-3, rtol=0)


def under_a_lamp(fit: MediumFit) -> MediumFit:
    """The same water under a lamp whose light falls to the right."""
    beam = torch.tensor([-1.5, 0.0, 0.0, 0.0, 0.0, 0.0])
    return replace(fit, lamp=Lamp(torch.tensor([0.2, -0.1, 0.0]), 2.0, 2 / 2.2, 1.0, beam, torch.zeros(6)))


def brightest(colors: torch.Tensor) -> torch.Tensor:
    return (colors[(colors < 0.99).all(-1)] ** 6).mean(0) ** (1 / 6)


def test_where_attenuation_is_a_guess_under_a_lamp_frames_are_shown_evenly_lit(dive, tmp_path: Path, monkeypatch):
    fit = under_a_lamp(fit_of(dive.medium, 0.9, known=False))
    assert "evenly lit" in said(fit)
    found = written(dive, fit, tmp_path, monkeypatch)
    ratio = (found["shown"] / found["filmed"].clip(0.02)).mean((0, 2))  # by column
    third = len(ratio) // 3
    assert ratio[-third:].mean() > 1.2 * ratio[:third].mean()


def test_a_gray_clip_is_called_gray_and_stays_gray(dive, tmp_path: Path):
    gray = []
    for i, frame in enumerate(dive.frames):
        image = dive.frames.image(i).mean(-1, keepdim=True).expand(-1, -1, 3)
        images.write_rgb(tmp_path / frame.name, image.numpy())
        gray.append(replace(frame, path=tmp_path / frame.name))
    frames = Frames(tuple(gray), dive.frames.width, dive.frames.height, ordered=True, gray=True)
    rec = apply.with_water(dive.rec, frames, ColmapSettings(), tmp_path)
    assert [warning.what.startswith("The frames are gray") for warning in rec.warnings].count(True) == 1
    assert rec.cloud is not None
    assert rec.medium is not None
    torch.testing.assert_close(rec.medium.beta_D, rec.medium.beta_D[:1].expand(3))
    torch.testing.assert_close(rec.cloud.restored[:, 0], rec.cloud.restored[:, 2])
    shown = images.read_rgb(tmp_path / "restored" / f"{rec.names[2]}.png").astype(int)
    assert abs(shown[..., 0] - shown[..., 2]).max() <= 1


@pytest.mark.parametrize("times", [1.0, 3.0])
def test_colors_brighter_than_white_in_a_common_exposure_get_one_common_gain(dive, times):
    names = tuple(dive.rec.names)
    colors = FrameColors(names, torch.eye(3, 4).repeat(len(names), 1, 1) / times)
    rec = replace(dive.rec, medium=fit_of(dive.medium, 0.1, known=True), own_colors=colors)
    frames, balance = rec.evened(dive.frames), WhiteBalance((0.8, 0.9, 0.85))
    found = within_white(rec, frames, balance)
    gain = found.factors / balance.factors
    torch.testing.assert_close(gain, gain[:1].expand(3))

    def beyond_white(balance: WhiteBalance) -> float:
        rays = image_directions(rec.cameras[0]).float()
        shown = restore_image(frames.image(0), rec.depth[names[0]], rays, rec.medium, gains=balance.factors).shown
        return float((shown.amax(-1) > 0.999).float().mean())

    assert (float(gain[0]) < 0.99) == (times > 1)
    assert beyond_white(found) < 0.02
    assert times == 1 or beyond_white(balance) > 3 * beyond_white(found)


def test_colors_shown_as_filmed_get_no_common_gain(dive):
    rec = replace(dive.rec, medium=fit_of(dive.medium, 0.1, known=True))
    assert within_white(rec, dive.frames, WhiteBalance(source="filmed")) == WhiteBalance(source="filmed")
