"""Depth by plane sweep on scenes whose depth is known in closed form: textured planes, pinhole and bent lenses."""

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import get_args

import numpy as np
import pytest
import torch
from jaxtyping import Float
from torch import Tensor

from swimm3r.cameras import Cameras, image_directions, project, unproject
from swimm3r.imaging.gray import LUMA
from swimm3r.imaging.undistortion import covering_pinholes
from swimm3r.io import images
from swimm3r.scene.frames import Frame, Frames
from swimm3r.scene.reconstruction import DepthMaps, Matches, Points, Reconstruction, Tracks
from swimm3r.sfm.plane_sweep import estimate
from swimm3r.sfm.plane_sweep import sweep as sweep_of_a_view
from swimm3r.sfm.plane_sweep.estimate import consistent, estimate_depth
from swimm3r.sfm.plane_sweep.settings import PlaneSweepSettings
from swimm3r.sfm.plane_sweep.sweep import RawDepth, sweep
from swimm3r.sfm.plane_sweep.views import (
    SweepView,
    choose_sources,
    depth_range,
    gray_weights,
    make_view,
    points_by_frame,
)
from swimm3r.tasks import EngineSettings

WIDTH, HEIGHT = 128, 96
STEPS = get_args(estimate.Step)
MIDDLE = (slice(16, -16), slice(24, -24))  # what enough sources see
SETTINGS = PlaneSweepSettings(sources=3, planes=48, threads=1, speck=16)
FRONTAL, SLANTED = (0.0, 0.0, 4.0), (0.45, -0.3, 4.0)  # the plane Z = a X + b Y + c in world axes


def texture(X: np.ndarray, Y: np.ndarray) -> np.ndarray:
    """A smooth image without repetition on a surface, from waves down to 6 pixels long."""
    rng = np.random.default_rng(3)
    value = np.zeros_like(X)
    for _ in range(60):
        length, angle, phase = rng.uniform(0.2, 0.8), *rng.uniform(0, 2 * np.pi, 2)
        value += np.sin(2 * np.pi / length * (np.cos(angle) * X + np.sin(angle) * Y) + phase)
    return 0.5 + 0.02 * value


def dive(model: str = "PINHOLE", distortion: tuple[float, ...] = ()) -> Cameras:
    """Five cameras 0.25 apart that look along +z."""
    poses = torch.eye(4, dtype=torch.float64).repeat(5, 1, 1)
    poses[:, 0, 3] = torch.tensor([-0.5, -0.25, 0.0, 0.25, 0.5])
    poses[:, 1, 3] = torch.tensor([0.0, 0.1, 0.0, -0.1, 0.0])
    K = torch.tensor([[110.0, 0, WIDTH / 2], [0, 110.0, HEIGHT / 2], [0, 0, 1]], dtype=torch.float64).repeat(5, 1, 1)
    return Cameras(K, torch.tensor([distortion] * 5, dtype=torch.float64).reshape(5, -1), poses, WIDTH, HEIGHT, model)


def z_of_plane(camera: Cameras, plane: tuple[float, float, float]) -> Float[Tensor, "h w"]:
    """Exact z depth of Z = a X + b Y + c in an unrotated camera."""
    a, b, c = plane
    rays, center = image_directions(camera), camera.centers[0]
    return (a * center[0] + b * center[1] + c - center[2]) / (1 - a * rays[..., 0] - b * rays[..., 1])


def photograph(camera: Cameras, plane: tuple[float, float, float]) -> Float[Tensor, "h w 3"]:
    """The textured plane as the camera sees it, without noise."""
    points = image_directions(camera) * z_of_plane(camera, plane)[..., None] + camera.centers[0]
    gray = torch.from_numpy(texture(points[..., 0].numpy(), points[..., 1].numpy())).float()
    return gray.clamp(0, 1)[..., None].expand(-1, -1, 3).contiguous()


def views_of(plane: tuple[float, float, float], change: tuple[float, float] = (1.0, 0.0)) -> list[SweepView]:
    """All views of the plane; every one but the middle has its brightness changed to gain * value + offset."""
    cameras, everywhere = dive(), torch.ones(HEIGHT, WIDTH, dtype=torch.bool)
    canvas = covering_pinholes(cameras, 640)
    views = []
    for i in range(5):
        gain, offset = (1.0, 0.0) if i == 2 else change
        image = gain * photograph(cameras[i], plane) + offset
        views.append(make_view(image @ LUMA, everywhere, cameras[i], canvas[i]))
    return views


