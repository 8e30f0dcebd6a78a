"""The head's water laid over a dive: with the true coefficients it restores the truth, in any unit."""

from dataclasses import replace
from pathlib import Path

import pytest
import torch

from swimm3r.errors import InputError
from swimm3r.medium import AttenuationCurve, Medium, remove_water
from swimm3r.scene.reconstruction import DenseCloud, Reconstruction
from swimm3r.scene.white_balance import WhiteBalance
from swimm3r.sfm.mast3r_sfm.network_frames import NetworkImages, network_images
from swimm3r.sfm.medium.dense_cloud import restored_points
from swimm3r.sfm.medium.dense_tracks import fuse_depth
from swimm3r.sfm.medium.from_head import PredictedWater, dive_fit, predicted_images, read, write
from swimm3r.sfm.medium.settings import SeathruSettings
from swimm3r.sfm.settings import Mast3rSettings
from swimm3r.sfm.student.physics_head import HeadFacts, WaterMaps
from swimm3r.splat.medium.prior import water_prior
from swimm3r.splat.settings import MediumFieldSettings


def off_by(share: float) -> HeadFacts:
    """A head whose coefficients were found to be off by that share."""
    return HeadFacts(0.05, Medium(*(torch.full((3,), share) for _ in range(3))))


SURE, UNMEASURED = off_by(0.01), HeadFacts(0.05)


@pytest.fixture
def images(dive) -> NetworkImages:
    return network_images(dive.frames, Mast3rSettings(size=96))


def maps(medium: Medium, images: NetworkImages, metres: float = 1.0) -> WaterMaps:
    """Predictions of a perfect head, per `metres` of the scene's unit; half of the attenuation in each exponential."""
    frame = images.framing
    half = (0.5 * metres * medium.beta_D).expand(1, frame.network_height, frame.network_width, 3)
    zero = torch.zeros_like(half)
    return WaterMaps(medium.Binf[None], metres * medium.beta_B[None], AttenuationCurve(half, zero, half, zero))


@pytest.fixture
def water(dive, images: NetworkImages, tmp_path: Path) -> PredictedWater:
    """Written by a head whose metre is half of the scene's unit: the scale puts it right."""
    for name in dive.rec.names:
        write(maps(dive.medium, images, metres=0.5), 0.5, tmp_path / "water", name)
    found = read(tmp_path / "water", images, SURE)
    assert found is not None
    return found


def with_cloud(rec: Reconstruction) -> Reconstruction:
    """The reconstruction with its sparse points for a cloud."""
    return replace(rec, cloud=DenseCloud(rec.points.xyz.float(), rec.points.rgb, rec.points.rgb))


def test_the_dives_water_is_what_the_frames_say(dive, water: PredictedWater):
    fit = dive_fit(water, dive.rec, SeathruSettings())
    for name in ("Binf", "beta_D", "beta_B"):
        torch.testing.assert_close(getattr(fit, name), getattr(dive.medium, name), atol=1e-4, rtol=1e-4)
        assert fit.identifiable[name].all()
    assert fit.encoding == "srgb"
    z = torch.linspace(*fit.z_range, 5)
    torch.testing.assert_close(fit.at(z).beta_D, dive.medium.beta_D.expand(5, 3), atol=1e-4, rtol=1e-4)


def test_a_coefficient_the_frames_disagree_on_is_not_identifiable(dive, images: NetworkImages, tmp_path: Path):
    for i, name in enumerate(dive.rec.names):
        other = replace(dive.medium, beta_B=dive.medium.beta_B * (1 + 0.5 * i))
        write(maps(other, images), 1.0, tmp_path, name)
    found = read(tmp_path, images, SURE)
    assert found is not None
    fit = dive_fit(found, dive.rec, SeathruSettings())
    assert not fit.identifiable["beta_B"].any()
    assert fit.identifiable["Binf"].all()


@pytest.mark.parametrize("facts", [UNMEASURED, off_by(0.3)])
def test_frames_that_agree_identify_nothing_unless_the_heads_own_error_is_small(dive, water, facts: HeadFacts):
    """A head that reads the same in every frame agrees with itself, right or wrong."""
    fit = dive_fit(replace(water, head=facts), dive.rec, SeathruSettings())
    assert not any(flags.any() for flags in fit.identifiable.values())


def test_the_maps_prior_trusts_the_water_as_far_as_the_heads_error_goes(dive, water: PredictedWater):
    def prior_std(facts: HeadFacts) -> torch.Tensor:
        fit = dive_fit(replace(water, head=facts), dive.rec, SeathruSettings())
        return water_prior(fit, 1.0, MediumFieldSettings()).std[3:]  # of the logarithms of beta_B and beta_D

    torch.testing.assert_close(prior_std(UNMEASURED), torch.ones(6), atol=1e-3, rtol=0)
    torch.testing.assert_close(prior_std(off_by(0.3)), torch.full((6,), 0.3), atol=1e-3, rtol=0)


