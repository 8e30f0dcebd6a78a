"""Snell's law and rays through ports: limits, reversibility, symmetry."""

import math
from typing import Any

import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from torch.nn.functional import normalize

from swimm3r.refraction.ports import DomePort, FlatPort, magnification, port_of, refract, through_port
from swimm3r.refraction.settings import PortSettings

GLASS, WATER = 1.49, 1.333
FLAT = FlatPort(0.05, 0.01, GLASS, WATER)
DOME = DomePort(0.05, 0.005, 0.05, GLASS, WATER)


def fan(degrees: float = 60.0) -> torch.Tensor:
    """Rays up to an angle from the axis, all around it."""
    angle = torch.deg2rad(torch.linspace(0, degrees, 13, dtype=torch.float64))[:, None]
    turn = torch.linspace(0, 2 * math.pi, 8, dtype=torch.float64)[None]
    across = angle.sin()
    return torch.stack([across * turn.cos(), across * turn.sin(), angle.cos().expand(-1, 8)], -1).reshape(-1, 3)


units = st.tuples(*[st.floats(-1, 1)] * 3).filter(lambda v: math.hypot(*v) > 0.1)


@given(units, units, st.floats(1, 2), st.floats(1, 2))
def test_light_goes_back_the_way_it_came(direction: Any, normal: Any, before: float, after: float):
    d, m = (normalize(torch.tensor([v], dtype=torch.float64), dim=-1) for v in (direction, normal))
    onward = refract(d, m, before, after)
    if bool(onward.isfinite().all()) and abs(float((d * m).sum())) > 1e-3:
        torch.testing.assert_close(refract(-onward, m, after, before), -d, atol=1e-6, rtol=0)


@given(units, units, st.floats(1, 2), st.floats(1, 2))
def test_the_sines_stand_as_the_indices_say_and_the_ray_stays_in_its_plane(
    direction: Any, normal: Any, before: float, after: float
):
    d, m = (normalize(torch.tensor([v], dtype=torch.float64), dim=-1) for v in (direction, normal))
    onward = refract(d, m, before, after)
    if bool(onward.isfinite().all()):
        cross, cross_onward = torch.linalg.cross(m, d), torch.linalg.cross(m, onward)
        torch.testing.assert_close(before * cross, after * cross_onward, atol=1e-9, rtol=0)
        torch.testing.assert_close(torch.linalg.vector_norm(onward, dim=-1), torch.ones(1, dtype=torch.float64))
        assert float((d * m).sum() * (onward * m).sum()) >= -1e-12


def test_normal_incidence_and_equal_indices_do_not_bend():
    axis = torch.tensor([[0.0, 0.0, 1.0]], dtype=torch.float64)
    torch.testing.assert_close(refract(axis, -axis, 1.0, 1.5), axis)
    torch.testing.assert_close(refract(fan(), -axis, 1.333, 1.333), fan())


def test_beyond_the_critical_angle_no_light_leaves_the_water():
    axis = torch.tensor([[0.0, 0.0, 1.0]], dtype=torch.float64)
    critical = math.degrees(math.asin(1 / WATER))
    for angle, passes in ((critical - 0.1, True), (critical + 0.1, False)):
        ray = torch.tensor([[math.sin(math.radians(angle)), 0.0, math.cos(math.radians(angle))]], dtype=torch.float64)
        assert bool(refract(ray, axis, WATER, 1.0).isfinite().all()) is passes


def test_behind_a_flat_port_the_angle_in_water_does_not_depend_on_the_glass():
    rays = fan()
    for thickness, glass in ((0.0, 1.0), (0.01, 1.49), (0.2, 1.77)):
        seen = through_port(rays, FlatPort(0.05, thickness, glass, WATER))
        torch.testing.assert_close(WATER * seen.direction[:, :2], rays[:, :2])
        torch.testing.assert_close(seen.start[:, 2], torch.full_like(seen.start[:, 2], 0.05 + thickness))


def test_without_distance_and_thickness_all_rays_leave_the_pupil():
    seen = through_port(fan(), FlatPort(0.0, 0.0, GLASS, WATER))
    assert float(seen.start.abs().max()) == 0.0


def test_media_of_one_index_leave_rays_as_they_are():
    for port in (FlatPort(0.05, 0.01, 1.0, 1.0), DomePort(0.03, 0.005, 0.05, 1.0, 1.0)):
        seen = through_port(fan(), port)
        torch.testing.assert_close(seen.direction, fan())
        torch.testing.assert_close(normalize(seen.start, dim=-1), fan())


def test_a_centered_dome_bends_no_ray():
    seen = through_port(fan(89.0), DOME)
    torch.testing.assert_close(seen.direction, fan(89.0))
    torch.testing.assert_close(seen.start, 0.055 * fan(89.0))


def test_a_dome_of_a_great_radius_is_a_flat_port():
    flat, dome = (through_port(fan(), port) for port in (FLAT, DomePort(0.05, 0.01, 1e5, GLASS, WATER)))
    torch.testing.assert_close(dome.direction, flat.direction, atol=1e-5, rtol=0)
    torch.testing.assert_close(dome.start, flat.start, atol=1e-5, rtol=0)


@pytest.mark.parametrize("port", [FLAT, DOME, DomePort(0.04, 0.01, 0.06, GLASS, WATER)])
def test_the_magnification_is_that_of_rays_near_the_axis(port: FlatPort | DomePort):
    ray = torch.tensor([[1e-5, 0.0, 1.0]], dtype=torch.float64)
    seen = through_port(ray, port).direction[0]
    assert magnification(port) == pytest.approx(1e-5 / float(seen[0] / seen[2]), rel=1e-6)


def test_a_ray_that_misses_the_dome_has_no_direction():
    assert not bool(through_port(fan(80.0), DomePort(0.2, 0.001, 0.05, GLASS, WATER)).direction.isfinite().all())


def test_ports_of_settings_have_their_defaults():
    assert port_of("none", PortSettings()) is None
    assert port_of("flat", PortSettings()) == FlatPort(0.01, 0.003, 1.49, 1.333)
    dome = port_of("dome", PortSettings(radius=0.07))
    assert isinstance(dome, DomePort)
    assert dome.center == 0