def middle_depth(views: list[SweepView], settings: PlaneSweepSettings = SETTINGS) -> RawDepth:
    return sweep(views[2], [views[i] for i in (0, 1, 3, 4)], (2.0, 9.0), settings)


def reconstruction(cameras: Cameras, plane: tuple[float, float, float], folder: Path) -> Reconstruction:
    """Exact poses, and points of the plane tracked in every frame that shows them."""
    y, x = torch.meshgrid(torch.arange(5.5, HEIGHT, 8), torch.arange(5.5, WIDTH, 8), indexing="ij")
    xy = torch.stack([x, y], -1).reshape(1, -1, 2).double()
    z = z_of_plane(cameras[2], plane)[xy[0, :, 1].long(), xy[0, :, 0].long()]
    xyz = unproject(cameras[2], xy, z[None])[0]
    pixels, _ = project(cameras, xyz.expand(5, -1, -1))
    frame, point = ((pixels > 0) & (pixels < torch.tensor([WIDTH, HEIGHT]))).all(-1).nonzero(as_tuple=True)
    none = torch.zeros(0, dtype=torch.long)
    return Reconstruction(
        tuple(f"{i}.png" for i in range(5)),
        cameras,
        Points(xyz, torch.zeros(len(xyz), 3), torch.zeros(len(xyz))),
        Tracks(point, frame, pixels[frame, point]),
        Matches(none, none, torch.zeros(0, 2), torch.zeros(0, 2), torch.zeros(0)),
        DepthMaps(folder / "z_depth"),
        "truth",
    )


def frames_on_disk(
    cameras: Cameras,
    plane: tuple[float, float, float],
    folder: Path,
    change: Callable[[Float[Tensor, "h w 3"]], Float[Tensor, "h w 3"]] = torch.clone,
) -> Frames:
    made = []
    for i in range(5):
        path = folder / f"{i}.png"
        images.write_rgb(path, change(photograph(cameras[i], plane)).numpy())
        made.append(Frame(path.name, path, float(i), 0.0, "train"))
    return Frames(tuple(made), WIDTH, HEIGHT, ordered=True)


def relative_error(found: Tensor, true: Tensor) -> Tensor:
    known = found > 0
    return ((found[known] - true[known]).abs() / true[known]).double()


@pytest.mark.parametrize("plane", [FRONTAL, SLANTED])
def test_depth_of_a_textured_plane_is_right_almost_everywhere(plane: tuple[float, float, float]):
    raw = middle_depth(views_of(plane)).inverse_depth
    error = relative_error(torch.where(raw > 0, 1 / raw, 0.0), z_of_plane(dive()[2], plane))
    assert (raw > 0)[MIDDLE].double().mean() > 0.9
    assert error.median() < 0.003
    assert error.quantile(0.95) < 0.02


def test_contrast_lost_and_light_added_in_the_sources_change_nothing():
    noiseless = replace(SETTINGS, noise=1e-5)  # what is allowed for noise is an absolute amount
    as_taken = middle_depth(views_of(SLANTED), noiseless).inverse_depth
    faded = middle_depth(views_of(SLANTED, change=(0.6, 0.3)), noiseless).inverse_depth
    both = (as_taken > 0) & (faded > 0)
    assert both[MIDDLE].double().mean() > 0.9
    assert ((as_taken - faded).abs() / as_taken)[both].quantile(0.95) < 0.001


def test_the_same_views_give_the_same_depth_bit_for_bit():
    views = views_of(SLANTED)
    assert torch.equal(middle_depth(views).inverse_depth, middle_depth(views).inverse_depth)


def test_wide_windows_tell_the_depth_of_a_texture_that_noise_hides_from_small_ones(monkeypatch):
    generator = torch.Generator().manual_seed(0)
    cameras, canvas = dive(), covering_pinholes(dive(), 640)
    everywhere = torch.ones(HEIGHT, WIDTH, dtype=torch.bool)

    def faint(i: int) -> SweepView:
        image = 0.3 + 0.05 * photograph(cameras[i], SLANTED)
        noise = 1.2 / 255 * torch.randn(HEIGHT, WIDTH, 1, generator=generator)
        return make_view((image + noise) @ LUMA, everywhere, cameras[i], canvas[i])

    views = [faint(i) for i in range(5)]
    raw = middle_depth(views).inverse_depth
    error = relative_error(torch.where(raw > 0, 1 / raw, 0.0), z_of_plane(cameras[2], SLANTED))
    monkeypatch.setattr(sweep_of_a_view, "_FAINT", 0.0)
    without = middle_depth(views).inverse_depth
    assert (raw > 0)[MIDDLE].double().mean() > 2 * (without > 0)[MIDDLE].double().mean()
    assert torch.equal(raw[without > 0], without[without > 0])
    assert error.median() < 0.015
    assert error.quantile(0.95) < 0.05


