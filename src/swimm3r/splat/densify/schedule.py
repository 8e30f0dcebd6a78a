"""Rounds of densification: the steps that have one, and how many primitives it leaves, alike for every recipe.

step s of n has a round where s is a multiple of the cadence and begin < s / n <= end
"""

import math

from swimm3r.splat.shared_settings import RefineSettings


def steps_between(settings: RefineSettings, iterations: int) -> int:
    """Steps from one round to the next."""
    return max(settings.min_refine_every, round(settings.refine_every * iterations))


def is_due(settings: RefineSettings, step: int, iterations: int) -> bool:
    """Return whether a step, counted from 1, is one of the cadence's."""
    return step % steps_between(settings, iterations) == 0


def has_begun(settings: RefineSettings, step: int, iterations: int) -> bool:
    """Return whether a step lies behind the start of the window."""
    return step / iterations > settings.refine_start


def is_open(settings: RefineSettings, step: int, iterations: int) -> bool:
    """Return whether a step lies in the window."""
    return has_begun(settings, step, iterations) and step / iterations <= settings.refine_stop


def has_round(settings: RefineSettings, step: int, iterations: int) -> bool:
    """Return whether a step, counted from 1, densifies."""
    return is_open(settings, step, iterations) and is_due(settings, step, iterations)


def grown(count: int, most: int, growth: float, settings: RefineSettings, iterations: int) -> int:
    """Primitives after a round: `growth` times as many per round at `refine_every`, at most `most`, never fewer.

    Where `min_refine_every` leaves out rounds the next one makes up for them.
    """
    rounds = steps_between(settings, iterations) / (settings.refine_every * iterations)
    if most <= count or rounds * math.log(growth) > 1 + math.log(most / count):  # the power might overflow
        return max(count, most)
    return max(count, min(most, int(growth**rounds * count)))
