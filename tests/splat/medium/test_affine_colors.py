"""Colors of Gaussians by position and camera, and 3D-UIR's two networks of the medium."""

from dataclasses import replace

import pytest
import torch
from torch.autograd import gradcheck

from swimm3r.evaluate.images import psnr
from swimm3r.export.gaussians import clear_difference, clear_gaussians
from swimm3r.scale.rescale import rescaled_map
from swimm3r.splat.gaussian_settings import AffineColorSettings
from swimm3r.splat.map_file import load_map
from swimm3r.splat.medium.affine_colors import AffineColors, fourier
from swimm3r.splat.medium.field import grid_of
from swimm3r.splat.medium.uir import UirField, initial_uir_field
from swimm3r.splat.primitives.gaussian import GaussianPrimitives, initial_gaussians, mean_color, rescaled
from swimm3r.splat.projection.dispatch import project
from swimm3r.splat.projection.view_camera import view_camera
from swimm3r.splat.rendering import SplatMap, projected
from swimm3r.splat.settings import uir

SETTINGS = uir()


@pytest.fixture
def gaussians(tiny_dive) -> GaussianPrimitives:
    p = initial_gaussians(tiny_dive.rec, SETTINGS.initial, torch.Generator().manual_seed(0))
    rng = torch.Generator().manual_seed(1)
    return p._replace(harmonics=0.05 * torch.randn(p.harmonics.shape, generator=rng), opacity=p.opacity + 4)


def last_layer(field: UirField) -> torch.nn.Module:
    assert field.affine_colors is not None
    return list(field.affine_colors.color)[-1]


def field_over(p: GaussianPrimitives, learned: float = 0.0) -> UirField:
    """A field before the first step, or one whose colors have learned something."""
    rng = torch.Generator().manual_seed(0)
    field = initial_uir_field(SETTINGS.medium, SETTINGS.affine_colors, p.xyz, rng)
    if learned:
        with torch.no_grad():
            for values in last_layer(field).parameters():
                values.normal_(0, learned, generator=rng)
    return field.requires_grad_(False)


def test_colors_begin_as_they_are(tiny_dive, gaussians):
    view = view_camera(tiny_dive.cameras[3])
    plain = project(gaussians, view, SETTINGS.render)
    first = projected(gaussians, field_over(gaussians), view, SETTINGS)
    torch.testing.assert_close(first.primitives.color, plain.primitives.color)


def test_learned_colors_are_affine_in_the_own_ones_and_change_with_the_camera(tiny_dive, gaussians):
    field = field_over(gaussians, 0.1)
    assert field.affine_colors is not None
    changed = []
    for k in (1, 7):
        view = view_camera(tiny_dive.cameras[k])
        own = project(gaussians, view, SETTINGS.render).primitives.color
        gain, offset = field.affine_colors.affine(gaussians.xyz, mean_color(gaussians), view, field.length)
        seen = projected(gaussians, field, view, SETTINGS).primitives.color
        torch.testing.assert_close(seen, (gain * own + offset).clamp(min=0))
        changed.append(gain)
    assert (changed[0] - 1).abs().mean() > 0.01
    assert (changed[0] - changed[1]).abs().mean() > 1e-3


def test_features_are_the_sines_and_cosines_of_the_octaves():
    x = torch.tensor([[0.3, -0.7]]).double()
    expected = [f(2.0**m * torch.pi * v) for f in (torch.sin, torch.cos) for v in x[0] for m in (1, 2, 3, 4)]
    torch.testing.assert_close(fourier(x, 4, 1)[0], torch.stack(expected))


def test_colors_do_not_depend_on_the_unit_of_the_map(tiny_dive, gaussians):
    field, view = field_over(gaussians, 0.1), view_camera(tiny_dive.cameras[2])
    assert field.affine_colors is not None
    before = field.affine_colors.affine(gaussians.xyz, mean_color(gaussians), view, field.length)
    field.length.fill_(2.5)
    grown, farther = rescaled(gaussians, 2.5), replace(view, center=2.5 * view.center, t=2.5 * view.t)
    after = field.affine_colors.affine(grown.xyz, mean_color(grown), farther, field.length)
    for a, b in zip(before, after, strict=True):
        torch.testing.assert_close(a, b, atol=1e-5, rtol=1e-4)


