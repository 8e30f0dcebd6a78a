"""Frames in colors of their own: told from the tracks, trained in common colors, kept with the map."""

from dataclasses import replace
from pathlib import Path

import pytest
import torch
from tests.splat.conftest import GAINS

from swimm3r.appearance import ORDERS, FrameColors, about_identity, identity_maps, shading_gains
from swimm3r.errors import InputError
from swimm3r.evaluate.images import psnr
from swimm3r.geometry import so3_exp
from swimm3r.imaging.appearance import color_tracks, decide_appearance, ground_colors
from swimm3r.imaging.clipped import clipped
from swimm3r.io.images import write_rgb
from swimm3r.scene.frames import Frames
from swimm3r.splat import train
from swimm3r.splat.appearance import fit_to_view, read_decision, write_decision
from swimm3r.splat.map_file import load_map
from swimm3r.splat.pose_refinement import refine_pose
from swimm3r.splat.settings import (
    DensifySettings,
    InitialSettings,
    PoseRefinementSettings,
    RenderSettings,
    TrainingPoseSettings,
    UwbsSettings,
    with_recipe,
)
from swimm3r.splat.shared_settings import MapAppearanceSettings
from swimm3r.splat.training.loop import refit_steps
from swimm3r.splat.views import TrainingViews

SETTINGS = UwbsSettings(
    iterations=100,
    initial=InitialSettings(primitives=500),
    densify=DensifySettings(cap_max=700, min_refine_every=4),
    poses=TrainingPoseSettings(enabled=False),
    render=RenderSettings(),
)


def test_steady_frames_need_no_colors_of_their_own(tiny_dive, tracked):
    decided = decide_appearance(tracked, tiny_dive.frames, tracked.names, MapAppearanceSettings())
    assert not decided.decision.on
    assert decided.colors is None
    assert decided.decision.by_frames is not None
    assert decided.decision.by_frames < 0.1


def test_a_record_of_small_changes_decides_where_the_images_alone_do_not(tiny_dive, tracked, tmp_path):
    gains = [(2.0 ** (0.06 * (i % 5 - 2)),) * 3 for i in range(len(tiny_dive.frames))]
    rng, listed = torch.Generator().manual_seed(0), []
    for i, frame in enumerate(tiny_dive.frames):
        path = tmp_path / frame.name
        stored = tiny_dive.frames.image(i) * torch.tensor(gains[i]) ** 0.45
        write_rgb(path, (stored + 0.03 * torch.randn(stored.shape, generator=rng)).clamp(0, 1).numpy())
        listed.append(replace(frame, path=path, gains=gains[i]))
    told = replace(tiny_dive.frames, frames=tuple(listed))
    silent = replace(told, frames=tuple(replace(frame, gains=None) for frame in listed))
    settings = MapAppearanceSettings(least_explained=0.9)
    assert not decide_appearance(tracked, silent, tracked.names, settings).decision.on
    decision = decide_appearance(tracked, told, tracked.names, settings).decision
    assert decision.on
    assert decision.by_record is not None
    assert decision.by_record >= settings.least_recorded
    assert decision.record_stops == pytest.approx((0.24,) * 3, abs=1e-6)
    assert "that the camera recorded" in decision.reason


def test_frames_of_changing_exposure_get_colors_that_undo_it(tiny_dive, tracked, relit):
    decided = decide_appearance(tracked, relit, tracked.names, MapAppearanceSettings())
    assert decided.decision.on
    assert decided.decision.by_frames is not None
    assert decided.decision.by_frames > 0.5
    colors = decided.colors
    assert colors is not None
    torch.testing.assert_close(colors.maps.mean(0), identity_maps(1)[0], atol=1e-6, rtol=0)
    mean = torch.stack([GAINS[tiny_dive.frames.index(name) % 5] for name in tracked.names]).mean(0)
    for name in tracked.names:
        f = relit.index(name)
        common = colors.common(name, relit.image(f).permute(2, 0, 1)).permute(1, 2, 0)
        inner = tiny_dive.frames.image(f)[8:-8, 8:-8]
        before, after = psnr(relit.image(f)[8:-8, 8:-8], inner * mean), psnr(common[8:-8, 8:-8], inner * mean)
        assert after > min(30, before + 6)


@pytest.mark.parametrize(("mode", "on"), [("off", False), ("on", True)])
def test_the_decision_can_be_made_by_hand(tiny_dive, tracked, mode, on):
    decided = decide_appearance(tracked, tiny_dive.frames, tracked.names, MapAppearanceSettings(mode=mode))
    assert decided.decision.on == on
    assert (decided.colors is not None) == on


