"""Restored images and points: the inverse where the water lets it, calm where it does not."""

from dataclasses import replace

import pytest
import torch

from swimm3r.cameras import Cameras, image_directions, ray_depth_from_z
from swimm3r.imaging.open_water import open_water_mask
from swimm3r.lamp import Lamp
from swimm3r.medium import AttenuationCurve, Medium, MediumFit, add_water, linear_from_srgb, srgb_from_linear
from swimm3r.scene.reconstruction import DepthMap
from swimm3r.sfm.medium.restore import display_gains, restore_image


def exact(medium: Medium) -> MediumFit:
    """The true water as if it had been fitted."""
    zero = torch.zeros(3)
    known = {name: torch.ones(3, dtype=torch.bool) for name in ("Binf", "beta_D", "beta_B")}
    curve = AttenuationCurve(medium.beta_D, zero, zero, zero)
    std = Medium(zero, zero, zero)
    return MediumFit(**vars(medium), curve=curve, std=std, identifiable=known, z_range=(0.1, 50.0), encoding="srgb")


def rays_of(camera: Cameras) -> torch.Tensor:
    return image_directions(camera).float()


def psnr(a: torch.Tensor, b: torch.Tensor) -> float:
    return float(-10 * torch.log10(((a - b) ** 2).mean()))


def horizon_image(medium: Medium) -> tuple[torch.Tensor, DepthMap]:
    """Textured ground in the lower half, open water with pixel noise above."""
    g = torch.Generator().manual_seed(3)
    image = medium.Binf + 0.004 * torch.randn(96, 128, 3, generator=g)
    J = torch.rand(12, 32, 3, generator=g).repeat_interleave(4, 0).repeat_interleave(4, 1)
    z = torch.linspace(4.0, 1.0, 48)[:, None].expand(48, 128)
    image[48:] = add_water(J, z, medium)
    z_depth = torch.zeros(96, 128)
    z_depth[48:] = z
    return image.clamp(0, 1), DepthMap(z_depth, (z_depth > 0).float())


def test_a_image_with_known_depth_gets_its_clear_colors_back(dive):
    name = dive.rec.names[2]
    J = restore_image(
        dive.frames.image(2), dive.rec.depth[name], rays_of(dive.rec.cameras[2]), exact(dive.medium)
    ).shown
    assert psnr(J, dive.clear[2]) > 33


def test_gaps_in_the_depth_leave_no_holes_in_the_image(dive):
    depth = dive.rec.depth[dive.rec.names[2]]
    z = depth.z_depth.clone()
    z[20:40, 30:60] = 0
    z[torch.rand(z.shape, generator=torch.Generator().manual_seed(0)) < 0.3] = 0
    patchy = DepthMap(z, (z > 0).float())
    J = restore_image(dive.frames.image(2), patchy, rays_of(dive.rec.cameras[2]), exact(dive.medium)).shown
    assert psnr(J, dive.clear[2]) > 28


def test_surfaces_of_unknown_depth_in_green_water_look_like_those_of_known_depth(dive):
    green = Medium(torch.tensor([0.02, 0.5, 0.35]), torch.tensor([0.2, 0.3, 0.2]), torch.tensor([0.1, 0.5, 0.3]))
    g = torch.Generator().manual_seed(0)
    J = torch.tensor([0.25, 0.5, 0.35]) * (0.6 + 0.4 * torch.rand(18, 24, 1, generator=g))
    J = J.repeat_interleave(4, 0).repeat_interleave(4, 1)
    z = torch.full((72, 96), 2.0)
    camera = dive.rec.cameras[0]
    raw = add_water(J, ray_depth_from_z(z, image_directions(camera).float()), green)
    z[20:50, 50:] = 0
    restored = restore_image(raw, DepthMap(z, (z > 0).float()), rays_of(camera), exact(green)).clear
    assert psnr(restored[25:45, 60:], J[25:45, 60:]) > 28


