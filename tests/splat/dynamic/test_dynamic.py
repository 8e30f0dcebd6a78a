"""Maps that change with time: primitives and water conditioned on it, from training to the file and back."""

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

from swimm3r.errors import InputError
from swimm3r.evaluate.images import psnr
from swimm3r.io.cameras_json import CameraTable
from swimm3r.io.images import read_rgb, write_rgb
from swimm3r.pipeline.renders import moments_of
from swimm3r.pipeline.scores.held_out import FirstPose, score_views
from swimm3r.pipeline.scores.truth import truth_section
from swimm3r.scene.frames import Frames
from swimm3r.scene.ground_truth import GroundTruth
from swimm3r.splat import train
from swimm3r.splat.map_file import load_map
from swimm3r.splat.medium.field import grid_of, initial_field
from swimm3r.splat.primitives.beta import initial_primitives, with_time
from swimm3r.splat.projection.view_camera import view_camera
from swimm3r.splat.settings import (
    DensifySettings,
    InitialSettings,
    MediumFieldSettings,
    PoseRefinementSettings,
    UwbsSettings,
)
from swimm3r.splat.views import TrainingViews, normalized_time

DYNAMIC = UwbsSettings(
    dynamic=True,
    iterations=40,
    initial=InitialSettings(primitives=500, scale=2.0),
    densify=DensifySettings(cap_max=700, min_refine_every=4),
    log_every=0.125,
    checkpoint_every=0.25,
)


def rng() -> torch.Generator:
    return torch.Generator().manual_seed(0)


@pytest.fixture(scope="module")
def trained(tiny_dive, tmp_path_factory):
    folder = tmp_path_factory.mktemp("dynamic")
    return train(tiny_dive.rec, tiny_dive.frames, DYNAMIC, folder), folder


def at_uneven_times(frames: Frames, times: list[float]) -> Frames:
    return replace(frames, frames=tuple(replace(f, time=t) for f, t in zip(frames, times, strict=True)))


def test_time_is_counted_over_the_whole_clip_test_frames_included(tiny_dive):
    """The first and the last of the nine frames are held back."""
    frames = at_uneven_times(tiny_dive.frames, [10, 11, 12, 15, 16, 17, 18, 19, 20])
    views = TrainingViews(tiny_dive.rec, frames, DYNAMIC, 1.0)
    assert views.times == pytest.approx([0.1, 0.2, 0.5, 0.6, 0.7, 0.8, 0.9])
    assert views[1].time == pytest.approx(0.2)


def test_a_clip_of_one_moment_is_at_its_beginning():
    assert normalized_time((3.0, 3.0), 3.0) == 0


def test_primitives_begin_around_moments_of_their_own(tiny_dive):
    still = initial_primitives(tiny_dive.rec, DYNAMIC.initial, rng())
    p = with_time(still, DYNAMIC.initial, rng())
    assert p.query_mean.shape[1] == 4
    assert 0.4 < p.query_mean[:, 3].mean() < 0.6
    assert p.lower.shape[1] == 21
    torch.testing.assert_close(torch.nn.functional.softplus(p.scale[:, 6]), torch.full((len(p.xyz),), 4.0))


def test_a_dynamic_map_shows_different_moments_differently_and_wants_to_know_which(tiny_dive, trained):
    scene, _ = trained
    view = tiny_dive.cameras[4]
    early, late = scene.render(view, 0.0), scene.render(view, 8.0)
    assert (early.rgb - late.rgb).abs().max() > 1e-3
    with pytest.raises(ValueError, match="0 to 8 s"):
        scene.render(view)


def test_a_dynamic_map_comes_back_from_disk_with_its_clock(tiny_dive, trained):
    scene, folder = trained
    stored = load_map(folder / "map.safetensors")
    assert stored.span == (0.0, 8.0)
    assert stored.settings == scene.settings
    view = tiny_dive.cameras[4]
    assert torch.equal(scene.render(view, 3.3).rgb, stored.render(view, 3.3).rgb)


class StoppedError(Exception):
    pass


def test_an_interrupted_dynamic_training_ends_with_the_bits_of_one_that_was_not(tiny_dive, trained, tmp_path):
    def stop(what: str, done: int, total: int, /) -> None:
        if done == 27:
            raise StoppedError

    with pytest.raises(StoppedError):
        train(tiny_dive.rec, tiny_dive.frames, DYNAMIC, tmp_path, stop)
    resumed = train(tiny_dive.rec, tiny_dive.frames, DYNAMIC, tmp_path)
    whole = trained[0]
    assert all(torch.equal(a, b) for a, b in zip(whole.primitives, resumed.primitives, strict=True))
    weights = resumed.field.state_dict()
    assert all(torch.equal(values, weights[name]) for name, values in whole.field.state_dict().items())


