"""Depth that colors tell through known water, on ground whose far half has no measured depth."""

from dataclasses import replace

import pytest
import torch

from swimm3r.imaging.depth_completion import DepthCue, fill_z_depth, on_grid
from swimm3r.imaging.depth_from_color import depth_from_color
from swimm3r.lamp import Lamp
from swimm3r.medium import AttenuationCurve, Medium, MediumFit, backscatter, transmittances
from swimm3r.scene.reconstruction import DepthMap

HEIGHT, WIDTH = 72, 96
SEA = torch.zeros(HEIGHT, WIDTH)
BETA = torch.tensor([0.30, 0.12, 0.15])


@pytest.fixture
def rays() -> torch.Tensor:
    v, u = torch.meshgrid(torch.linspace(-0.4, 0.4, HEIGHT), torch.linspace(-0.5, 0.5, WIDTH), indexing="ij")
    return torch.stack([u, v, torch.ones_like(u)], -1)


@pytest.fixture
def z() -> torch.Tensor:
    """Ground that recedes to the right, from 1.5 to 3, and from the middle on a wall at 3."""
    recedes = 1 / torch.linspace(1 / 1.5, 1 / 4.5, WIDTH).expand(HEIGHT, WIDTH)
    return recedes.clamp(max=3.0)


def water(strength: float = 1.0, lamp: Lamp | None = None) -> MediumFit:
    beta, none = strength * BETA, torch.zeros(3)
    curve = AttenuationCurve(beta, none, none, none)
    std, known = Medium(none, none, none), {name: torch.ones(3, dtype=torch.bool) for name in vars(Medium(*[none] * 3))}
    Binf = torch.tensor([0.05, 0.25, 0.30])
    return MediumFit(Binf, beta, beta, curve, std, known, (0.1, 50.0), "srgb", lamp=lamp)


def filmed(z: torch.Tensor, rays: torch.Tensor, fit: MediumFit) -> tuple[torch.Tensor, DepthMap]:
    """The image of gray ground in patches of six pixels, and depth of its left half."""
    generator = torch.Generator().manual_seed(1)
    patches = 0.4 + 0.08 * torch.randn(HEIGHT // 6, WIDTH // 6, 1, generator=generator)
    J = (patches * torch.tensor([1.1, 1.0, 0.9])).repeat_interleave(6, 0).repeat_interleave(6, 1)
    path = z * rays.norm(dim=-1)
    medium = fit.at(path, torch.nn.functional.normalize(rays, dim=-1))
    I = J * transmittances(path, medium)[0] + backscatter(path, medium)
    I = I + 0.004 * torch.randn(I.shape, generator=generator)
    known = torch.arange(WIDTH).expand(HEIGHT, WIDTH) < WIDTH // 2
    return I.clamp(0, 1), DepthMap(torch.where(known, z, 0.0), known.float())


def error(I: torch.Tensor, depth: DepthMap, z: torch.Tensor, cue: DepthCue | None) -> float:
    filled = fill_z_depth(I, depth, SEA, cue=cue)
    return float((filled / z).log().abs()[depth.z_depth == 0].mean())


LAMP = Lamp(torch.tensor([0.2, -0.1, 0.0]), 2.0, 2 / 2.2, 1.0, torch.zeros(6), torch.zeros(6))


@pytest.mark.parametrize("lamp", [None, LAMP], ids=["daylight", "lamp"])
def test_a_wall_stands_where_its_colors_are_those_of_near_ground(
    lamp: Lamp | None, z: torch.Tensor, rays: torch.Tensor
):
    fit = water(lamp=lamp)
    I, depth = filmed(z, rays, fit)
    cue = depth_from_color(I, depth, SEA, rays, fit)
    assert cue is not None
    assert error(I, depth, z, cue) < 0.5 * error(I, depth, z, None)


def test_colors_tell_nothing_in_clear_water(z: torch.Tensor, rays: torch.Tensor):
    clear = water(1e-4)
    I, depth = filmed(z, rays, clear)
    cue = depth_from_color(I, depth, SEA, rays, clear)
    assert cue is not None
    filled, alone = fill_z_depth(I, depth, SEA, cue=cue), fill_z_depth(I, depth, SEA)
    torch.testing.assert_close(filled, alone, rtol=1e-2, atol=0)


def test_colors_are_believed_less_under_water_that_is_not_the_scenes(z: torch.Tensor, rays: torch.Tensor):
    I, depth = filmed(z, rays, water())
    right, wrong = (depth_from_color(I, depth, SEA, rays, water(strength)) for strength in (1.0, 0.25))
    assert right is not None
    assert wrong is not None
    assert wrong.trust.max() < 0.2 * right.trust.max()


def test_what_is_measured_and_the_sea_are_told_nothing(z: torch.Tensor, rays: torch.Tensor):
    I, depth = filmed(z, rays, water())
    sea = SEA.clone()
    sea[:20] = 1.0
    cue = depth_from_color(I, depth, sea, rays, water())
    assert cue is not None
    asked = (on_grid((depth.z_depth > 0).float()) <= 0.5) & (on_grid(sea) < 0.5)
    assert (cue.trust > 0).any()
    assert not (cue.trust[~asked] > 0).any()


def test_too_few_known_cells_tell_nothing_of_the_colors(z: torch.Tensor, rays: torch.Tensor):
    I, depth = filmed(z, rays, water())
    few = torch.zeros_like(z)
    few[:4, :4] = z[:4, :4]
    assert depth_from_color(I, replace(depth, z_depth=few), SEA, rays, water()) is None


def test_lengths_may_be_of_any_unit(z: torch.Tensor, rays: torch.Tensor):
    I, depth = filmed(z, rays, water())
    cue = depth_from_color(I, depth, SEA, rays, water())
    scaled = depth_from_color(I, replace(depth, z_depth=100 * depth.z_depth), SEA, rays, _in_hundredths(water()))
    assert cue is not None
    assert scaled is not None
    torch.testing.assert_close(100 * scaled.inverse[cue.trust > 0], cue.inverse[cue.trust > 0], rtol=1e-3, atol=0)
    torch.testing.assert_close(scaled.trust, cue.trust, rtol=1e-2, atol=1e-12)


def _in_hundredths(fit: MediumFit) -> MediumFit:
    curve = replace(fit.curve, a=fit.curve.a / 100)
    return replace(fit, beta_D=fit.beta_D / 100, beta_B=fit.beta_B / 100, curve=curve, z_range=(10.0, 5000.0))
