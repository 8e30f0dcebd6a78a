"""Rounds of densification: the steps that have one, and how many primitives it leaves, alike for every recipe.

step s of n has a round where s is a multiple of the cadence and begin < s / n <= end
"""

import math
from typing import Protocol, runtime_checkable


@runtime_checkable  # so that the suite can check calls against it
class Cadence(Protocol):
    """What the densification settings of all recipes share."""

    @property
    def every(self) -> float:
        """Share of the run between two rounds."""
        ...

    @property
    def min_every(self) -> int:
        """Fewest steps between two rounds."""
        ...


@runtime_checkable
class Window(Cadence, Protocol):
    """A cadence that holds for a part of the run."""

    @property
    def begin(self) -> float:
        """Share of the run before the first round."""
        ...

    @property
    def end(self) -> float:
        """Share of the run after the last one."""
        ...


def steps_between(settings: Cadence, iterations: int) -> int:
    """Steps from one round to the next."""
    return max(settings.min_every, round(settings.every * iterations))


def has_round(settings: Window, step: int, iterations: int) -> bool:
    """Whether a step, counted from 1, densifies."""
    in_window = settings.begin < step / iterations <= settings.end
    return in_window and step % steps_between(settings, iterations) == 0


def grown(count: int, most: int, growth: float, settings: Cadence, iterations: int) -> int:
    """Primitives after a round: `growth` times as many per round at `every`, at most `most`, never fewer.

    Where `min_every` leaves out rounds the next one makes up for them.
    """
    rounds = steps_between(settings, iterations) / (settings.every * iterations)
    if most <= count or rounds * math.log(growth) > 1 + math.log(most / count):  # the power might overflow
        return max(count, most)
    return max(count, min(most, int(growth**rounds * count)))
