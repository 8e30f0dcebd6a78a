"""The pictures of the viewer: water by the model, frames where they were taken, boxes that hold what is inside."""

import shutil
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from tests.viewer.conftest import DISTANCE

from swimm3r.cameras import image_directions, ray_depth_from_z
from swimm3r.medium import Medium, add_water, linear_from_srgb, srgb_from_linear
from swimm3r.splat.primitives.beta import BetaPrimitives, with_time
from swimm3r.splat.settings import InitialSettings
from swimm3r.viewer import viewed_run
from swimm3r.viewer.layers import BACKGROUND, CropBox, LayerChoice, Painter, ViewCamera, exposed, normal_colors, wiped
from swimm3r.viewer.scene_nodes import vertical_fov
from swimm3r.viewer.viewed_run import ViewedRun, open_viewed_run
from swimm3r.viewer.water import OtherWater, in_water, known_waters, light_of_water, water_of_run, with_amount
from swimm3r.water_types import JERLOV, JerlovType, jerlov


def frame_view(run: ViewedRun, i: int = 3) -> ViewCamera:
    """The view of a frame's camera, but with the principal point in the middle."""
    camera = run.cameras[i]
    return ViewCamera(camera.cam2world[0], vertical_fov(camera), camera.width / camera.height)


def rendered(run: ViewedRun, long_side: int = 64):
    camera = frame_view(run).at(long_side)
    out = run.scene.render(camera)
    return camera, out, ray_depth_from_z(out.z_depth, image_directions(camera).to(out.z_depth))


def test_an_amount_of_one_is_the_maps_own_image(wall: ViewedRun):
    _, out, ray_depth = rendered(wall)
    assert torch.equal(with_amount(out, ray_depth, 1.0), out.rgb)
    nearly = with_amount(out, ray_depth, 1.0 - 1e-4)
    assert (nearly - out.rgb).abs().max() < 1e-3


def test_no_water_is_the_clear_image_where_the_map_covers_it(wall: ViewedRun):
    _, out, ray_depth = rendered(wall)
    solid = out.alpha > 0.999
    assert solid.float().mean() > 0.3
    assert (with_amount(out, ray_depth, 0.0) - out.clear)[solid].abs().max() < 2e-3


def test_more_water_hides_more_of_the_scene(wall: ViewedRun):
    _, out, ray_depth = rendered(wall)
    contrast = [float(with_amount(out, ray_depth, amount).std((0, 1)).mean()) for amount in (0.0, 0.5, 1.0, 1.5, 2.0)]
    assert contrast == sorted(contrast, reverse=True)


@pytest.mark.parametrize("kind", JERLOV)
def test_a_jerlov_type_follows_the_image_formation_model_on_linear_light(wall: ViewedRun, kind):
    _, out, ray_depth = rendered(wall)
    water = OtherWater("other", jerlov(kind), "linear")
    shown = in_water(out, ray_depth, water, wall.scale)
    solid = out.alpha > 0.999
    by_hand = srgb_from_linear(add_water(linear_from_srgb(out.clear), ray_depth * wall.scale, water.medium))
    assert (shown - by_hand)[solid].abs().max() < 2e-3


def test_jerlov_types_take_red_first_in_the_ocean_and_blue_first_at_the_coast():
    strongest: dict[JerlovType, int] = {"I": 0, "III": 0, "7C": 2, "9C": 2}
    for kind, first in strongest.items():
        assert int(jerlov(kind).beta_D.argmax()) == first
    left = [float(torch.exp(-jerlov(kind).beta_D[2])) for kind in JERLOV]
    assert left == sorted(left, reverse=True)


def test_a_run_without_scale_takes_other_water_per_working_unit(wall: ViewedRun):
    """The same scene in another unit of length looks the same in the same water."""
    _, out, ray_depth = rendered(wall)
    water = known_waters()[4]
    assert torch.allclose(in_water(out, ray_depth, water, 1.0), in_water(out, 5 * ray_depth, water, 0.2), atol=1e-5)