def test_without_tracks_nothing_is_fitted(tiny_dive):
    decided = decide_appearance(tiny_dive.rec, tiny_dive.frames, tiny_dive.rec.names, MapAppearanceSettings())
    assert not decided.decision.on
    assert "too few points" in decided.decision.reason


@pytest.mark.long
def test_a_map_of_relit_frames_is_that_of_steady_ones(tiny_dive, tracked, relit, tmp_path):
    own = {name: GAINS[tiny_dive.frames.index(name) % 5] for name in tracked.names}
    mean = torch.stack(list(own.values())).mean(0)
    off = replace(SETTINGS, appearance=MapAppearanceSettings(mode="off"))
    scores = {}
    for name, frames, settings in (
        ("steady", tiny_dive.frames, SETTINGS),
        ("on", relit, SETTINGS),
        ("off", relit, off),
    ):
        scene = train(tracked, frames, settings, tmp_path / name)
        seen = scene.render(tiny_dive.cameras[8]).rgb
        common = seen if name == "steady" else seen / mean  # those that the relit frames have on average
        scores[name] = psnr(common, tiny_dive.frames.image(8))
        decision = read_decision(tmp_path / name)
        assert decision is not None
        assert decision.on == (scene.colors is not None) == (name == "on")
    assert scores["on"] > scores["off"] + 0.3
    assert scores["on"] > scores["steady"] - 1.5


def test_every_recipe_is_handed_the_same_colors(tracked, relit, tmp_path):
    short = replace(SETTINGS, iterations=4)
    views = TrainingViews(tracked, relit, short, 1.0)
    filmed = views[2].rgb
    views.colors = decide_appearance(tracked, relit, views.names, short.appearance).colors
    assert views.colors is not None
    assert (views[2].rgb - filmed).abs().mean() > 0.01
    for recipe in ("mcmc_gs", "seasplat", "watersplatting", "oceansplat", "3d-uir", "uwbs-dynamic"):
        peer = with_recipe(short, recipe)
        assert peer.appearance == short.appearance
        scene = train(tracked, relit, peer, tmp_path / recipe)
        assert scene.colors is not None
        torch.testing.assert_close(scene.colors.maps.mean(0), identity_maps(1)[0], atol=1e-5, rtol=0)


class StoppedError(Exception):
    pass


@pytest.mark.long
def test_an_interrupted_training_goes_on_with_its_colors(tracked, tone_mapped, tmp_path):
    short = replace(SETTINGS, iterations=40)

    def stop(what: str, done: int, total: int, /) -> None:
        if done == 29:
            raise StoppedError

    whole = train(tracked, tone_mapped, short, tmp_path / "whole")
    with pytest.raises(StoppedError):
        train(tracked, tone_mapped, short, tmp_path / "cut", stop)
    resumed = train(tracked, tone_mapped, short, tmp_path / "cut")
    assert whole.colors is not None
    assert resumed.colors is not None
    assert torch.equal(whole.colors.maps, resumed.colors.maps)
    assert whole.colors.shading is not None
    assert resumed.colors.shading is not None
    assert torch.equal(whole.colors.shading, resumed.colors.shading)
    assert torch.equal(whole.primitives.xyz, resumed.primitives.xyz)
    stored = load_map(tmp_path / "cut/map.safetensors").colors
    assert stored is not None
    assert stored.names == tracked.names
    assert torch.equal(stored.maps, whole.colors.maps)


def test_colors_are_fitted_again_in_the_second_part_of_a_run():
    assert sorted(refit_steps(MapAppearanceSettings(refits=3), 2000)) == [800, 1200, 1600]
    assert not refit_steps(MapAppearanceSettings(refits=0), 2000)


def test_a_refit_composes_with_the_maps_of_before():
    rng = torch.Generator().manual_seed(0)
    colors = FrameColors(("a", "b", "c"), identity_maps(3) + 0.1 * torch.randn(3, 3, 4, generator=rng))
    scene = 0.2 + 0.5 * torch.rand(3, 20, 24, generator=rng)
    seen = torch.ones(20, 24)
    images = [
        m[:, :3] @ scene.flatten(1) + m[:, 3:] for m in identity_maps(3) + 0.1 * torch.randn(3, 3, 4, generator=rng)
    ]
    filmed = {name: image.reshape(3, 20, 24) for name, image in zip(colors.names, images, strict=True)}
    fits = [fit_to_view(scene, colors.common(name, filmed[name]), seen) for name in colors.names]
    after = colors.refitted(fits)
    common = [after.common(name, filmed[name]) for name in colors.names]
    before = [colors.common(name, filmed[name]) for name in colors.names]

    def spread(images: list[torch.Tensor]) -> float:
        return float(torch.stack(images).std(0).mean())

    assert spread(common) < 0.3 * spread(before)
    torch.testing.assert_close(after.maps.mean(0), identity_maps(1)[0], atol=1e-6, rtol=0)


