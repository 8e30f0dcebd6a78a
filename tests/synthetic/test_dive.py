import json
from dataclasses import replace

import numpy as np
import pytest
import torch

from swimm3r.appearance import shading_gains
from swimm3r.cameras import directions, pixel_grid, project, unproject
from swimm3r.errors import InputError, UsageError
from swimm3r.io import images
from swimm3r.medium import add_water, linear_from_srgb
from swimm3r.scene.ground_truth import read_ground_truth
from swimm3r.synthetic import Coefficients, DiveSettings, make_dive, write_dive
from swimm3r.synthetic.disturbances import swimming
from swimm3r.synthetic.dive import water
from swimm3r.synthetic.raycast import cast
from swimm3r.synthetic.seafloor import height_at

QUIET = DiveSettings(frames=24, width=120, height=80, noise=0.0)
FISHY = replace(QUIET, moving_object=True)


@pytest.fixture(scope="module")
def dive():
    return make_dive(QUIET)


@pytest.fixture(scope="module")
def fishy(dive):
    return replace(dive, settings=FISHY)


@pytest.fixture(scope="module")
def frames(dive):
    return [dive.frame(i) for i in range(0, 24, 4)]


def test_images_are_the_clear_scene_seen_through_the_water(dive, frames):
    for frame in frames:
        hit = frame.z_depth > 0
        expected = add_water(frame.clear, frame.ray_depth, dive.medium)
        torch.testing.assert_close(frame.raw[hit], expected[hit], rtol=0, atol=1e-7)


def test_open_water_shows_the_veiling_light_and_is_in_view_in_most_frames(dive, frames):
    for frame in frames:
        open_water = frame.z_depth == 0
        assert (frame.raw[open_water] == dive.medium.Binf).all()
        assert (frame.clear[open_water] == 0).all()
    assert np.mean([(frame.z_depth == 0).float().mean() > 0.03 for frame in frames]) > 0.6


def test_every_frame_shows_near_and_far(frames):
    for frame in frames:
        seen = frame.ray_depth[frame.ray_depth > 0]
        assert 0.5 < seen.min() < 2.0
        assert 5.0 < seen.max() < 12.0


def test_points_of_one_frame_lie_at_the_depth_that_another_sees_or_behind_it(dive):
    i, j = 5, 7
    frame, surface = dive.frame(i), dive.floor.surface
    hit = frame.z_depth > 0
    grid = pixel_grid(QUIET.height, QUIET.width).double()
    points = unproject(dive.cameras[i], grid[hit][None], frame.z_depth[hit].double()[None])
    pixels, z = project(dive.cameras[j], points)
    inside = ((pixels > 0) & (pixels < torch.tensor([QUIET.width, QUIET.height]))).all(-1)[0]
    pose = dive.cameras.cam2world[j].numpy()
    rays = directions(dive.cameras[j], pixels)[0, inside].numpy() @ pose[:3, :3].T
    origin = pose[:3, 3] - [surface.x0, surface.y0, 0]
    seen = np.array([cast(surface.height, surface.pyramid, surface.cell, origin, ray, 0.0) for ray in rays])
    ratio = seen / z[0, inside].numpy()
    assert inside.sum() > 5000
    # z_depth is float32: a ray that grazes a crest may pass over it by a hair
    assert (ratio < 1 + 1e-5).mean() > 0.998
    assert (np.abs(ratio - 1) < 1e-5).mean() > 0.85


def test_hits_lie_on_the_seafloor(dive, frames):
    grid = pixel_grid(QUIET.height, QUIET.width).double()
    hit = frames[0].z_depth > 0
    points = unproject(dive.cameras[0], grid[hit][None], frames[0].z_depth[hit].double()[None])[0].numpy()
    residual = points[:, 2] - height_at(dive.floor, points[:, 0], points[:, 1])
    assert np.abs(residual).max() < 1e-5  # z_depth is float32, and rocks are steep


def test_cameras_keep_clear_of_the_floor_and_revisit_where_they_began(dive):
    x, y, z = dive.cameras.centers.T.numpy()
    assert (z - height_at(dive.floor, x, y) > 0.35).all()
    steps = dive.cameras.centers.diff(dim=0).norm(dim=-1)
    assert (dive.cameras.centers[0] - dive.cameras.centers[-1]).norm() < 1.5 * steps.max()
    R = dive.cameras.cam2world[:, :3, :3]
    torch.testing.assert_close(R @ R.mT, torch.eye(3).double().expand(24, 3, 3))
    assert (torch.linalg.det(R) > 0).all()


def test_one_seed_is_one_dive_and_another_seed_another(frames, seafloors):
    seafloors.cache_clear()
    again = make_dive(replace(QUIET, noise=0.01, marine_snow=30))
    assert torch.equal(again.frame(8).clear, frames[2].clear)
    assert torch.equal(again.frame(8).raw, again.frame(8).raw)
    assert (make_dive(replace(QUIET, seed=1)).frame(8).z_depth - frames[2].z_depth).abs().mean() > 0.1


