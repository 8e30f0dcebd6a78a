"""A pose refined against a frozen map."""

from dataclasses import replace

import pytest
import torch

from swimm3r.cameras import project
from swimm3r.geometry import relative_poses, rotation_angle, so3_exp
from swimm3r.splat.pose_mlp import moved
from swimm3r.splat.pose_refinement import edges, ends, local_mean, refine_pose, sizes
from swimm3r.splat.settings import PoseRefinementSettings

SEEN = torch.ones(48, 64, dtype=torch.bool)


def pixels_off(dive, camera) -> float:
    """Median distance between where the points are and where a camera that should be frame 3's sees them."""
    points = dive.rec.points.xyz[None]
    return float((project(camera, points)[0] - project(dive.cameras[3], points)[0]).norm(dim=-1).median())


def turned(dive, camera) -> float:
    return float(rotation_angle(relative_poses(dive.cameras[3].cam2world, camera.cam2world)[0, :3, :3]))


def disturbed(dive, turn: tuple[float, float, float], shift: tuple[float, float, float]):
    pose = dive.cameras[3].cam2world.clone()
    pose[0, :3, :3] = pose[0, :3, :3] @ so3_exp(torch.tensor(turn, dtype=torch.float64))
    pose[0, :3, 3] += torch.tensor(shift)
    return replace(dive.cameras[3], cam2world=pose)


def test_a_disturbed_pose_finds_its_way_back(tiny_dive):
    start = disturbed(tiny_dive, (0.012, -0.01, 0.015), (0.02, -0.015, 0.02))
    settings = PoseRefinementSettings(steps=120, rate=2e-3)
    refined = refine_pose(tiny_dive.truth, start, tiny_dive.frames.image(3), SEEN, settings)
    assert refined.loss < 0.2 * refined.start_loss
    assert turned(tiny_dive, refined.camera) < 0.4 * turned(tiny_dive, start)
    assert pixels_off(tiny_dive, start) > 1
    # before a wall, a shift and a turn are hard to tell apart: both may remain
    assert pixels_off(tiny_dive, refined.camera) < 0.1


def test_smaller_images_are_looked_at_first_for_half_of_the_steps():
    settings = PoseRefinementSettings()
    assert sizes(settings, 400) == [60, 120, 240]
    assert sizes(settings, 150) == [75, 150]
    assert sizes(settings, 64) == [64]
    assert sizes(PoseRefinementSettings(long_side=0), 1600) == [400, 800, 1600]
    assert sizes(PoseRefinementSettings(long_side=0, halvings=0), 1600) == [1600]
    assert ends(300, 3) == [75, 150, 300]
    assert ends(300, 1) == [300]
    assert ends(0, 3) == [0, 0, 0]


def test_a_pose_that_is_right_stays(tiny_dive):
    true = tiny_dive.cameras[3]
    refined = refine_pose(tiny_dive.truth, true, tiny_dive.frames.image(3), SEEN, PoseRefinementSettings(steps=5))
    assert refined.loss <= refined.start_loss
    assert (refined.camera.centers - true.centers).norm() < 5e-3


def test_a_image_of_full_size_is_the_training_images_not_the_frames(tiny_dive, monkeypatch):
    small = replace(tiny_dive.truth, settings=replace(tiny_dive.truth.settings, long_side=32))
    seen = []
    monkeypatch.setattr(
        "swimm3r.splat.pose_refinement.images", lambda p, f, view, *_: seen.append(view.width) or drawn(view)
    )
    for settings in (PoseRefinementSettings(steps=1, long_side=0), PoseRefinementSettings(steps=1)):
        refine_pose(small, tiny_dive.cameras[3], tiny_dive.frames.image(3), SEEN, settings)
    assert set(seen) == {32}


def drawn(view):
    """Black, and differentiable in the pose."""
    from swimm3r.raster import RasterOutput

    rgb = torch.zeros(3, view.height, view.width) + 0 * view.t.sum().float()
    return RasterOutput(rgb, rgb, rgb[0], rgb[0])


def test_no_motion_is_the_given_pose():
    pose = torch.eye(4, dtype=torch.float64)
    assert torch.equal(moved(pose, torch.zeros(9), 3.0), pose)
    assert moved(pose, torch.tensor([0.1, 0, 0, 0, 0, 0, 0, 0, 0]), 3.0)[0, 3] == pytest.approx(0.3)


def test_light_that_changes_slowly_does_not_draw_a_pose_aside(tiny_dive):
    start = disturbed(tiny_dive, (0.012, -0.01, 0.015), (0.02, -0.015, 0.02))
    wedge = 0.3 * torch.linspace(-1, 1, 64)[:, None] * torch.tensor([0.3, 0.8, 1.0])
    image, off = tiny_dive.frames.image(3) + wedge, {}
    for pixels in ("all", "edges"):
        settings = PoseRefinementSettings(steps=120, rate=2e-3, pixels=pixels, min_gain=0.0)
        found = refine_pose(tiny_dive.truth, start, image, SEEN, settings)
        off[pixels] = pixels_off(tiny_dive, found.camera)
    assert off["all"] < 0.1
    assert off["all"] < 0.5 * off["edges"]


def test_a_pose_stays_where_the_map_shows_nothing_of_the_frame(tiny_dive):
    noise = torch.rand(48, 64, 3, generator=torch.Generator().manual_seed(0))
    start = tiny_dive.cameras[3]
    moved_by = {}
    for gain in (0.0, 2.0):
        found = refine_pose(tiny_dive.truth, start, noise, SEEN, PoseRefinementSettings(steps=20, min_gain=gain))
        moved_by[gain] = pixels_off(tiny_dive, found.camera)
    assert moved_by[0.0] > 0.1
    assert moved_by[2.0] == 0


def test_local_means_are_of_seen_pixels_alone():
    values = torch.full((20, 30, 2), 0.3)
    seen = torch.ones(20, 30, dtype=torch.bool)
    seen[:, 15:] = False
    values[:, 15:] = 7.0
    mean = local_mean(values, seen, 2.0)
    torch.testing.assert_close(mean[:, :15], values[:, :15])
    torch.testing.assert_close(mean[:, 16], torch.full((20, 2), 0.3))
    assert not mean[:, 22:].any()
    assert local_mean(torch.rand(20, 30, 2), seen, 1.5).isfinite().all()


def test_a_flat_image_has_edges_everywhere():
    flat = torch.full((48, 64, 3), 0.4)
    assert edges(flat, SEEN).all()
    stepped = flat.clone()
    stepped[:, 32:] = 0.8
    found = edges(stepped, SEEN)
    assert found[:, 31:33].all()
    assert not found[:, :30].any()
