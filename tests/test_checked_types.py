"""The suite's checks of annotations: what they refuse, with shapes and without."""

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from typing import Any

import numpy as np
import pytest
from beartype import BeartypeConf, beartype
from jaxtyping import Float
from tests.checked_types import checked

from swimm3r.rounding import rounded
from swimm3r.sim3 import Sim3, fit_similarity

check = checked(typechecker=beartype(conf=BeartypeConf(is_pep484_tower=True)))
Points = Float[np.ndarray, "n 3"]


@check
@dataclass
class Track:
    points: Points
    times: Float[np.ndarray, " n"]
    name: str


@check
def moved(points: Points, by: float) -> Points:
    return points + by if by else points[1:]


@check
def named(length: int) -> str:
    return "n" * length if length else None  # type: ignore[return-value]


@check
def each(count: int) -> Iterator:
    yield from range(count)


@check
def are_points(some: object) -> bool:
    return isinstance(some, Points)  # pyright: ignore[reportArgumentType]


@check
def all_points(points: Points, others: tuple) -> bool:
    return all(are_points(one) for one in (points, *others))


@pytest.mark.parametrize(
    "call",
    [
        lambda: moved(np.zeros((4, 2)), 1.0),
        lambda: moved(np.zeros((4, 3)), "1"),  # type: ignore[arg-type]
        lambda: moved(np.zeros((4, 3)), 0.0),
        lambda: named("4"),  # type: ignore[arg-type]
        lambda: named(0),
        lambda: each("4"),  # type: ignore[arg-type]
        lambda: Track(np.zeros((4, 3)), np.zeros(5), "a"),
        lambda: Track(np.zeros((4, 3)), np.zeros(4), 7),  # type: ignore[arg-type]
        lambda: rounded(1.0, "2"),  # type: ignore[arg-type]
        lambda: fit_similarity(np.zeros((4, 3)), np.zeros((5, 3))),
        lambda: Sim3(1.0, np.eye(4), np.zeros(3)),
    ],
    ids=[
        "a parameter's shape", "a parameter's type beside a shape", "axes of what is returned", "a parameter's type",
        "the type of what is returned", "a generator's parameter", "axes of two fields", "a field's type",
        "a function of the package", "axes of two parameters in the package", "a field's shape in the package",
    ],
)  # fmt: skip
def test_what_an_annotation_forbids_is_refused(call: Callable[[], Any]):
    with pytest.raises(Exception, match=r"(?i)type-check|violates type hint"):
        call()


def test_a_question_for_a_shape_does_not_see_the_axes_of_the_caller():
    assert all_points(np.zeros((4, 3)), (np.zeros((5, 3)),))
    assert not all_points(np.zeros((4, 3)), (np.zeros((5, 2)),))


def test_what_an_annotation_allows_is_passed_on():
    points = np.arange(12.0).reshape(4, 3)
    np.testing.assert_array_equal(moved(points, 1), points + 1)  # an int stands for a float
    assert (named(2), list(each(3))) == ("nn", [0, 1, 2])
    assert Track(points, np.zeros(4), "a").points is points