def shadings(count: int, size: float = 0.04) -> torch.Tensor:
    drawn = size * torch.randn(count, len(ORDERS), 1, generator=torch.Generator().manual_seed(5)).expand(-1, -1, 3)
    return drawn - drawn.mean(0)


@pytest.fixture(scope="module")
def tone_mapped(tiny_dive, tmp_path_factory) -> Frames:
    """The tiny dive's frames, each exposed by itself, in gains that change over the image."""
    folder: Path = tmp_path_factory.mktemp("tones")
    listed, shading = [], shadings(len(tiny_dive.frames), 0.08)
    for i, frame in enumerate(tiny_dive.frames):
        path, image = folder / frame.name, tiny_dive.frames.image(i)
        image = image * GAINS[i % 5] * shading_gains(shading[i], *image.shape[:2]).permute(1, 2, 0)
        write_rgb(path, image.clamp(0, 1).numpy())
        listed.append(replace(frame, path=path))
    return replace(tiny_dive.frames, frames=tuple(listed))


def test_gains_that_change_over_frames_are_told_from_those_that_do_not(tiny_dive, tracked, relit, tone_mapped):
    plain = decide_appearance(tracked, relit, tracked.names, MapAppearanceSettings())
    assert plain.decision.on
    assert not plain.decision.shaded
    assert plain.colors is not None
    assert plain.colors.shading is None
    local = decide_appearance(tracked, tone_mapped, tracked.names, MapAppearanceSettings())
    assert local.decision.shaded
    assert local.decision.by_shading is not None
    assert local.decision.by_shading > 0.4
    assert "smoothly over each frame" in local.decision.reason
    for_these_alone = MapAppearanceSettings(least_explained=1.0, least_recorded=1.0)
    assert decide_appearance(tracked, tone_mapped, tracked.names, for_these_alone).decision.shaded
    assert not decide_appearance(tracked, relit, tracked.names, for_these_alone).decision.on
    by_hand = decide_appearance(tracked, tone_mapped, tracked.names, MapAppearanceSettings(shading="off"))
    assert by_hand.decision.on
    assert not by_hand.decision.shaded


def test_colors_of_frames_do_not_depend_on_the_axes_of_the_world(tracked, tone_mapped):
    """Places in the images are those of the camera, however it is turned in the world."""
    turn = so3_exp(torch.tensor([0.9, -0.4, 2.0], dtype=torch.float64))
    poses = tracked.cameras.cam2world.clone()
    poses[:, :3] = turn @ poses[:, :3]
    points = replace(tracked.points, xyz=tracked.points.xyz.double() @ turn.mT)
    turned = replace(tracked, cameras=replace(tracked.cameras, cam2world=poses), points=points)
    plain, other = (color_tracks(rec, tone_mapped, rec.names) for rec in (tracked, turned))
    assert plain.cosines is not None
    assert other.cosines is not None
    torch.testing.assert_close(other.cosines, plain.cosines, atol=1e-4, rtol=0)
    torch.testing.assert_close(other.ray_depth, plain.ray_depth)


def test_ground_has_the_average_colors_of_parts_of_each_image(tiny_dive, tracked):
    ground = ground_colors(tracked, tiny_dive.frames, tracked.names)
    assert ground is not None
    name = tracked.names[3]
    image = tiny_dive.frames.image(tiny_dive.frames.index(name))
    measured = (tracked.depth[name].z_depth > 0) & ~clipped(image).any(-1)
    across, down = image.shape[1] / 6, image.shape[0] / 4
    for color, at in zip(ground.color[ground.frame == 3], ground.cosines[ground.frame == 3], strict=True):
        x, y = (float(at[ORDERS.index(order)].clamp(-1, 1).arccos()) / torch.pi for order in ((1, 0), (0, 1)))
        column, row = int(x * 6), int(y * 4)
        part = slice(int(row * down), int((row + 1) * down)), slice(int(column * across), int((column + 1) * across))
        torch.testing.assert_close(color, image[part][measured[part]].mean(0), atol=0.02, rtol=0)
    assert int((ground.frame == 3).sum()) > 12