def test_open_water_stays_unknown():
    generator = torch.Generator().manual_seed(0)
    water = [
        replace(view, detail=0.5 / 255 * torch.randn(HEIGHT, WIDTH, generator=generator)) for view in views_of(FRONTAL)
    ]
    assert (middle_depth(water).inverse_depth > 0).double().mean() < 0.01


def test_a_depth_no_other_frame_shares_is_dropped_and_a_shared_one_stays():
    cameras = dive()
    canvas = covering_pinholes(cameras, 640)
    true = [1 / z_of_plane(cameras[i], SLANTED).float() for i in range(5)]
    wrong = true[2].clone()
    wrong[40:60, 40:80] *= 1.1
    sure = torch.ones(HEIGHT, WIDTH)
    others = [RawDepth(true[i], sure) for i in (0, 1, 3, 4)]
    kept = consistent(RawDepth(wrong, sure), others, canvas[[2, 0, 1, 3, 4]], 0.5, SETTINGS)
    assert (kept.inverse_depth[42:58, 42:78] == 0).all()
    assert (kept.inverse_depth[10:30, 30:90] > 0).all()
    assert (kept.correlation[kept.inverse_depth == 0] == 0).all()


def test_ground_in_one_source_alone_is_judged_by_that_source():
    cameras = dive()
    cameras.cam2world[:, 0, 3] *= 5  # 1.25 apart at a depth of 4: 34 pixels
    canvas = covering_pinholes(cameras, 640)
    everywhere = torch.ones(HEIGHT, WIDTH, dtype=torch.bool)
    views = [make_view(photograph(cameras[i], FRONTAL) @ LUMA, everywhere, cameras[i], canvas[i]) for i in (0, 1, 3, 4)]
    raw = sweep(views[0], views[1:], (3.0, 5.5), replace(SETTINGS, min_ncc=0.6))  # two of the three sources count
    q = raw.inverse_depth[12:-12, 45:95]
    assert (q > 0).double().mean() > 0.8
    assert ((4 * q[q > 0] - 1).abs() < 0.01).double().mean() > 0.9
    assert raw.correlation[12:-12, 45:95][q > 0].median() > 0.9


def test_a_lone_source_says_no_more_than_when_it_is_given_twice_or_beside_one_that_sees_nothing():
    views = views_of(SLANTED)
    noise = torch.randn(HEIGHT, WIDTH, generator=torch.Generator().manual_seed(0))
    lone = replace(views[1], detail=views[1].detail + 0.15 * noise)  # of middling correlation
    blind = replace(lone, seen=torch.zeros_like(lone.seen))
    one, *others = (sweep(views[2], sources, (2.0, 9.0), SETTINGS) for sources in ([lone], [lone, lone], [lone, blind]))
    assert 0.2 < others[0].inverse_depth.count_nonzero() / noise.numel() < 0.8
    for two in others:
        assert torch.equal(one.inverse_depth, two.inverse_depth)
        assert torch.equal(one.correlation, two.correlation)


def test_a_depth_that_one_other_frame_can_see_needs_that_frame_alone():
    cameras = dive()
    cameras.cam2world[:, 0, 3] *= 5  # 1.25 apart at a depth of 4: each image overlaps the next by two thirds
    canvas = covering_pinholes(cameras, 640)
    true = [1 / z_of_plane(cameras[i], FRONTAL).float() for i in range(5)]
    sure = torch.ones(HEIGHT, WIDTH)
    ends = canvas[[0, 1, 2]]
    kept = consistent(RawDepth(true[0], sure), [RawDepth(true[1], sure), RawDepth(true[2], sure)], ends, 0.5, SETTINGS)
    columns = torch.arange(WIDTH)
    shift = 110 * 1.25 / 4  # pixels from one image to the next
    in_one = (columns > shift + 2) & (columns < 2 * shift - 2)  # ground in the second image and not in the third
    rows = slice(16, -16)
    assert (kept.inverse_depth[rows, in_one] > 0).all()
    assert (kept.inverse_depth[rows, columns < shift - 2] == 0).all()  # in no other image
    assert kept.correlation[rows, in_one].max() < kept.correlation[rows, columns > 2 * shift + 2].min()
    astray = [RawDepth(1.1 * true[1], sure), RawDepth(true[2], sure)]
    denied = consistent(RawDepth(true[0], sure), astray, ends, 0.5, SETTINGS)
    assert (denied.inverse_depth[rows, in_one] == 0).all()
    assert (denied.inverse_depth[rows, columns > 2 * shift + 6] == 0).all()  # two others see it and one agrees