def test_nothing_but_the_masked_pixels_shows_the_fish(dive, fishy):
    shown = 0
    for i in (0, 11, 14):
        with_fish, without = fishy.frame(i), dive.frame(i)
        changed = (with_fish.raw - without.raw).abs().amax(-1) > 0
        assert not (changed & with_fish.usable).any()
        assert torch.equal(with_fish.z_depth, without.z_depth)
        assert torch.equal(with_fish.clear, without.clear)
        hidden = ~with_fish.usable
        shown += int(hidden.sum())
        if hidden.any():
            assert changed[hidden].float().mean() > 0.95
    assert shown > 200


def test_the_fish_swims_across_the_scene_steadily_and_above_ground(dive):
    there = [swimming(dive.floor, share, QUIET.seed) for share in np.linspace(0, 1, 33)]
    middle = torch.stack([fish.middle for fish in there])
    steps = middle.diff(dim=0)
    assert 0.9 < (middle[-1] - middle[0]).norm() < 1.5
    assert steps.norm(dim=-1).max() < 0.08
    assert steps.diff(dim=0).norm(dim=-1).max() < 0.01
    assert (middle[:, 2].numpy() > height_at(dive.floor, *middle[:, :2].T.numpy()) + 0.2).all()
    for fish, step in zip(there, steps, strict=False):
        torch.testing.assert_close(fish.axes @ fish.axes.mT, torch.eye(3).double())
        assert torch.nn.functional.cosine_similarity(fish.axes[0], step, dim=0) > 0.9


def test_noise_has_the_strength_that_was_asked_for(dive, frames):
    noisy = replace(dive, settings=replace(QUIET, noise=0.02)).frame(0)
    residual = noisy.raw - frames[0].raw
    assert float(residual.std()) == pytest.approx(0.02, rel=0.05)
    assert float(residual.mean()) == pytest.approx(0.0, abs=0.001)


def test_vignetting_darkens_the_corners_and_spares_the_middle(dive, frames):
    ratio = replace(dive, settings=replace(QUIET, vignetting=0.4)).frame(0).raw / frames[0].raw
    torch.testing.assert_close(ratio[40, 60], torch.ones(3), atol=1e-3, rtol=0)
    torch.testing.assert_close(ratio[0, 0], torch.full((3,), 0.6), atol=0.02, rtol=0)


def test_marine_snow_brightens_few_pixels(dive, frames):
    change = replace(dive, settings=replace(QUIET, marine_snow=20)).frame(0).raw - frames[0].raw
    touched = change.abs().amax(-1) > 0.02
    assert 20 <= touched.sum() < 0.2 * touched.numel()
    assert change[touched].amax(-1).mean() > 0.05


def test_caustics_move_over_a_floor_that_stays(dive):
    sunny = replace(dive, settings=replace(QUIET, caustics=0.6))
    first, second = sunny.frame(0), dive.frame(0)
    assert torch.equal(first.z_depth, second.z_depth)
    assert torch.equal(first.clear, second.clear)  # the truth is of still light
    change = (first.raw - second.raw)[first.z_depth > 0]
    assert change.abs().mean() > 0.01
    assert change.mean().abs() < 0.03  # light is moved about, not added


def test_water_can_be_drawn_from_a_family_or_given():
    given = water(replace(QUIET, coefficients=Coefficients(Binf=(0.2, 0.3, 0.4))))
    torch.testing.assert_close(given.Binf, torch.tensor([0.2, 0.3, 0.4]))
    assert water(replace(QUIET, family="warm")).Binf[0] >= 0.2


def test_a_written_dive_is_read_back_as_its_truth(fishy, tmp_path, monkeypatch):
    monkeypatch.setattr("swimm3r.synthetic.dive.make_seafloor", lambda *_: fishy.floor)  # seconds saved
    settings = replace(FISHY, frames=2, width=60, height=40, noise=0.0, give_masks=True)
    seen = []
    write_dive(settings, tmp_path, lambda what, done, total: seen.append((what, done, total)))
    dive, truth = make_dive(settings), read_ground_truth(tmp_path / "truth")
    assert seen == [("rendering", 0, 2), ("rendering", 1, 2), ("rendering", 2, 2)]
    assert truth.names == dive.names
    assert truth.metric
    torch.testing.assert_close(truth.cameras.cam2world, dive.cameras.cam2world)
    assert truth.medium is not None
    torch.testing.assert_close(truth.medium.beta_D, dive.medium.beta_D)
    for i, name in enumerate(truth.names):
        frame = dive.frame(i)
        z_depth, clear = truth.z_depth(name), truth.clear(name)
        assert z_depth is not None
        assert clear is not None
        assert torch.equal(z_depth, frame.z_depth)
        torch.testing.assert_close(clear, frame.clear, atol=0.5 / 255 + 1e-6, rtol=0)
        stored = images.read_rgb(tmp_path / "images" / name).astype(np.float32) / 255
        torch.testing.assert_close(torch.from_numpy(stored), frame.raw.clamp(0, 1), atol=0.5 / 255 + 1e-6, rtol=0)
        for folder in (tmp_path / "masks", tmp_path / "truth" / "masks"):
            assert (images.read_mask(folder / f"{name}.png") == frame.usable.numpy()).all()


