"""Scores against the truth of a synthetic dive."""

from dataclasses import replace
from pathlib import Path
from typing import Any, cast

import numpy as np
import pytest
import torch
from tests.splat.conftest import TinyDive, make_wall, relit, tiny_dive  # noqa: F401 - fixtures

from swimm3r.appearance import FrameColors
from swimm3r.cameras import resized
from swimm3r.io.files.array_file import write_arrays
from swimm3r.io.images import write_mask, write_rgb
from swimm3r.pipeline.scores.held_out import FirstPose, score_views
from swimm3r.pipeline.scores.truth import truth_section
from swimm3r.scene.frames import Frames
from swimm3r.scene.ground_truth import GroundTruth
from swimm3r.splat.settings import PoseRefinementSettings
from swimm3r.splat.training_poses import RefinedPoses


def write_truth(dive: TinyDive, folder: Path, enlarged: int = 1) -> GroundTruth:
    """The wall's depth, clear colors, lamp and something that moves, each pixel as a square of `enlarged` pixels."""

    def stored(values: np.ndarray) -> np.ndarray:
        return values.repeat(enlarged, 0).repeat(enlarged, 1)

    still = np.ones((dive.frames.height, dive.frames.width), dtype=bool)
    still[11:20, 9:30] = False
    for kind in ("z_depth", "lamp"):
        (folder / kind).mkdir(parents=True)
    for i, name in enumerate(dive.frames.names):
        out = dive.truth.render(dive.cameras[i])
        write_arrays(folder / "z_depth" / f"{name}.npz", z_depth=stored(out.z_depth.numpy()))
        write_rgb(folder / "clear" / f"{name}.png", stored((255 * out.clear.clamp(0, 1)).byte().numpy()))
        write_mask(folder / "masks" / f"{name}.png", stored(still))
        light = stored(out.rgb.numpy())
        write_arrays(folder / "lamp" / f"{name}.npz", light=light, backscatter=0.5 * light)
    cameras = resized(dive.cameras, enlarged * dive.frames.width, enlarged * dive.frames.height)
    return GroundTruth(
        dive.frames.names, cameras, True, dive.rec.medium.constant() if dive.rec.medium else None, folder
    )


def test_frames_smaller_than_the_dive_are_scored_as_those_of_its_size(tiny_dive: TinyDive, tmp_path: Path):  # noqa: F811
    frames, scene = tiny_dive.frames, make_wall(1400)
    poses = {n: FirstPose(tiny_dive.cameras.cam2world[frames.index(n)], "reference") for n in frames.test.names}
    same, larger = (write_truth(tiny_dive, tmp_path / f"x{n}", n) for n in (1, 2))
    smaller = larger.at_size(frames.width, frames.height)

    def section(truth: GroundTruth) -> dict[str, Any]:
        settings = PoseRefinementSettings(steps=0)
        views = score_views(scene, tiny_dive.rec, frames, poses, tmp_path, settings, truth=truth)
        return truth_section(tiny_dive.rec, frames, truth, scene, views)

    expected, found = section(same), section(smaller)
    assert found == expected
    assert found["depth_absrel"] == pytest.approx(0, abs=1e-6)
    assert found["splat"]["psnr_moving"] != found["splat"]["psnr_still"]


def test_a_truth_of_another_size_takes_nearest_depth_and_masks_and_the_mean_of_colors(
    tiny_dive: TinyDive,  # noqa: F811
    tmp_path: Path,
):
    truth, name = write_truth(tiny_dive, tmp_path, 3), tiny_dive.frames.names[0]
    half = truth.at_size(96, 72)
    assert half.at_size(96, 72) is half
    parts: list[Any] = [[t.z_depth(name), t.clear(name), t.moving(name), t.lamp(name)] for t in (half, truth)]
    (z_depth, clear, moving, lamp), (z_depth_before, clear_before, moving_before, _) = parts
    assert z_depth.shape == clear.shape[:2] == moving.shape == lamp.light.shape[:2] == (72, 96)
    assert set(z_depth.unique().tolist()) <= set(z_depth_before.unique().tolist())
    assert clear.mean() == pytest.approx(float(clear_before.mean()), abs=1e-4)
    assert moving.float().mean() == pytest.approx(float(moving_before.float().mean()), rel=0.1)
    torch.testing.assert_close(half.cameras.K[:, :2], truth.cameras.K[:, :2] / 2)
    assert half.at_size(192, 144).stored == (192, 144)


def test_what_moves_is_scored_in_the_colors_that_the_frame_is_compared_in(
    tiny_dive: TinyDive,  # noqa: F811
    relit: Frames,  # noqa: F811
    tmp_path: Path,
):
    """The map's average exposure is that of no frame, as each was exposed by itself."""
    truth, name = write_truth(tiny_dive, tmp_path), relit.test.names[0]
    poses = {name: FirstPose(tiny_dive.cameras.cam2world[relit.index(name)], "reference")}
    count = len(tiny_dive.rec.names)
    colors = FrameColors(tiny_dive.rec.names, torch.eye(3, 4).repeat(count, 1, 1))
    psnrs = []
    for scene in (tiny_dive.truth, replace(tiny_dive.truth, colors=colors)):
        (view,) = score_views(
            scene, tiny_dive.rec, relit, poses, tmp_path, PoseRefinementSettings(steps=0), truth=truth
        )
        section: Any = truth_section(tiny_dive.rec, relit, truth, scene, [view])["splat"]
        psnrs.append((section["psnr_still"], section["psnr_moving"]))
        everything = view.scores.psnr
        assert min(psnrs[-1]) <= everything <= max(psnrs[-1])
    assert min(psnrs[1]) > max(psnrs[0]) + 5


def test_the_water_of_a_map_whose_unit_changed_in_training_is_compared_in_that_of_the_truth(
    tiny_dive: TinyDive,  # noqa: F811
    tmp_path: Path,
):
    truth, frames = write_truth(tiny_dive, tmp_path), tiny_dive.frames
    poses = {n: FirstPose(tiny_dive.cameras.cam2world[frames.index(n)], "reference") for n in frames.test.names}
    settings = PoseRefinementSettings(steps=0)
    views = score_views(tiny_dive.truth, tiny_dive.rec, frames, poses, tmp_path, settings, truth=truth)
    larger = tiny_dive.rec.cameras.cam2world.clone()
    larger[:, :3, 3] *= 1.25
    scenes = tiny_dive.truth, replace(tiny_dive.truth, poses=RefinedPoses(tiny_dive.rec.names, larger))
    before, after = cast(Any, [truth_section(tiny_dive.rec, frames, truth, scene, views)["splat"] for scene in scenes])
    for name in ("beta_D_rel", "beta_B_rel"):
        assert before[name] == pytest.approx([0.0] * 3, abs=1e-5)
        assert after[name] == pytest.approx([0.25] * 3, rel=1e-4)  # the same numbers per a unit 1.25 times as short