def test_common_colors_of_tone_mapped_frames_are_those_of_the_dive(tiny_dive, tracked, tone_mapped):
    mean = torch.stack([GAINS[tiny_dive.frames.index(name) % 5] for name in tracked.names]).mean(0)
    errors = {}
    for shading in ("auto", "off"):
        settings = MapAppearanceSettings(shading=shading)
        colors = decide_appearance(tracked, tone_mapped, tracked.names, settings).colors
        assert colors is not None
        off = []
        for name in tracked.names:
            f = tone_mapped.index(name)
            common = colors.common(name, tone_mapped.image(f).permute(2, 0, 1)).permute(1, 2, 0)
            off.append((common - tiny_dive.frames.image(f) * mean)[8:-8, 8:-8].square().mean())
        errors[shading] = float(torch.stack(off).mean().sqrt())
    assert errors["auto"] < 0.6 * errors["off"]


@pytest.mark.long
def test_a_map_of_tone_mapped_frames_learns_from_common_colors(tiny_dive, tracked, tone_mapped, tmp_path):
    scenes = {
        shading: train(
            tracked,
            tone_mapped,
            replace(SETTINGS, appearance=MapAppearanceSettings(shading=shading)),
            tmp_path / shading,
        )
        for shading in ("auto", "off")
    }
    kept = load_map(tmp_path / "auto/map.safetensors").colors
    assert kept is not None
    assert kept.shading is not None
    torch.testing.assert_close(kept.shading.mean(0), torch.zeros(len(ORDERS), 3), atol=1e-6, rtol=0)
    mean = torch.stack([GAINS[tiny_dive.frames.index(name) % 5] for name in tracked.names]).mean(0)
    truth = tiny_dive.frames.image(8)
    score = {name: psnr(scene.render(tiny_dive.cameras[8]).rgb / mean, truth) for name, scene in scenes.items()}
    assert score["auto"] > score["off"]


def test_a_refit_finds_what_a_shading_leaves():
    rng = torch.Generator().manual_seed(0)
    true = FrameColors(("a", "b", "c"), about_identity(identity_maps(3) + 0.05 * torch.randn(3, 3, 4, generator=rng)))
    true = replace(true, shading=shadings(3))
    scene = 0.2 + 0.5 * torch.rand(3, 40, 48, generator=rng)
    filmed = {}
    for k, name in enumerate(true.names):
        affine = (true.maps[k, :, :3] @ scene.flatten(1) + true.maps[k, :, 3:]).reshape(scene.shape)
        filmed[name] = affine * shading_gains(true.shading[k], 40, 48)
    colors = FrameColors(true.names, identity_maps(3), torch.zeros(3, len(ORDERS), 3))
    off = []
    for _ in range(4):
        common = {name: colors.common(name, filmed[name]) for name in true.names}
        off.append(max(float((image - scene).abs().mean()) for image in common.values()))
        fits = [fit_to_view(scene, image, torch.ones(40, 48), shaded=True) for image in common.values()]
        colors = colors.refitted(fits)
    assert off[1] < 0.4 * off[0]
    assert off[3] < 0.1 * off[0]


@pytest.mark.parametrize("pixels", ["edges", "all"])
def test_a_pose_is_refined_in_the_frames_own_colors(tiny_dive, pixels):
    settings = PoseRefinementSettings(steps=200, pixels=pixels)
    moved = tiny_dive.cameras[4].cam2world.clone()
    moved[0, 0, 3] += 0.04
    image = tiny_dive.frames.image(4) * torch.tensor([0.6, 0.8, 1.1])
    start = replace(tiny_dive.cameras[4], cam2world=moved)
    off = {}
    for name, colors in (("own", FrameColors(("a",), identity_maps(1))), ("map's", None)):
        scene = replace(tiny_dive.truth, colors=colors)
        found = refine_pose(scene, start, image, tiny_dive.frames.mask(4), settings)
        off[name] = float((found.camera.cam2world[0, :3, 3] - tiny_dive.cameras[4].cam2world[0, :3, 3]).norm())
    assert off["own"] < 0.032
    assert (off["map's"] < 0.032) == (pixels == "all")  # local differences hardly need them


def test_the_decision_comes_back_from_disk(tiny_dive, tracked, tmp_path):
    decision = decide_appearance(tracked, tiny_dive.frames, tracked.names, MapAppearanceSettings()).decision
    assert read_decision(tmp_path) is None
    write_decision(tmp_path, decision)
    assert read_decision(tmp_path) == decision


@pytest.mark.parametrize("text", ["{", "[]", '{"on": true}', '{"on": "perhaps", "reason": 3}'])
def test_a_damaged_decision_is_named(tmp_path, text):
    (tmp_path / "appearance.json").write_text(text)
    with pytest.raises(InputError, match=r"appearance\.json"):
        read_decision(tmp_path)