def test_colors_correct_guessed_depth_only_where_the_water_is_no_guess(dive):
    """Ground recedes to the right and ends at a wall, of which nothing was measured."""
    g = torch.Generator().manual_seed(1)
    beta = torch.tensor([0.30, 0.12, 0.15])
    water = Medium(torch.tensor([0.05, 0.25, 0.30]), beta, beta)
    z = (1 / torch.linspace(1 / 1.5, 1 / 4.5, 96).expand(72, 96)).clamp(max=3.0)
    J = (0.4 + 0.08 * torch.randn(12, 16, 1, generator=g)).repeat_interleave(6, 0).repeat_interleave(6, 1)
    rays = rays_of(dive.rec.cameras[0])
    raw = add_water(J.expand(-1, -1, 3), z * rays.norm(dim=-1), water)
    measured = torch.where(torch.arange(96) < 48, z, 0.0)
    fit = exact(water)
    guess = replace(fit, std=replace(fit.std, beta_D=torch.ones(3)))
    told, gone_on = (
        restore_image(raw, DepthMap(measured, (measured > 0).float()), rays, of).ray_depth / rays.norm(dim=-1)
        for of in (fit, guess)
    )
    assert float(told[:, 84:].mean()) == pytest.approx(3.0, rel=0.1)
    assert float(gone_on[:, 84:].mean()) < 2.6


def test_gray_ground_of_guessed_depth_is_restored_as_that_around_it(dive):
    gray = Medium(torch.full((3,), 0.5), torch.full((3,), 0.3), torch.full((3,), 0.3))
    rays = rays_of(dive.rec.cameras[0])
    raw = add_water(torch.full((72, 96, 3), 0.4), 2.0 * rays.norm(dim=-1), gray)
    measured = torch.full((72, 96), 2.0)
    measured[25:45, 55:75] = 0
    restored = restore_image(raw, DepthMap(measured, (measured > 0).float()), rays, exact(gray)).clear
    torch.testing.assert_close(restored[25:45, 55:75], torch.full((20, 20, 3), 0.4), atol=0.01, rtol=0)


def test_red_ground_of_guessed_depth_under_a_lamp_stays_red(dive):
    """No distance makes it gray, and the lamp is not held to stand right before it for that."""
    beta = torch.full((3,), 0.02)
    lamp = Lamp(torch.tensor([0.2, -0.1, 0.0]), 2.0, 2 / 2.2, 1.0, torch.zeros(6), torch.zeros(6))
    fit = replace(exact(Medium(torch.zeros(3), beta, beta)), lamp=lamp)
    rays = rays_of(dive.rec.cameras[0])
    path = 2.0 * rays.norm(dim=-1)
    J = torch.tensor([0.45, 0.5, 0.45]).expand(72, 96, 3).clone()
    J[20:50, 50:80] = torch.tensor([0.5, 0.35, 0.3])
    raw = add_water(J, path, fit.at(path, torch.nn.functional.normalize(rays, dim=-1)))
    measured = torch.full((72, 96), 2.0)
    measured[25:45, 55:75] = 0
    restored = restore_image(raw, DepthMap(measured, (measured > 0).float()), rays, fit).clear
    torch.testing.assert_close(restored[27:43, 57:73], J[27:43, 57:73], atol=0.02, rtol=0)


def test_bright_sand_has_no_seam_where_its_depth_is_guessed(dive):
    """Filmed at 0.9 already, it is brighter still without the water: as it is beside, where its depth is known."""
    blue = Medium(torch.tensor([0.0, 0.13, 0.38]), torch.tensor([0.064, 0.022, 0.023]), torch.tensor([0.03, 0.2, 0.05]))
    g = torch.Generator().manual_seed(0)
    J = torch.tensor([0.4, 0.8, 1.0]) * (0.9 + 0.1 * torch.rand(18, 24, 1, generator=g))
    J[12:] *= 0.5  # darker ground in front
    J = J.repeat_interleave(4, 0).repeat_interleave(4, 1)
    z = torch.full((72, 96), 16.0)
    raw = add_water(J, ray_depth_from_z(z, image_directions(dive.rec.cameras[0]).float()), blue)
    assert raw[:48].amax(-1).mean() > 0.84
    z[:40, 56:] = 0
    restored = restore_image(raw, DepthMap(z, (z > 0).float()), rays_of(dive.rec.cameras[0]), exact(blue)).clear
    known, guessed = restored[8:32, 36:52].mean((0, 1)), restored[8:32, 64:88].mean((0, 1))
    torch.testing.assert_close(guessed, known, atol=0.02, rtol=0)