def test_frames_with_poor_poses_may_differ_by_what_the_poses_are_worth():
    canvas = covering_pinholes(dive(), 640)
    true = [1 / z_of_plane(dive()[i], FRONTAL).float() for i in range(5)]
    sure = torch.ones(HEIGHT, WIDTH)
    others = [RawDepth(true[i], sure) for i in (0, 1, 3, 4)]
    off = RawDepth(1.03 * true[2], sure)  # 0.2 and 0.4 pixels at the two baselines
    strict = consistent(off, others, canvas[[2, 0, 1, 3, 4]], 0.1, SETTINGS).inverse_depth
    lenient = consistent(off, others, canvas[[2, 0, 1, 3, 4]], 0.5, SETTINGS).inverse_depth
    assert (strict[MIDDLE] == 0).all()
    assert (lenient[MIDDLE] > 0).all()


def test_sources_are_the_frames_with_the_better_baseline(tmp_path: Path):
    rec = reconstruction(dive(), FRONTAL, tmp_path)  # 4 units away, 0.25 apart: 3.6 degrees a step
    first = choose_sources(rec, 2, angle_deg=7.0)
    assert first[0][0] == 2
    assert first[4][0] == 2
    assert set(first[2]) == {0, 4}


def test_the_searched_depths_enclose_the_points_with_room_behind(tmp_path: Path):
    rec = reconstruction(dive(), SLANTED, tmp_path)
    z = project(rec.cameras[2], rec.points.xyz[None])[1]
    near, far = depth_range(rec, 2, points_by_frame(rec)[2]) or (0.0, 0.0)
    assert 0.5 * z.min() < near < z.min()
    assert far > 1.5 * z.max()


def test_a_frame_without_points_has_no_depth(tmp_path: Path):
    cameras = dive()
    rec = reconstruction(cameras, FRONTAL, tmp_path)
    elsewhere = rec.tracks.frame != 4
    rec = replace(
        rec, tracks=Tracks(rec.tracks.point[elsewhere], rec.tracks.frame[elsewhere], rec.tracks.xy[elsewhere])
    )
    depth = estimate_depth(rec, frames_on_disk(cameras, FRONTAL, tmp_path), SETTINGS)
    assert (depth["4.png"].z_depth == 0).all()
    assert (depth["2.png"].z_depth > 0).double().mean() > 0.7


def test_depth_lies_on_the_grid_of_a_distorted_frame(tmp_path: Path):
    cameras = dive("OPENCV", (-0.12, 0.02, 0.001, -0.001))
    rec = reconstruction(cameras, SLANTED, tmp_path)
    depth = estimate_depth(rec, frames_on_disk(cameras, SLANTED, tmp_path), SETTINGS)
    found = depth["2.png"]
    error = relative_error(found.z_depth, z_of_plane(cameras[2], SLANTED))
    assert found.z_depth.shape == (HEIGHT, WIDTH)
    assert (found.z_depth > 0)[MIDDLE].double().mean() > 0.9
    assert error.median() < 0.003
    assert error.quantile(0.95) < 0.02
    assert ((found.confidence > 0) == (found.z_depth > 0)).all()


def test_depth_of_large_frames_is_computed_small_and_returned_large(tmp_path: Path):
    cameras = dive()
    rec = reconstruction(cameras, SLANTED, tmp_path)
    found = estimate_depth(rec, frames_on_disk(cameras, SLANTED, tmp_path), replace(SETTINGS, long_side=80))["2.png"]
    error = relative_error(found.z_depth, z_of_plane(cameras[2], SLANTED))
    assert found.z_depth.shape == (HEIGHT, WIDTH)
    assert (found.z_depth > 0).double().mean() > 0.6
    assert error.median() < 0.01


