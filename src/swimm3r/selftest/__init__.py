"""The kernels of this machine against slow references, and their speed: to be run first on a new computer."""

from collections.abc import Iterator
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    import swimm3r.selftest.checks
    import swimm3r.selftest.speed

__all__ = ["check_kernels", "measure_speed"]


def check_kernels() -> "Iterator[swimm3r.selftest.checks.Check]":
    """Compare every kernel that can run here with its reference, one after the other."""
    from swimm3r.selftest import checks

    return checks.check_kernels()


def measure_speed() -> "Iterator[swimm3r.selftest.speed.Speed]":
    """Time the rasterizer of every device here."""
    from swimm3r.selftest import speed

    return speed.measure_speed()
