"""The paper's protocol on a map that is exactly known."""

from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
import torch

import swimm3r
from swimm3r.cameras import pixel_grid
from swimm3r.errors import InputError, RegistrationError, WeightsError
from swimm3r.geometry import rotation_angle
from swimm3r.imaging.turned_rows import half_time_pixels
from swimm3r.localization.batch import Query, answer, match_image
from swimm3r.localization.localizer import STAGES, Localizer
from swimm3r.localization.matchers import Mast3rMatcher, SiftMatcher, matcher_for
from swimm3r.localization.references import rendered
from swimm3r.localization.settings import LocalizationSettings, with_checkpoint_of
from swimm3r.sfm.features.settings import FeatureSettings
from swimm3r.sfm.mast3r import checkpoint
from swimm3r.sfm.mast3r.settings import MatchingSettings
from swimm3r.sfm.settings import ColmapSettings, Mast3rSettings
from swimm3r.splat.medium.field import initial_field
from swimm3r.splat.primitives.beta import with_time
from swimm3r.splat.settings import InitialSettings
from swimm3r.splat.training_poses import RefinedPoses

SETTINGS = LocalizationSettings(matcher="sift", candidates=3, features=FeatureSettings(count=800))


def off(found: torch.Tensor, truth: torch.Tensor) -> tuple[float, float]:
    """Degrees and scene units between two poses."""
    turn = rotation_angle(found[:3, :3].double().mT @ truth[:3, :3])
    return float(torch.rad2deg(turn)), float((found[:3, 3] - truth[:3, 3]).norm())


@pytest.fixture(scope="module")
def localizer(place) -> Localizer:
    return Localizer(place.scene, place.rec, place.frames, SETTINGS)


@pytest.mark.parametrize("i", [2, 4])
def test_a_held_out_frame_is_placed(place, localizer: Localizer, i: int):
    found = localizer.locate(place.frames.image(i))
    degrees, distance = off(found.cam2world, place.cameras.cam2world[i])
    assert degrees < 0.1
    assert distance < 0.005
    assert found.stage == "refined"
    assert found.inliers > 50
    assert found.reprojection_px is not None
    assert found.reprojection_px < 0.5
    assert set(found.candidates) < set(place.rec.names)
    assert set(found.seconds) == set(STAGES)


@pytest.mark.parametrize("i", [2, 4])
def test_a_query_of_a_camera_that_turned_while_it_was_exposed_is_placed_with_its_turn(place, i: int):
    turn = np.array([0.015, -0.02, 0.0])  # about the view axis, 5 pixels from edge to edge tell little
    camera, image = place.cameras[i], place.frames.image(i).numpy()
    pixels = half_time_pixels(camera, pixel_grid(camera.height, camera.width).reshape(-1, 2).double(), turn) - 0.5
    column, row = pixels.float().reshape(camera.height, camera.width, 2).numpy().transpose(2, 0, 1)
    filmed = torch.from_numpy(cv2.remap(image, column, row, cv2.INTER_CUBIC, borderMode=cv2.BORDER_REPLICATE))
    at_rest = Localizer(place.scene, place.rec, place.frames, SETTINGS)
    turning = Localizer(place.scene, place.rec, replace(place.frames, rows_rectified=True), SETTINGS)
    found, still = turning.locate(filmed.clamp(0, 1)), at_rest.locate(filmed.clamp(0, 1))
    degrees, distance = off(found.cam2world, place.cameras.cam2world[i])
    degrees_still, distance_still = off(still.cam2world, place.cameras.cam2world[i])
    assert degrees < 0.3 * degrees_still
    assert distance < 0.3 * distance_still
    assert found.stage == "refined"
    assert found.turn is not None
    np.testing.assert_allclose(found.turn[:2], turn[:2], atol=0.002)
    assert still.turn is None
    assert turning.locate(filmed.clamp(0, 1), lens=camera).turn is None  # of another camera, which may be still


def test_the_reference_farthest_away_is_the_least_like(place, localizer: Localizer):
    assert "5.png" not in localizer.locate(place.frames.image(2)).candidates


def test_the_map_alone_is_enough(place):
    pose = swimm3r.localize(place.frames.image(2), place.scene, place.rec, settings=SETTINGS)
    degrees, distance = off(pose, place.cameras.cam2world[2])
    assert degrees < 0.1
    assert distance < 0.005


def test_poses_are_those_of_the_reconstruction_even_where_the_maps_training_moved_all_cameras(place):
    shift = torch.tensor([0.5, -0.2, 0.1], dtype=torch.float64)
    poses = place.rec.cameras.cam2world.clone()
    poses[:, :3, 3] += shift
    p = place.scene.primitives
    moved = replace(
        place.scene, primitives=p._replace(xyz=p.xyz + shift.float()), poses=RefinedPoses(place.rec.names, poses)
    )
    image = place.frames.image(2)
    true = place.cameras.cam2world[2]
    assert off(swimm3r.localize(image, moved, place.rec, place.frames, settings=SETTINGS), true)[1] < 0.005
    in_map = Localizer(moved, place.rec, place.frames, SETTINGS).locate(image).cam2world
    assert off(in_map, true)[1] == pytest.approx(float(shift.norm()), abs=0.005)


