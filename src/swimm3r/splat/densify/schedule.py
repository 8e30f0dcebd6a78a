"""Rounds of densification: the steps that have one, and how many primitives it leaves, alike for every recipe.

step s of n has a round where s is a multiple of the cadence and begin < s / n <= end
"""

import math
from typing import Protocol, runtime_checkable


@runtime_checkable  # so that the suite can check calls against it
class RefineCadence(Protocol):
    """The settings that all recipes' densification shares."""

    @property
    def refine_every(self) -> float:
        """Share of the run between two rounds."""
        ...

    @property
    def min_refine_every(self) -> int:
        """Fewest steps between two rounds."""
        ...


@runtime_checkable
class RefineWindow(RefineCadence, Protocol):
    """A cadence that holds for a part of the run."""

    @property
    def refine_start(self) -> float:
        """Share of the run before the first round."""
        ...

    @property
    def refine_stop(self) -> float:
        """Share of the run after the last one."""
        ...


def steps_between(settings: RefineCadence, iterations: int) -> int:
    """Steps from one round to the next."""
    return max(settings.min_refine_every, round(settings.refine_every * iterations))


def is_due(settings: RefineCadence, step: int, iterations: int) -> bool:
    """Whether a step, counted from 1, is one of the cadence's."""
    return step % steps_between(settings, iterations) == 0


def has_begun(settings: RefineWindow, step: int, iterations: int) -> bool:
    """Whether a step lies behind the start of the window."""
    return step / iterations > settings.refine_start


def is_open(settings: RefineWindow, step: int, iterations: int) -> bool:
    """Whether a step lies in the window."""
    return has_begun(settings, step, iterations) and step / iterations <= settings.refine_stop


def has_round(settings: RefineWindow, step: int, iterations: int) -> bool:
    """Whether a step, counted from 1, densifies."""
    return is_open(settings, step, iterations) and is_due(settings, step, iterations)


def grown(count: int, most: int, growth: float, settings: RefineCadence, iterations: int) -> int:
    """Primitives after a round: `growth` times as many per round at `refine_every`, at most `most`, never fewer.

    Where `min_refine_every` leaves out rounds the next one makes up for them.
    """
    rounds = steps_between(settings, iterations) / (settings.refine_every * iterations)
    if most <= count or rounds * math.log(growth) > 1 + math.log(most / count):  # the power might overflow
        return max(count, most)
    return max(count, min(most, int(growth**rounds * count)))
