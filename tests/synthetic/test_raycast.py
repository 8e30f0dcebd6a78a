import numpy as np
import pytest

from swimm3r.synthetic.raycast import MISS, bilinear, cast, heightfield

CELL = 0.05


def bumpy(n: int = 64, seed: int = 0):
    rng = np.random.default_rng(seed)
    coarse = rng.uniform(-0.4, 0.4, (n + 1, n + 1))
    return heightfield(coarse, 0.0, 0.0, CELL)


def shoot(surface, origin, direction) -> float:
    return cast(
        surface.height, surface.pyramid, surface.cell, np.asarray(origin, float), np.asarray(direction, float), 0.0
    )


def rays(count: int, seed: int):
    rng = np.random.default_rng(seed)
    for _ in range(count):
        origin = np.array([rng.uniform(0, 3.2), rng.uniform(0, 3.2), rng.uniform(0.5, 1.5)])
        yield origin, rng.normal(size=3) * [1, 1, 0.6] - [0, 0, 1.0]


def test_a_hit_lies_on_the_surface():
    surface, hits = bumpy(), 0
    for origin, direction in rays(400, 1):
        t = shoot(surface, origin, direction)
        if t == MISS:
            continue
        hits += 1
        p = origin + t * direction
        assert p[2] == pytest.approx(bilinear(surface.height, p[0] / CELL, p[1] / CELL), abs=1e-9)
    assert hits > 200


def test_nothing_of_the_surface_rises_above_the_ray_before_the_hit():
    surface = bumpy(seed=4)
    for origin, direction in rays(60, 2):
        t = shoot(surface, origin, direction)
        reach = t if t != MISS else 20 / np.linalg.norm(direction)
        for s in np.linspace(0, reach * 0.9999, 4000):
            x, y, z = origin + s * direction
            if 0 <= x <= 64 * CELL and 0 <= y <= 64 * CELL:
                assert z > bilinear(surface.height, x / CELL, y / CELL) - 1e-9


def test_a_plane_is_hit_where_algebra_says():
    flat = heightfield(np.zeros((33, 33)), 0.0, 0.0, CELL)
    assert shoot(flat, [0.4, 0.5, 1.0], [0.3, 0.2, -1.0]) == pytest.approx(1.0, abs=1e-12)
    assert shoot(flat, [0.8, 0.8, 1.0], [0.0, 0.0, -2.0]) == pytest.approx(0.5, abs=1e-12)  # along no axis of the grid


def test_rays_that_look_up_or_leave_the_grid_meet_nothing():
    flat = heightfield(np.zeros((33, 33)), 0.0, 0.0, CELL)
    assert shoot(flat, [0.8, 0.8, 1.0], [0.1, 0.2, 0.5]) == MISS
    assert shoot(flat, [0.8, 0.8, 1.0], [1.0, 0.0, -0.2]) == MISS
    assert shoot(flat, [0.8, 0.8, 1.0], [1.0, 0.0, 0.0]) == MISS