def test_a_linear_fit_restores_light_that_was_lost_in_linear_light(dive):
    fit = exact(dive.medium)
    linear = replace(fit, encoding="linear")
    z = torch.full((dive.frames.height, dive.frames.width), 1.7)
    near = torch.ones_like(z)
    camera = dive.rec.cameras[2]
    clear = dive.clear[2]
    ray_depth = ray_depth_from_z(z, image_directions(camera).float())
    raw = srgb_from_linear(add_water(linear_from_srgb(clear), ray_depth, dive.medium))
    assert psnr(restore_image(raw, DepthMap(z, near), rays_of(camera), linear).shown, clear) > 30


def test_open_water_is_found_above_the_horizon_and_nowhere_else(teal):
    image, depth = horizon_image(teal)
    mask = open_water_mask(image, depth.z_depth)
    assert mask[:40].float().mean() > 0.7
    assert not mask[48:].any()


def test_smooth_darkness_is_not_open_water(teal):
    image, depth = horizon_image(teal)
    image[:48] = 0.02
    assert not open_water_mask(image, depth.z_depth).any()


def test_open_water_keeps_its_color_instead_of_amplified_noise(teal, dive):
    image, depth = horizon_image(teal)
    camera = replace(dive.rec.cameras[0], width=128, height=96)
    J = restore_image(image, depth, rays_of(camera), exact(teal)).shown
    assert (J[:36] - teal.Binf).abs().amax(-1).median() < 0.03
    assert J[:36].std((0, 1)).max() < 0.03


def test_noise_is_not_amplified_where_a_channel_no_longer_sees(dive):
    dead = Medium(dive.medium.Binf, torch.tensor([3.0, 0.1, 0.1]), torch.tensor([1.0, 0.1, 0.1]))
    z = torch.full((72, 96), 2.0)
    gray = torch.full((72, 96, 3), 0.4)
    noise = 0.01 * torch.randn(72, 96, 3, generator=torch.Generator().manual_seed(2))
    raw = (add_water(gray, z, dead) + noise).clamp(0, 1)
    J = restore_image(raw, DepthMap(z, torch.ones_like(z)), rays_of(dive.rec.cameras[0]), exact(dead)).shown
    assert J[..., 0].std() < 0.1  # the plain inverse has 0.01 / exp(-6) = 4
    assert J[..., 1].std() < 0.02


def test_a_gray_dive_needs_no_white_balance():
    torch.testing.assert_close(display_gains(torch.rand(500, 1).expand(-1, 3) * 0.9), torch.ones(3))


def test_white_balance_makes_tinted_surfaces_gray():
    tinted = torch.linspace(0.1, 0.7, 300)[:, None] * torch.tensor([0.6, 1.0, 0.9])
    balanced = tinted * display_gains(tinted)
    torch.testing.assert_close(balanced[:, 0], balanced[:, 1], atol=1e-3, rtol=1e-3)


def test_display_gains_color_surfaces_and_leave_open_water_as_it_was(teal, dive):
    image, depth = horizon_image(teal)
    camera = replace(dive.rec.cameras[0], width=128, height=96)
    plain = restore_image(image, depth, rays_of(camera), exact(teal)).shown
    gained = restore_image(image, depth, rays_of(camera), exact(teal), gains=torch.tensor([1.2, 0.9, 0.9])).shown
    torch.testing.assert_close(gained[:20], plain[:20])
    assert (gained[70:, :, 1] < 0.95 * plain[70:, :, 1]).float().mean() > 0.9
