"""Registered training frames become views in working units."""

from dataclasses import replace

import numpy as np
import pytest
import torch

from swimm3r.cameras import Cameras
from swimm3r.errors import InputError
from swimm3r.io.images import write_levels, write_rgb
from swimm3r.scene.frame_changes import MovingMasks
from swimm3r.scene.frames import Frame, Frames
from swimm3r.scene.reconstruction import DepthMap, DepthMaps
from swimm3r.splat.settings import LossWeights, UwbsSettings
from swimm3r.splat.views import TrainingViews, median_z_depth, smaller, working_scale


def lens(width: int = 96, height: int = 64, k: float = -0.15) -> Cameras:
    K = torch.tensor([[[70.0, 0, 49], [0, 70, 31], [0, 0, 1]]], dtype=torch.float64)
    pose = torch.eye(4, dtype=torch.float64)[None]
    return Cameras(K, torch.tensor([[k]], dtype=torch.float64), pose, width, height, "SIMPLE_RADIAL")


def test_views_are_the_registered_training_frames_with_images_and_depth_in_working_units(tiny_dive):
    views = TrainingViews(tiny_dive.rec, tiny_dive.frames, UwbsSettings(), 2.0)
    assert views.names == tiny_dive.rec.names
    view = views[2]
    image = tiny_dive.frames.image(tiny_dive.frames.index(view.name))
    torch.testing.assert_close(view.rgb.permute(1, 2, 0), image, atol=1e-6, rtol=0)
    expected = 2 * tiny_dive.rec.depth[view.name].z_depth
    torch.testing.assert_close(view.z_depth, expected, rtol=1e-3, atol=0)
    torch.testing.assert_close(view.camera.centers[0], 2 * tiny_dive.rec.cameras.centers[2])


def test_views_know_where_they_look_past_every_surface(tiny_dive, tmp_path):
    rgb = torch.tensor([0.1, 0.5, 0.6]).expand(96, 128, 3).clone()
    rgb[48:] = 0.4 * torch.rand(48, 128, 3, generator=torch.Generator().manual_seed(0))  # a rough sea floor
    z_depth = torch.zeros(96, 128)
    z_depth[48:] = 3.0
    write_rgb(tmp_path / "a.png", rgb.numpy())
    depth = DepthMaps(tmp_path / "z_depth")
    depth.write("a.png", DepthMap(z_depth, torch.full((96, 128), 0.02)))  # that one other frame agrees with
    frames = Frames((Frame("a.png", tmp_path / "a.png", 0.0, 1.0, "train"),), 128, 96, True)
    rec = replace(tiny_dive.rec, names=("a.png",), cameras=lens(128, 96, 0.0), depth=depth)
    view = TrainingViews(rec, frames, UwbsSettings(), 1.0)[0]
    assert (view.z_depth[50:, 2:-2] > 0).all()
    assert view.open_water[:40].float().mean() > 0.7
    assert not view.open_water[48:].any()


