"""Habitat figures on surfaces whose figures are known, and their invariances."""

from dataclasses import asdict

import numpy as np
import pytest
from scipy.integrate import quad

from swimm3r.products.habitat.figures import Figures, figures, fractal_dimension

D = 0.01


def lattice(rows: int = 101, columns: int = 121, spacing: float = D) -> tuple[np.ndarray, np.ndarray]:
    """x to the east and y to the north; the first row is in the north."""
    x, y = np.meshgrid(np.arange(columns) * spacing, -np.arange(rows) * spacing)
    return x, y


def known(height: np.ndarray, spacing: float = D) -> Figures:
    found = figures(height, spacing)
    assert found is not None
    return found


@pytest.mark.parametrize("degrees", [0, 10, 45, 70])
@pytest.mark.parametrize("azimuth", [30, 200])
def test_a_tilted_plane_has_the_ratio_of_its_slope(degrees: float, azimuth: float):
    x, y = lattice()
    away, tangent = np.radians(azimuth), np.tan(np.radians(degrees))
    found = known(-tangent * (np.sin(away) * x + np.cos(away) * y))  # falls towards the azimuth
    assert found.rugosity == pytest.approx(1 / np.cos(np.radians(degrees)), rel=1e-9)
    assert found.slope_corrected_rugosity == pytest.approx(1)
    assert found.slope_deg == pytest.approx(degrees, abs=1e-9)
    assert found.mean_slope_deg == pytest.approx(degrees, abs=1e-9)
    assert found.vector_ruggedness == pytest.approx(0, abs=1e-9)
    assert found.planar_area == pytest.approx(1.0 * 1.2)
    assert found.aspect_deg is None if degrees == 0 else found.aspect_deg == pytest.approx(azimuth)


def test_a_sinusoid_has_the_area_and_the_chain_of_its_integral():
    amplitude, wave = 0.05, 2 * np.pi / 0.4
    x, _ = lattice(columns=401)  # ten waves
    found = known(amplitude * np.sin(wave * x))
    along = quad(lambda t: np.sqrt(1 + (amplitude * wave * np.cos(wave * t)) ** 2), 0, 0.4)[0] / 0.4
    assert found.rugosity == pytest.approx(along, rel=2e-3)
    diagonal = quad(lambda t: np.sqrt(1 + (amplitude * wave * np.cos(wave * t)) ** 2 / 2), 0, 0.4)[0] / 0.4
    assert found.chain_rugosity == pytest.approx((along + 1 + 2 * diagonal) / 4, rel=2e-3)
    assert found.relief == pytest.approx(2 * amplitude, rel=1e-6)


def test_a_cone_has_the_area_of_its_mantle():
    x, y = lattice(201, 201)
    r = np.hypot(x - 1, y + 1)
    found = figures(0.5 * (0.8 - r), D, np.hypot(x - 1, y + 1)[:-1, :-1] < 0.7)
    assert found is not None
    assert found.rugosity == pytest.approx(np.sqrt(1 + 0.25), rel=1e-3)
    assert found.planar_area == pytest.approx(np.pi * 0.49, rel=1e-2)
    assert found.vector_ruggedness == pytest.approx(1 - 1 / np.sqrt(1.25), rel=1e-2)  # the level parts cancel


def fractional_surface(hurst: float, side: int, seed: int) -> np.ndarray:
    """A part of a periodic surface of fractional Brownian motion, by its spectrum."""
    rng, n = np.random.default_rng(seed), 4 * side
    k = np.hypot(*np.meshgrid(np.fft.fftfreq(n), np.fft.fftfreq(n)))
    k[0, 0] = np.inf
    noise = np.fft.fft2(rng.normal(size=(n, n)))
    return np.fft.ifft2(noise * k ** -(hurst + 1)).real[:side, :side]


@pytest.mark.parametrize("hurst", [0.3, 0.5, 0.7])
def test_a_fractional_brownian_surface_has_its_dimension(hurst: float):
    found = [fractal_dimension(fractional_surface(hurst, 160, seed)) for seed in range(4)]
    assert np.mean([one for one in found if one is not None]) == pytest.approx(3 - hurst, abs=0.08)


def rough(seed: int = 0) -> np.ndarray:
    return 0.3 * fractional_surface(0.8, 96, seed) / np.ptp(fractional_surface(0.8, 96, seed))


@pytest.mark.parametrize("turns", [1, 2, 3])
def test_a_quarter_turn_changes_nothing_but_the_aspect(turns: int):
    height = rough()
    one, turned = (asdict(known(z)) for z in (height, np.rot90(height, turns).copy()))
    aspects = one.pop("aspect_deg"), turned.pop("aspect_deg")
    assert turned == pytest.approx(one, rel=1e-6)
    assert (aspects[0] - 90 * turns) % 360 == pytest.approx(aspects[1], abs=1e-6)


def test_a_translation_changes_nothing_but_the_height():
    one, moved = (asdict(known(z)) for z in (rough(), rough() + 1000))
    assert moved.pop("mean_height") == pytest.approx(one.pop("mean_height") + 1000)
    assert moved == pytest.approx(one, rel=1e-6)


def test_lengths_follow_the_unit_and_ratios_do_not():
    one, larger = asdict(known(rough())), asdict(known(3 * rough(), 3 * D))
    powers = {"planar_area": 9, "surface_area": 9, "relief": 3, "mean_height": 3, "height_std": 3}
    assert larger == pytest.approx({name: value * powers.get(name, 1) for name, value in one.items()}, rel=1e-6)


def test_holes_take_no_part():
    x, y = lattice()
    height = 0.3 * x - 0.1 * y
    height[20:40, 30:50] = np.nan
    found = known(height)
    assert found.rugosity == pytest.approx(np.sqrt(1 + 0.3**2 + 0.1**2))
    assert found.coverage == pytest.approx(1 - 21 * 21 / (100 * 120))


def test_an_area_without_heights_has_no_figures():
    assert figures(np.full((20, 20), np.nan), D) is None
    assert figures(np.zeros((4, 4)), D) is None
