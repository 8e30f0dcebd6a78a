"""Parts in axes of their own come together where shared points say, also around a loop and despite a false link."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from swimm3r.sfm.colmap.chunks.join import join_parts
from swimm3r.sfm.colmap.chunks.links import Link
from swimm3r.sim3 import Sim3, fit_similarity

FOCAL, DEPTH = 600.0, 2.0


def similarity(rng: np.random.Generator) -> Sim3:
    return Sim3(float(rng.uniform(0.2, 5)), Rotation.from_rotvec(rng.normal(size=3)).as_matrix(), rng.normal(size=3))


def make_link(a: int, b: int, from_part: list[Sim3], rng: np.random.Generator, noise: float = 0.0) -> Link:
    """Points that both parts see, in world coordinates two units before the cameras of part b."""
    world = rng.normal(size=(60, 3))
    in_a = from_part[a].inverse()(world + noise * rng.normal(size=world.shape))
    in_b = from_part[b].inverse()(world)
    b_from_a = fit_similarity(in_a, in_b)
    assert b_from_a is not None
    return Link(a, b, b_from_a, in_a, in_b, np.full(60, DEPTH / from_part[b].scale), 60)


def worst_miss(from_part: dict[int, Sim3], truth: list[Sim3]) -> float:
    """Largest distance between points moved by the result and by the truth, in the axes of part 0."""
    points = np.random.default_rng(9).normal(size=(20, 3))
    into_first = truth[0].inverse()
    return max(
        float(np.abs(found(points) - into_first(truth[part](points))).max() / into_first.scale)
        for part, found in from_part.items()
    )


@pytest.fixture
def truth() -> list[Sim3]:
    rng = np.random.default_rng(3)
    return [similarity(rng) for _ in range(6)]


def test_parts_of_a_chain_come_together_exactly(truth: list[Sim3]) -> None:
    rng = np.random.default_rng(1)
    links = [make_link(k, k + 1, truth, rng) for k in range(5)]
    (joined,) = join_parts(6, links, FOCAL)
    assert worst_miss(joined.from_part, truth) < 1e-6


def test_a_closed_loop_spreads_the_error_that_a_chain_adds_up(truth: list[Sim3]) -> None:
    rng = np.random.default_rng(2)
    chain = [make_link(k, k + 1, truth, rng, noise=0.02) for k in range(5)]
    (alone,) = join_parts(6, chain, FOCAL)
    (closed,) = join_parts(6, [*chain, make_link(0, 5, truth, rng)], FOCAL)
    assert worst_miss(closed.from_part, truth) < 0.7 * worst_miss(alone.from_part, truth)


def test_a_link_between_places_that_only_look_alike_is_left_out(truth: list[Sim3]) -> None:
    rng = np.random.default_rng(4)
    chain = [make_link(k, k + 1, truth, rng) for k in range(5)] + [make_link(0, 5, truth, rng)]
    elsewhere = [*truth[:5], replace(truth[5], t=truth[5].t + 3)]
    false = replace(make_link(2, 5, elsewhere, rng), support=30)
    (joined,) = join_parts(6, [*chain, false], FOCAL)
    assert worst_miss(joined.from_part, truth) < 1e-3
    assert len(joined.residuals) == len(chain)


def test_parts_without_a_link_stay_groups_of_their_own(truth: list[Sim3]) -> None:
    rng = np.random.default_rng(5)
    groups = join_parts(6, [make_link(0, 1, truth, rng), make_link(3, 4, truth, rng)], FOCAL)
    assert sorted(sorted(group.from_part) for group in groups) == [[0, 1], [2], [3, 4], [5]]