def test_what_is_not_open_water_is_a_surface_where_depth_tells_the_two_apart(tiny_dive):
    view = TrainingViews(tiny_dive.rec, tiny_dive.frames, UwbsSettings(), 1.0)[0]
    h, w = view.seen.shape
    rows = torch.arange(h)[:, None].expand(h, w)
    measured = replace(
        view,
        z_depth=torch.where(rows < h // 2, 2.0, 0.0),
        open_water=rows >= 3 * h // 4,
        seen=torch.arange(w).expand(h, w) > 0,
    )
    surface = (rows < h // 2) | ((rows < 3 * h // 4) & measured.seen)
    assert torch.equal(measured.surface, surface)
    hardly = replace(measured, z_depth=torch.where(rows < h // 20, 2.0, 0.0))
    assert torch.equal(hardly.surface, rows < h // 20)


def test_depth_is_guessed_where_a_surface_has_none_and_only_if_asked_for(tiny_dive, tmp_path):
    """A plane, seen at a slant: what is filled in lies on it."""
    rng = torch.Generator().manual_seed(0)
    write_rgb(tmp_path / "a.png", (0.3 + 0.05 * torch.rand(64, 96, 3, generator=rng)).numpy())
    plane = 1 / (0.2 + 0.002 * torch.arange(96.0)).expand(64, 96)
    gap = torch.zeros(64, 96, dtype=torch.bool)
    gap[20:44, 30:60] = True
    depth = DepthMaps(tmp_path / "z_depth")
    depth.write("a.png", DepthMap(torch.where(gap, 0.0, plane), torch.ones(64, 96)))
    frames = Frames((Frame("a.png", tmp_path / "a.png", 0.0, 1.0, "train"),), 96, 64, True)
    rec = replace(tiny_dive.rec, names=("a.png",), cameras=lens(96, 64, 0.0), depth=depth, cloud=None, medium=None)
    view = TrainingViews(rec, frames, UwbsSettings(), 2.0)[0]
    assert view.guessed_z_depth is not None
    surface = gap & ~view.open_water
    assert surface[gap].float().mean() > 0.9
    assert torch.equal(view.guessed_z_depth > 0, surface)
    ratio = view.guessed_z_depth[surface] / (2 * plane[surface])
    assert (ratio.log().abs() < 0.05).all()
    guessed = smaller(view, 2).guessed_z_depth
    assert guessed is not None
    assert guessed.shape == (32, 48)
    moving = MovingMasks(tmp_path / "masks")
    moving.folder.mkdir()
    still = torch.ones(64, 96)
    still[20:44, 30:45] = 0
    write_levels(moving.path("a.png"), (still * 65535).numpy().astype(np.uint16))
    shown = TrainingViews(replace(rec, moving=moving), frames, UwbsSettings(), 2.0)[0]  # by a dynamic map
    assert shown.seen.all()
    assert shown.guessed_z_depth is not None
    assert not shown.guessed_z_depth[20:44, 30:44].any()
    assert (shown.guessed_z_depth[20:44, 48:60] > 0).float().mean() > 0.9
    unasked = UwbsSettings(weights=LossWeights(guess=0.0))
    assert TrainingViews(rec, frames, unasked, 2.0)[0].guessed_z_depth is None


def test_a_rendering_may_be_brighter_than_values_that_are_clipped(tiny_dive, tmp_path):
    rgb = torch.full((64, 96, 3), 0.5)
    rgb[:8, :8] = 1.0
    rgb[40:, :, 2] = 0.985
    write_rgb(tmp_path / "a.png", rgb.numpy())
    frames = Frames((Frame("a.png", tmp_path / "a.png", 0.0, 1.0, "train"),), 96, 64, True)
    rec = replace(tiny_dive.rec, names=("a.png",), cameras=lens(96, 64, 0.0), depth=DepthMaps(tmp_path / "z_depth"))
    view = TrainingViews(rec, frames, UwbsSettings(), 1.0)[0]
    brighter, darker = view.compared(view.rgb + 0.3), view.compared(view.rgb - 0.3)
    assert darker.all()
    assert torch.equal(~brighter, view.rgb > 0.95)
    assert torch.equal(~view.measured, (view.rgb > 0.95).any(0))
    half = smaller(view, 2)
    assert torch.equal(half.compared(half.rgb + 0.3), brighter[:, ::2, ::2])


def test_without_clipped_values_every_pixel_seen_is_compared(tiny_dive):
    view = TrainingViews(tiny_dive.rec, tiny_dive.frames, UwbsSettings(), 1.0)[0]
    assert view.clipped is None
    assert torch.equal(view.compared(view.rgb + 1), view.seen)
    assert torch.equal(view.measured, view.seen)


def test_test_frames_are_never_views(tiny_dive):
    rec = replace(tiny_dive.rec, names=("0.png", *tiny_dive.rec.names[1:]))
    assert "0.png" not in TrainingViews(rec, tiny_dive.frames, UwbsSettings(), 1.0).names


def test_frames_of_another_dive_are_refused(tiny_dive):
    rec = replace(tiny_dive.rec, names=tuple(f"other_{name}" for name in tiny_dive.rec.names))
    with pytest.raises(InputError, match="registered"):
        TrainingViews(rec, tiny_dive.frames, UwbsSettings(), 1.0)


def test_a_scene_without_scale_is_trained_at_the_working_depth(tiny_dive):
    settings = UwbsSettings()
    assert working_scale(tiny_dive.rec, settings) == 1
    scaleless = replace(tiny_dive.rec, metric=False)
    assert median_z_depth(scaleless) * working_scale(scaleless, settings) == pytest.approx(settings.working_depth)