def test_a_folder_with_anything_else_in_it_is_refused(tmp_path):
    settings = replace(QUIET, frames=2, width=60, height=40)
    (tmp_path / "mine" / "images").mkdir(parents=True)
    (tmp_path / "mine" / "images" / "0000.png").write_text("of somebody else, under a dive's own name")
    write_dive(replace(settings, seed=1), tmp_path / "other")
    for folder in (tmp_path / "mine", tmp_path / "other"):
        before = {path: path.read_bytes() for path in folder.rglob("*") if path.is_file()}
        with pytest.raises(InputError, match="holds other things than this dive"):
            write_dive(settings, folder)
        assert {path: path.read_bytes() for path in folder.rglob("*") if path.is_file()} == before


def test_a_dive_that_was_interrupted_is_made_whole(tmp_path):
    def interrupt(what: str, done: int, total: int, /) -> None:
        if done == 1:
            raise KeyboardInterrupt

    settings = replace(QUIET, frames=2, width=60, height=40)
    with pytest.raises(KeyboardInterrupt):
        write_dive(settings, tmp_path, interrupt)
    assert not (tmp_path / "images" / "0001.png").exists()
    write_dive(settings, tmp_path)
    assert (tmp_path / "images" / "0001.png").is_file()


@pytest.mark.parametrize(
    "wrong", [{"frames": 0}, {"fov": 200.0}, {"noise": -0.1}, {"vignetting": 1.5}, {"width": 4}, {"seed": -1}]
)
def test_settings_out_of_range_are_refused_by_name(wrong):
    with pytest.raises(UsageError, match="got"):
        replace(QUIET, **wrong)


def test_a_water_that_gains_light_is_refused():
    with pytest.raises(UsageError, match="beta_D"):
        Coefficients(beta_D=(-0.1, 0.2, 0.2))


def test_a_dive_that_is_there_already_is_left_alone(tmp_path):
    settings = DiveSettings(frames=2, width=64, height=48)
    write_dive(settings, tmp_path)
    before = {path: path.stat().st_mtime_ns for path in tmp_path.rglob("*")}
    write_dive(settings, tmp_path)
    assert {path: path.stat().st_mtime_ns for path in tmp_path.rglob("*")} == before


def test_a_camera_that_maps_tones_by_place_changes_gains_over_its_frames(dive, frames):
    mapped = replace(dive, settings=replace(QUIET, local_exposure=0.4))
    seen, still = linear_from_srgb(mapped.frame(0).raw), linear_from_srgb(frames[0].raw)
    told = shading_gains(mapped.shading(0), *seen.shape[:2]).permute(1, 2, 0)
    unclipped = (seen < 0.99).all(-1)
    torch.testing.assert_close(seen[unclipped], (still * told)[unclipped], atol=1e-5, rtol=1e-4)
    stops = torch.stack([shading_gains(mapped.shading(i), 60, 80).log2() for i in range(200)])
    assert float(stops.square().mean().sqrt()) == pytest.approx(0.4, rel=0.1)
    assert torch.equal(mapped.frame(0).clear, frames[0].clear)


def test_a_camera_that_exposes_by_itself_multiplies_the_light_and_says_by_what(dive, frames, tmp_path):
    jittery = replace(dive, settings=replace(QUIET, exposure=0.5, white_balance=0.15))
    by_frame = torch.stack([jittery.gains(i) for i in range(len(dive))])
    assert (by_frame[:, 1] >= 2**-0.5).all()
    assert (by_frame[:, 1] <= 2**0.5).all()
    assert ((by_frame[:, [0, 2]] / by_frame[:, 1:2] - 1).abs() <= 0.15 + 1e-6).all()
    assert by_frame[:, 1].log2().std() > 0.2
    seen, still = linear_from_srgb(jittery.frame(0).raw), linear_from_srgb(frames[0].raw)
    unclipped = (seen < 0.99).all(-1)
    torch.testing.assert_close(seen[unclipped], (still * by_frame[0])[unclipped], atol=1e-5, rtol=1e-4)
    assert torch.equal(jittery.frame(0).clear, frames[0].clear)
    written = replace(QUIET, frames=2, exposure=0.5)
    write_dive(written, tmp_path)
    stored = json.loads((tmp_path / "truth/gains.json").read_text())
    assert stored["0001.png"] == make_dive(written).gains(1).tolist()
