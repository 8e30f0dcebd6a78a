"""Images of a map: water, clear colors, backscatter and depth are consistent."""

from dataclasses import replace

import pytest
import torch

from swimm3r.cameras import Cameras, image_directions, ray_depth_from_z
from swimm3r.errors import DeviceError
from swimm3r.medium import add_water
from swimm3r.splat.pose_refinement import RefinedPose, refine_pose
from swimm3r.splat.primitives.beta import select
from swimm3r.splat.rendering import SplatMap


def test_where_nothing_is_there_is_only_water(wall, camera):
    scene = wall(10)
    empty = replace(scene, primitives=select(scene.primitives, torch.zeros(0, dtype=torch.int64)))
    out = empty.render(camera())
    torch.testing.assert_close(out.rgb, out.medium.Binf, atol=1e-6, rtol=0)
    torch.testing.assert_close(out.backscatter, out.rgb)
    assert (out.z_depth == 0).all()
    assert (out.clear == 0).all()


def test_a_surface_looks_as_the_water_makes_it_look_along_the_ray(wall, camera):
    """One opaque primitive far off the axis: Eq. 3 at its *ray* depth, in the share that it covers."""
    view = camera()
    scene = wall(10)
    p = select(scene.primitives, torch.tensor([0]))
    pose = view.cam2world[0]
    ray = image_directions(view)[50, 6].double()
    at = pose[:3, :3] @ (4 * ray) + pose[:3, 3]
    direction = torch.nn.functional.normalize(at - pose[:3, 3], dim=-1)
    p = p._replace(xyz=at[None].float(), query_mean=direction[None].float(), opacity=torch.full((1,), 12.0))
    out = replace(scene, primitives=p).render(view)
    ray_depth = ray_depth_from_z(torch.tensor(4.0), ray.float())
    assert ray_depth > 4.5
    medium = type(out.medium)(*(values[50, 6] for values in vars(out.medium).values()))
    expected = add_water(p.rgb[0], ray_depth, medium)
    share = out.alpha[50, 6]
    assert share > 0.9  # its light is averaged over the pixel
    torch.testing.assert_close(out.rgb[50, 6], share * expected + (1 - share) * medium.Binf, atol=1e-4, rtol=0)
    assert out.z_depth[50, 6] == pytest.approx(4.0, abs=1e-3)


def test_the_image_is_the_backscatter_plus_what_comes_through(wall, camera):
    scene = wall()
    out = scene.render(camera())
    assert (out.backscatter <= out.medium.Binf + 1e-5).all()
    assert (out.rgb >= out.backscatter - 1e-5).all()


def test_without_water_the_image_is_the_clear_one(wall, camera):
    scene = wall()
    with torch.no_grad():
        last = scene.field.network[-1]
        last.bias[:3] = -30.0
        last.bias[3:] = -30.0
    out = scene.render(camera())
    # as far as something covers the pixel: black water shows through the rest
    torch.testing.assert_close(out.rgb, out.clear * out.alpha.clamp(min=0.5)[..., None], atol=1e-5, rtol=0)


def test_a_wall_stands_where_it_is(wall, camera):
    out = wall().render(camera())
    covered = out.alpha > 0.95
    assert covered.double().mean() > 0.7
    assert out.z_depth[covered].min() > 2.4
    assert out.z_depth[covered].max() < 3.6


def test_more_water_between_means_less_clear_color(wall, camera):
    scene, view = wall(), camera()
    near = scene.render(view)
    pose = view.cam2world.clone()
    pose[:, 2, 3] -= 1.5
    far = scene.render(replace(view, cam2world=pose))
    both = (near.alpha > 0.95) & (far.alpha > 0.95)
    through = [(o.rgb - o.backscatter)[both].mean() / o.clear[both].mean() for o in (near, far)]
    assert through[1] < 0.8 * through[0]


def refined(scene: SplatMap, view: Cameras) -> RefinedPose:
    return refine_pose(scene, view, torch.zeros(view.height, view.width, 3), torch.ones(view.height, view.width) > 0)


@pytest.mark.parametrize("look", [SplatMap.render, refined])
def test_a_view_that_does_not_fit_the_accelerator_says_what_to_make_smaller(wall, camera, monkeypatch, look):
    def too_much(*_, **__):
        raise torch.OutOfMemoryError("CUDA out of memory. Tried to allocate 20 GiB")

    monkeypatch.setattr("swimm3r.splat.rendering.project", too_much)
    with pytest.raises(DeviceError, match="too small for views of this map") as caught:
        look(wall(10), camera())
    assert "CUDA_VISIBLE_DEVICES=" in (caught.value.hint or "")