def test_the_water_of_a_dynamic_map_begins_the_same_at_all_times_and_learns_to_change(camera):
    view, settings = view_camera(camera()), MediumFieldSettings(hidden=16)
    field = initial_field(None, settings, rng(), dynamic=True)
    times = torch.tensor([0.0, 0.37, 1.0])
    first = [grid_of(field, view, 8, t).values for t in times]
    assert all(torch.equal(first[0], values) for values in first)
    with torch.no_grad():
        last: Any = field.network[-1]
        last.weight.normal_(0, 0.3, generator=rng())
    changed = [grid_of(field, view, 8, t).values for t in times]
    assert (changed[0] - changed[1]).abs().max() > 1e-3
    changed[1].sum().backward()
    gamma: Any = field.gamma
    assert gamma.weight.grad.abs().max() > 0


def test_held_out_frames_are_shown_at_their_own_times(tiny_dive, trained, tmp_path):
    scene, _ = trained
    frames = tiny_dive.frames
    poses = {
        name: FirstPose(tiny_dive.cameras.cam2world[frames.index(name)], "reference") for name in frames.test.names
    }
    views = score_views(scene, tiny_dive.rec, frames, poses, tmp_path, PoseRefinementSettings(steps=1))
    assert [view.time for view in views] == [0.0, 8.0]
    for view in views:
        shown = read_rgb(tmp_path / f"{Path(view.name).stem}_rgb.png").astype(int)
        rendered = scene.render(view.canvas, view.time)
        expected = (rendered.rgb.clamp(0, 1) * 255).round().int().numpy()
        assert rendered.observed is not None
        observed = rendered.observed.numpy()  # the rest is hatched
        assert observed.mean() > 0.5
        assert abs(shown - expected)[observed].max() <= 1


def test_what_moves_is_scored_apart_where_the_truth_knows_it(tiny_dive, trained, tmp_path):
    scene, frames, cameras = trained[0], tiny_dive.frames, tiny_dive.cameras
    moving = np.zeros((48, 64, 3), np.uint8)
    moving[10:20, 10:30] = 255
    for name in frames.names:
        write_rgb(tmp_path / "truth" / "masks" / f"{name}.png", 255 - moving)
    truth = GroundTruth(frames.names, cameras, True, tiny_dive.rec.medium.constant(), tmp_path / "truth")
    poses = {name: FirstPose(cameras.cam2world[frames.index(name)], "reference") for name in frames.test.names}
    settings = PoseRefinementSettings(steps=0)
    views = score_views(scene, tiny_dive.rec, frames, poses, tmp_path, settings, truth=truth)
    section: Any = truth_section(tiny_dive.rec, frames, truth, scene, views)["splat"]
    expected = []
    for name in frames.test.names:
        f = frames.index(name)
        render = scene.render(cameras[f], frames.frames[f].time).rgb.clamp(0, 1)
        expected.append(psnr(render[10:20, 10:30], frames.image(f)[10:20, 10:30]))
    assert section["psnr_moving"] == pytest.approx(np.mean(expected), abs=0.1)  # 8-bit images
    assert section["psnr_still"] != section["psnr_moving"]


def cameras_named(*names: str, times: tuple[float, ...] | None = None) -> CameraTable:
    K, pose = (np.eye(n)[None].repeat(len(names), 0) for n in (3, 4))
    return CameraTable(names, 64, 48, "PINHOLE", K, np.zeros((len(names), 0)), pose, times=times)


def test_cameras_that_are_no_frames_of_the_dive_need_a_moment(tiny_dive, trained):
    scene, frames = trained[0], tiny_dive.frames
    assert moments_of(scene, cameras_named("3.png", "8.png"), frames, None) == (3.0, 8.0)
    assert moments_of(scene, cameras_named("elsewhere.png"), frames, 2.5) == [2.5]
    with pytest.raises(InputError, match="--time SECONDS, 0 to 8"):
        moments_of(scene, cameras_named("3.png", "elsewhere.png"), frames, None)
    assert len(moments_of(tiny_dive.truth, cameras_named("elsewhere.png"), frames, None)) == 1


def test_cameras_with_times_of_their_own_show_the_scene_then(tiny_dive, trained):
    own = cameras_named("3.png", "elsewhere.png", times=(1.25, 6.5))
    assert moments_of(trained[0], own, tiny_dive.frames, None) == (1.25, 6.5)
    assert moments_of(trained[0], own, tiny_dive.frames, 2.0) == [2.0, 2.0]