def test_the_light_of_the_water_is_what_a_black_scene_shows(wall: ViewedRun):
    _, out, ray_depth = rendered(wall)
    water = OtherWater("other", Medium(torch.tensor([0.1, 0.5, 0.6]), torch.ones(3), torch.ones(3)), "srgb")
    black = replace(out, clear=torch.zeros_like(out.clear))
    alone = light_of_water(out, ray_depth, water, wall.scale, 1.0)
    assert torch.allclose(alone, in_water(black, ray_depth, water, wall.scale), atol=1e-6)
    assert light_of_water(out, ray_depth, None, wall.scale, 1.0) is out.backscatter


def test_the_water_of_another_run_is_that_of_its_map(wall: ViewedRun, wall_run: Path):
    found = water_of_run(wall_run)
    assert found.name == "water of wall"
    medium = wall.rec.medium
    assert (found.medium.Binf - medium.Binf).abs().max() < 0.05
    assert (found.medium.beta_D - medium.beta_D).abs().max() < 0.05


def test_the_water_of_a_run_without_a_map_is_that_of_its_medium_json(wall: ViewedRun, sfm_run: Path):
    found = water_of_run(sfm_run)
    assert torch.allclose(found.medium.beta_D, wall.rec.medium.beta_D)


def test_the_picture_of_the_cheap_path_is_the_maps_render(wall: ViewedRun):
    painter, view = Painter(wall), frame_view(wall)
    picture = painter.draw(view, 64, LayerChoice())
    whole = wall.scene.render(view.at(64))
    assert np.abs(picture.rgb / 255 - whole.rgb.clamp(0, 1).numpy()).max() <= 0.5 / 255 + 1e-6
    assert picture.z_depth is not None
    assert np.array_equal(picture.z_depth, whole.z_depth.numpy())


def test_every_layer_of_a_map_draws_another_picture(wall: ViewedRun):
    painter, view = Painter(wall), frame_view(wall)
    pictures = [painter.draw(view, 64, LayerChoice(layer)).rgb for layer in painter.layers]
    assert len(pictures) == 8
    for i, one in enumerate(pictures):
        for other in pictures[:i]:
            assert np.abs(one.astype(int) - other).mean() > 2


def test_a_frame_lies_over_the_map_where_it_was_taken(wall: ViewedRun):
    view, name = frame_view(wall), wall.rec.names[3]
    shown = Painter(wall).draw(view, 64, LayerChoice("Frame as filmed", frame=name)).rgb
    known = (shown != BACKGROUND).any(-1)
    assert known.mean() > 0.85  # the principal point is off by a pixel or two
    rendered = Painter(wall).draw(view, 64, LayerChoice()).rgb
    assert np.median(np.abs(shown.astype(int) - rendered)[known]) < 12  # the map is flat, the frame's wall is not


def test_without_a_name_the_nearest_frame_is_shown(wall: ViewedRun):
    view, painter = frame_view(wall, 5), Painter(wall)
    named = painter.draw(view, 64, LayerChoice("Frame as filmed", frame=wall.rec.names[5])).rgb
    assert np.array_equal(painter.draw(view, 64, LayerChoice("Frame as filmed")).rgb, named)


def test_a_wipe_shows_the_frame_left_and_the_map_right(wall: ViewedRun):
    painter, view = Painter(wall), frame_view(wall)
    frame, rendered = (painter.draw(view, 64, LayerChoice(name)).rgb for name in ("Frame as filmed", "With the water"))
    both = painter.draw(view, 64, LayerChoice(wipe=0.5)).rgb
    assert np.array_equal(both[:, :30], frame[:, :30])
    assert np.array_equal(both[:, 34:], rendered[:, 34:])
    assert np.array_equal(wiped(frame, rendered, 1.0)[:, :60], frame[:, :60])