def blue_lamp() -> Callable[[Tensor], Tensor]:
    """A camera whose images have texture in blue alone, which luma loses in the noise of the other channels."""
    generator = torch.Generator().manual_seed(0)

    def filmed(image: Tensor) -> Tensor:
        lit = torch.tensor([0.02, 0.1, 0.3]) + torch.tensor([0.0, 0.0, 0.08]) * image
        return lit + torch.randn(image.shape, generator=generator) / 255

    return filmed


def test_the_depth_of_a_scene_in_blue_is_measured_in_blue(tmp_path: Path):
    cameras = dive()
    frames = frames_on_disk(cameras, SLANTED, tmp_path, blue_lamp())
    depth = estimate_depth(reconstruction(cameras, SLANTED, tmp_path), frames, SETTINGS)["2.png"].z_depth
    error = relative_error(depth, z_of_plane(cameras[2], SLANTED))
    assert (depth > 0)[MIDDLE].double().mean() > 0.8
    assert error.median() < 0.01


def test_gray_has_the_channels_that_the_detail_is_in_and_no_more_noise_than_luma(tmp_path: Path):
    names = tuple(f"{i}.png" for i in range(5))
    even = gray_weights(frames_on_disk(dive(), SLANTED, tmp_path), names, 640)
    blue = gray_weights(frames_on_disk(dive(), SLANTED, tmp_path, blue_lamp()), names, 640)
    small = gray_weights(
        frames_on_disk(dive(), SLANTED, tmp_path, lambda image: image * torch.tensor([0, 1.0, 0])), names, 64
    )
    assert torch.allclose(even, torch.ones(3) / 3, atol=1e-4)
    assert blue[2] > 0.95 * LUMA.norm()
    assert torch.allclose(small, LUMA.norm() * torch.tensor([0, 1.0, 0]), atol=1e-4)
    assert torch.allclose(blue.norm(), LUMA.norm())


def test_gray_of_frames_of_which_nothing_is_seen_is_luma(tmp_path: Path):
    names = tuple(f"{i}.png" for i in range(5))
    images.write_mask(tmp_path / "none.png", np.zeros((HEIGHT, WIDTH), bool))
    hidden = frames_on_disk(dive(), SLANTED, tmp_path)
    hidden = replace(hidden, frames=tuple(replace(f, mask=tmp_path / "none.png") for f in hidden))
    assert torch.equal(gray_weights(hidden, names, 640), LUMA)


def test_masked_pixels_have_no_depth(tmp_path: Path):
    cameras = dive()
    rec = reconstruction(cameras, FRONTAL, tmp_path)
    frames = frames_on_disk(cameras, FRONTAL, tmp_path)
    usable = np.full((HEIGHT, WIDTH), True)
    usable[30:60, 40:80] = False
    images.write_mask(tmp_path / "masks" / "2.png", usable)
    masked = tuple(replace(f, mask=tmp_path / "masks" / "2.png") if f.name == "2.png" else f for f in frames)
    depth = estimate_depth(rec, replace(frames, frames=masked), SETTINGS)["2.png"].z_depth
    assert (depth[30:60, 40:80] == 0).all()
    assert (depth > 0).double().mean() > 0.5


def test_an_interrupted_sweep_goes_on_where_it_stopped(tmp_path: Path):
    cameras = dive()
    frames = frames_on_disk(cameras, FRONTAL, tmp_path)
    whole = estimate_depth(reconstruction(cameras, FRONTAL, tmp_path / "whole"), frames, SETTINGS)
    rec = reconstruction(cameras, FRONTAL, tmp_path / "broken")

    for stop_in, stop_at in (("depth", 2), ("depth agreement", 3), ("depth seen through", 2)):

        def power_cut(what: str, done: int, total: int, stop: tuple[str, int] = (stop_in, stop_at)) -> None:
            if (what, done) == stop:
                raise KeyboardInterrupt

        with pytest.raises(KeyboardInterrupt):
            estimate_depth(rec, frames, SETTINGS, power_cut)
    seen: list[tuple[str, int]] = []
    resumed = estimate_depth(rec, frames, SETTINGS, lambda what, done, total: seen.append((what, done)))
    assert seen[-1] == ("depth seen through", 5)
    assert all(what == "depth seen through" and done > 2 for what, done in seen)
    for name in rec.names:
        assert torch.equal(resumed[name].z_depth, whole[name].z_depth)