def test_true_water_restores_the_cloud_to_its_clear_colors(dive, water: PredictedWater):
    tracks = fuse_depth(dive.rec, dive.frames, SeathruSettings().tracks)
    fit = dive_fit(water, dive.rec, SeathruSettings())
    cloud = restored_points(dive.rec, dive.frames, tracks, fit, medium_at=water.at)
    truth = dive.seafloor(cloud.xyz[:, :2])
    by_head = (cloud.restored - truth).abs().mean()
    assert by_head < 0.5 * (cloud.raw - truth).abs().mean()
    by_fit = restored_points(dive.rec, dive.frames, tracks, fit)  # takes the hue of the dive in what is hardly seen
    torch.testing.assert_close(cloud.restored, by_fit.restored, atol=0.015, rtol=0)
    assert (cloud.restored - by_fit.restored).abs().median() < 1e-3


def test_restored_images_are_clear(dive, water: PredictedWater):
    for i, restored in predicted_images(with_cloud(dive.rec), dive.frames, water):
        name, J = dive.rec.names[i], restored.clear
        known = dive.rec.depth[name].z_depth > 0
        raw = dive.frames.image(dive.frames.index(name))
        error = (J - dive.clear[i])[known].abs().mean()
        assert error < 0.3 * (raw - dive.clear[i])[known].abs().mean()


def test_shown_images_are_white_balanced_and_the_clear_ones_stay_physical(dive, water: PredictedWater):
    balance = WhiteBalance((1.5, 1.0, 0.7))
    plain = dict(predicted_images(with_cloud(dive.rec), dive.frames, water))
    for i, restored in predicted_images(replace(with_cloud(dive.rec), white_balance=balance), dive.frames, water):
        torch.testing.assert_close(restored.clear, plain[i].clear)
        surface = (restored.sea == 0) & (restored.clear > 0).all(-1) & (restored.clear < 0.6).all(-1)
        assert surface.float().mean() > 0.1
        torch.testing.assert_close(restored.shown[surface], restored.clear[surface] * balance.factors)


def test_restoration_divides_by_no_less_than_the_head_was_trained_with(dive, water: PredictedWater):
    half = replace(water, head=HeadFacts(0.5))
    i, restored = next(predicted_images(with_cloud(dive.rec), dive.frames, half))
    name, z = dive.rec.names[i], restored.ray_depth.flatten()
    image = dive.frames.image(dive.frames.index(name))
    J = remove_water(image.reshape(-1, 3), z, water.frame(name).at(z, water.place), 0.5).clamp(0, 1)
    surface = restored.sea == 0
    torch.testing.assert_close(restored.clear[surface], J.reshape(image.shape)[surface])
    tracks, fit = (
        fuse_depth(dive.rec, dive.frames, SeathruSettings().tracks),
        dive_fit(water, dive.rec, SeathruSettings()),
    )
    clouds = [
        restored_points(dive.rec, dive.frames, tracks, fit, medium_at=water.at, min_transmittance=eps).restored
        for eps in (0.05, 0.5)
    ]
    assert (clouds[1] < clouds[0] - 0.01).any()


def test_the_water_follows_the_pixels_through_resize_and_crop(dive, images: NetworkImages, tmp_path: Path):
    """A curve that grows from left to right does so on the prepared frame, too."""
    m = maps(dive.medium, images)
    ramp = torch.linspace(0.2, 1.0, images.framing.network_width)[:, None] * torch.ones_like(m.curve.a)
    write(replace(m, curve=replace(m.curve, a=ramp)), 1.0, tmp_path, "x.png")
    found = read(tmp_path, images, SURE)
    assert found is not None
    pixels = torch.arange(dive.frames.width)
    beta_D = found.at("x.png", pixels, torch.ones(len(pixels))).beta_D[:, 0] - 0.5 * dive.medium.beta_D[0]
    x = (pixels + 0.5) / dive.frames.width
    torch.testing.assert_close(beta_D[8:-8], (0.2 + 0.8 * x)[8:-8], atol=0.02, rtol=0)


def test_without_a_head_there_is_no_predicted_water(images: NetworkImages, tmp_path: Path):
    assert read(tmp_path / "nothing", images, UNMEASURED) is None


def test_without_any_depth_it_says_so(dive, water: PredictedWater, tmp_path: Path):
    from swimm3r.scene.reconstruction import DepthMaps

    with pytest.raises(InputError, match="no frame has any depth"):
        dive_fit(water, replace(dive.rec, depth=DepthMaps(tmp_path / "none")), SeathruSettings())