def test_a_box_holds_what_is_inside(wall: ViewedRun):
    painter, view = Painter(wall), frame_view(wall)
    left_half = CropBox((-9.0, -9.0, 0.0), (0.0, 9.0, 9.0))
    center = view.cam2world[0, 3]
    z_depth = painter.draw(view, 64, LayerChoice("Depth", crop=left_half)).z_depth
    middle = 32 - float(center) * 64 / (2 * DISTANCE * np.tan(view.fov / 2) * view.aspect)
    assert (z_depth[:, : int(middle) - 8] > 0).mean() > 0.9
    assert (z_depth[:, int(middle) + 8 :] > 0).mean() < 0.05


def test_an_empty_box_shows_the_plain_background(wall: ViewedRun):
    picture = Painter(wall).draw(frame_view(wall), 64, LayerChoice(crop=CropBox((50, 50, 50), (51, 51, 51))))
    assert (picture.rgb == BACKGROUND).all()


def test_one_stop_doubles_linear_light():
    image = torch.full((2, 2, 3), 0.4)
    assert torch.allclose(linear_from_srgb(exposed(image, 1.0)), 2 * linear_from_srgb(image), atol=1e-5)
    assert exposed(image, 0.0) is image


def test_the_normal_of_a_wall_ahead_points_at_the_camera(wall: ViewedRun):
    camera = frame_view(wall).at(64)
    colors = normal_colors(torch.full((camera.height, camera.width), 2.0), camera)
    assert (colors - torch.tensor([0.5, 0.5, 1.0])).abs().max() < 1e-3


def test_a_run_with_structure_from_motion_alone_has_frames_and_points(sfm_run: Path):
    run = open_viewed_run(sfm_run, "cpu")
    painter, view = Painter(run), frame_view(run)
    assert painter.layers == ("Frame as filmed", "Frame restored", "Points alone")
    filmed = painter.draw(view, 64, LayerChoice("Frame as filmed"))
    assert filmed.z_depth is None
    assert (filmed.rgb != BACKGROUND).any(-1).mean() > 0.85
    assert (painter.draw(view, 64, LayerChoice("Points alone")).rgb == BACKGROUND).all()
    assert np.abs(painter.draw(view, 64, LayerChoice("Frame restored")).rgb[20:30, 20:40].astype(int) - 128).max() <= 1


def test_a_map_that_changes_with_time_is_drawn_at_the_second_that_is_asked_for(wall: ViewedRun):
    rng = torch.Generator().manual_seed(0)
    assert wall.scene is not None
    still = wall.scene.primitives
    assert isinstance(still, BetaPrimitives)
    moving = with_time(still, InitialSettings(time_scale=0.05), rng)
    moving = moving._replace(query_mean=torch.cat([still.query_mean, torch.zeros(len(still.xyz), 1)], -1))
    run = replace(wall, scene=replace(wall.scene, primitives=moving))  # there at the start, gone at the end
    start, end = (Painter(run).draw(frame_view(run), 64, LayerChoice(time=second)) for second in (0.0, 8.0))
    assert start.z_depth is not None
    assert end.z_depth is not None
    assert (start.z_depth > 0).mean() > 0.9
    assert (end.z_depth > 0).mean() < 0.1


def test_restored_frames_in_folders_are_found_and_the_depth_of_a_metric_run_is_taken_once(
    sfm_run: Path, monkeypatch: pytest.MonkeyPatch
):
    restored = sfm_run / "sfm" / "restored"
    shutil.move(restored, sfm_run / "left")
    shutil.move(sfm_run / "left", restored / "left")
    run = open_viewed_run(sfm_run, "cpu")
    assert run.has_restored_frames
    assert "Frame restored" in Painter(run).layers
    metric, asked = replace(run, rec=replace(run.rec, metric=True)), []
    monkeypatch.setattr(viewed_run, "median_z_depth", lambda rec: asked.append(rec) or 2.0)
    for camera in metric.cameras.cam2world[:3]:
        metric.nearest(camera)
    assert len(asked) == 1