def test_a_dynamic_map_is_shown_at_the_images_time_and_half_way_through_the_clip_where_nobody_knows(place):
    p = with_time(place.scene.primitives, InitialSettings(time_scale=0.4), torch.Generator().manual_seed(0))
    field = initial_field(None, place.scene.settings.medium, torch.Generator().manual_seed(0), dynamic=True)
    scene = replace(
        place.scene, primitives=p, field=field, settings=replace(place.scene.settings, dynamic=True), span=(0.0, 1.0)
    )
    lens = place.cameras[2]
    shown = {time: rendered(scene, lens, 0, 0.5, time).rgb for time in (0.0, 0.5, None)}
    assert torch.equal(shown[None], shown[0.5])
    assert (shown[0.0] - shown[0.5]).abs().max() > 0.05


def test_a_smaller_copy_of_a_image_is_placed_and_another_shape_needs_its_lens(place, localizer: Localizer):
    image = place.frames.image(2).permute(2, 0, 1)[None]
    half = torch.nn.functional.interpolate(image, (135, 180), mode="area")[0].permute(1, 2, 0).contiguous()
    degrees, _ = off(localizer.locate(half).cam2world, place.cameras.cam2world[2])
    assert degrees < 0.2
    with pytest.raises(InputError, match="its lens is of images of 240 x 180"):
        localizer.locate(place.frames.image(2)[:, :200])


def test_a_image_of_something_else_is_refused(localizer: Localizer):
    noise = torch.rand(180, 240, 3, generator=torch.Generator().manual_seed(3))
    with pytest.raises(RegistrationError, match="could not be placed"):
        localizer.locate(noise)
    failed = answer(localizer, Query("noise.png", 0.0, noise))
    assert failed.found is None
    assert "could not be placed" in failed.reason


def test_without_a_good_rendering_the_coarse_pose_stands(place, localizer: Localizer):
    hollow = Localizer(
        place.scene, place.rec, place.frames, LocalizationSettings(min_alpha=1.0, matcher="sift", candidates=3)
    )
    found = hollow.locate(place.frames.image(2))
    assert found.stage == "coarse"
    assert found.reprojection_px is None
    assert off(found.cam2world, place.cameras.cam2world[2])[0] < 1.0


@pytest.mark.parametrize("i", [2, 4])
def test_a_pose_from_a_rough_rendering_does_not_replace_a_better_one(place, i: int):
    p, rng = place.scene.primitives, torch.Generator().manual_seed(0)
    rough = replace(place.scene, primitives=p._replace(xyz=p.xyz + 0.01 * torch.randn(p.xyz.shape, generator=rng)))
    kept, replaced = (
        Localizer(rough, place.rec, place.frames, settings).locate(place.frames.image(i))
        for settings in (SETTINGS, replace(SETTINGS, accept="inliers"))
    )
    assert (kept.stage, replaced.stage) == ("coarse", "refined")
    error, other = (off(f.cam2world, place.cameras.cam2world[i])[0] for f in (kept, replaced))
    assert error < 0.6 * other


def test_masked_pixels_take_no_part(place):
    matcher = SiftMatcher(SETTINGS)
    left = torch.zeros(180, 240, dtype=torch.bool)
    left[:, :120] = True
    assert (matcher.describe(place.frames.image(2), left).xy[:, 0] < 120).all()


def test_the_network_finds_the_image_itself_and_matches_within_both_images(place, small_network):
    matcher = Mast3rMatcher(small_network, replace(SETTINGS, matching=MatchingSettings(subsample=32)))
    everywhere = torch.ones(180, 240, dtype=torch.bool)
    described = {
        name: matcher.describe(place.frames.image(place.frames.index(name)), everywhere) for name in place.rec.names
    }
    likeness = matcher.index(place.rec.names, described.__getitem__)
    for k, name in enumerate(place.rec.names):
        assert int(likeness(described[name]).argmax()) == k
    xy_a, xy_b = matcher.match(described["1.png"], described["3.png"])
    assert len(xy_a) == len(xy_b) > 0
    for xy in (xy_a, xy_b):
        assert ((xy > 0) & (xy < torch.tensor([240.0, 180.0]))).all()


def test_the_network_is_loaded_as_the_settings_say(small_network, tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    path = tmp_path / "own.safetensors"
    checkpoint.save(small_network, path)
    named = LocalizationSettings(weights=path, device="cpu", precision="bfloat16")
    matcher = matcher_for(named)
    assert isinstance(matcher, Mast3rMatcher)
    assert matcher.network.patch_embed.proj.weight.dtype == torch.bfloat16
    monkeypatch.setenv("SWIMM3R_WEIGHTS_DIR", str(tmp_path / "none"))
    monkeypatch.setenv("SWIMM3R_CACHE", str(tmp_path / "none"))
    assert isinstance(matcher_for(LocalizationSettings()), SiftMatcher)
    with pytest.raises(WeightsError, match="no weights at"):
        matcher_for(LocalizationSettings(weights=tmp_path / "missing.pth"))


def test_a_run_lends_the_checkpoint_that_found_its_poses():
    found, own = Path("found.pth"), LocalizationSettings(weights=Path("own.pth"))
    by_network = Mast3rSettings(weights=found)
    assert with_checkpoint_of(LocalizationSettings(), by_network).weights == found
    assert with_checkpoint_of(own, by_network) == own
    assert with_checkpoint_of(LocalizationSettings(), ColmapSettings()) == LocalizationSettings()


def test_a_match_image_shows_both_and_joins_inliers(localizer: Localizer, place):
    evidence = localizer.locate(place.frames.image(2)).evidence
    assert evidence is not None
    image = match_image(evidence)
    assert image.shape == (180, 480, 3)
    plain = (torch.cat([evidence.query, evidence.rendering], 1).clamp(0, 1) * 255).round().numpy()
    assert (abs(image - plain).max(-1) > 30).mean() > 0.01