def test_the_number_of_threads_changes_no_bit(tmp_path: Path):
    cameras = dive()
    frames = frames_on_disk(cameras, SLANTED, tmp_path)
    one, four = (
        estimate_depth(
            reconstruction(cameras, SLANTED, tmp_path / str(threads)), frames, replace(SETTINGS, threads=threads)
        )
        for threads in (1, 4)
    )
    for name in frames.names:
        assert torch.equal(one[name].z_depth, four[name].z_depth)
        assert torch.equal(one[name].confidence, four[name].confidence)


def twice_as_large(rec: Reconstruction) -> Reconstruction:
    cameras = replace(rec.cameras, cam2world=rec.cameras.cam2world.clone())
    cameras.cam2world[:, :3, 3] *= 2
    return replace(rec, cameras=cameras, points=replace(rec.points, xyz=rec.points.xyz * 2))


def median_depth(maps: DepthMaps) -> float:
    with np.load(maps.path("2.png")) as stored:
        return float(np.median(stored["z_depth"][stored["z_depth"] > 0]))


def test_maps_of_other_cameras_are_not_kept(tmp_path: Path):
    cameras = dive()
    frames = frames_on_disk(cameras, FRONTAL, tmp_path)
    rec = reconstruction(cameras, FRONTAL, tmp_path)
    estimate_depth(rec, frames, SETTINGS)
    estimate_depth(twice_as_large(rec), frames, SETTINGS)
    assert median_depth(rec.depth) == pytest.approx(8.0, rel=0.01)


def test_a_process_that_goes_on_takes_the_reconstruction_that_the_folder_holds_now(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
):
    def in_one_process(work: Callable[[estimate.PartOfPass], None], parts: list[estimate.PartOfPass], *_, **__) -> list:
        return [work(part) for part in parts][:0]

    monkeypatch.setattr(estimate, "run_tasks", in_one_process)
    cameras = dive()
    frames = frames_on_disk(cameras, FRONTAL, tmp_path)
    rec = reconstruction(cameras, FRONTAL, tmp_path / "sfm")
    for now, depth in ((rec, 4.0), (twice_as_large(rec), 8.0)):
        now.save(tmp_path / "sfm", frames)
        maps = estimate_depth(now, frames, SETTINGS, engine=EngineSettings(jobs=2))
        assert median_depth(maps) == pytest.approx(depth, rel=0.01)


def test_progress_counts_every_frame_of_every_pass(tmp_path: Path):
    cameras = dive()
    told: list[tuple[str, int, int]] = []
    estimate_depth(
        reconstruction(cameras, FRONTAL, tmp_path),
        frames_on_disk(cameras, FRONTAL, tmp_path),
        SETTINGS,
        lambda what, done, total: told.append((what, done, total)),
    )
    assert told == [(what, k, 5) for what in STEPS for k in range(1, 6)]
    assert {path.name for path in (tmp_path / "z_depth").iterdir() if path.is_dir()} == set()


@pytest.mark.long
def test_several_processes_make_the_same_maps(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setattr(estimate, "_OF_A_TASK", 2)
    cameras = dive()
    frames = frames_on_disk(cameras, FRONTAL, tmp_path)
    here = estimate_depth(reconstruction(cameras, FRONTAL, tmp_path / "here"), frames, SETTINGS)
    rec = reconstruction(cameras, FRONTAL, tmp_path / "there")
    rec.save(rec.depth.folder.parent, frames)
    seen: list[tuple[str, int, int]] = []
    there = estimate_depth(rec, frames, SETTINGS, lambda *told: seen.append(told), EngineSettings(jobs=2))
    for name in rec.names:
        assert torch.equal(here[name].z_depth, there[name].z_depth)
    assert seen == [(step, done, 3) for step in STEPS for done in range(4)]


def test_points_of_a_frame_are_those_its_tracks_show(tmp_path: Path):
    rec = reconstruction(dive(), SLANTED, tmp_path)
    tracks = rec.tracks
    rec = replace(rec, tracks=Tracks(tracks.point.repeat(2), tracks.frame.repeat(2), tracks.xy.repeat(2, 1)))
    for i, found in enumerate(points_by_frame(rec)):
        assert np.array_equal(found, np.unique(tracks.point[tracks.frame == i].numpy()))