def test_colors_have_the_gradients_of_networks_and_mean_colors_but_place_nothing(tiny_dive):
    colors = AffineColors(AffineColorSettings(hidden=5, embedding=3, octaves=2, pose_octaves=2)).double()
    view = view_camera(tiny_dive.cameras[2], torch.float64)
    rng = torch.Generator().manual_seed(0)
    xyz = torch.randn(4, 3, generator=rng).double().requires_grad_()
    mean = torch.rand(4, 3, generator=rng).double().requires_grad_()
    one = torch.ones(()).double()
    names = [name for name, _ in colors.named_parameters()]
    with torch.no_grad():
        for values in colors.parameters():
            values.normal_(0, 0.5, generator=rng)

    class Both(torch.nn.Module):
        def __init__(self) -> None:
            super().__init__()
            self.colors = colors

        def forward(self, mean):
            return torch.cat(self.colors.affine(xyz, mean, view, one), -1)

    both = Both()

    def run(mean, *values):
        parameters = {f"colors.{name}": v for name, v in zip(names, values, strict=True)}
        return torch.func.functional_call(both, parameters, (mean,))

    assert gradcheck(run, (mean, *colors.parameters()))
    assert torch.autograd.grad(both(mean).sum(), xyz, allow_unused=True)[0] is None


def test_backscatter_and_attenuation_have_networks_of_their_own(tiny_dive, gaussians):
    field = field_over(gaussians).requires_grad_(True)
    values = grid_of(field, view_camera(tiny_dive.cameras[3]), 8).values
    assert (values > 0).all()
    assert (values[:3] < 1).all()
    of = {"backscatter": values[:6], "attenuation": values[6:]}
    for name, shown in of.items():
        grads = torch.autograd.grad(
            shown.sum(), list(field.network.parameters()), retain_graph=True, materialize_grads=True
        )
        for (parameter, _), grad in zip(field.network.named_parameters(), grads, strict=True):
            assert bool(grad.any()) == (name in parameter)


def test_a_map_is_kept_and_exported_in_the_colors_that_cameras_see(tiny_dive, gaussians, tmp_path):
    scene = SplatMap(gaussians, field_over(gaussians, 0.1), SETTINGS, True)
    plain = SplatMap(gaussians, field_over(gaussians), SETTINGS, True)
    camera = tiny_dive.cameras[4]
    scene.save(tmp_path / "map.safetensors")
    kept = load_map(tmp_path / "map.safetensors")
    assert torch.equal(kept.render(camera).rgb, scene.render(camera).rgb)
    one = tiny_dive.cameras[4:5]
    assert clear_difference(scene, clear_gaussians(scene, one), one).psnr > 40
    assert clear_difference(scene, clear_gaussians(plain, one), one).psnr < 35
    torch.testing.assert_close(scene.to(torch.device("cpu")).render(camera).clear, scene.render(camera).clear)


def test_a_map_brought_to_scale_looks_the_same(tiny_dive, gaussians, tmp_path):
    scene, camera = SplatMap(gaussians, field_over(gaussians, 0.1), SETTINGS, False), tiny_dive.cameras[4]
    before = scene.render(camera)
    scene.save(tmp_path / "map.safetensors")
    scaled = rescaled_map(load_map(tmp_path / "map.safetensors"), 3.0)
    cam2world = camera.cam2world.clone()
    cam2world[:, :3, 3] *= 3
    after = scaled.render(replace(camera, cam2world=cam2world))
    assert psnr(after.rgb, before.rgb) > 50
    torch.testing.assert_close(after.z_depth, 3 * before.z_depth, atol=1e-2, rtol=1e-3)
