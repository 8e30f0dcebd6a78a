"""A stage of a run as its watchers are told of it; torch-free."""

from dataclasses import dataclass


@dataclass(frozen=True)
class StageStart:
    """A stage that starts, and a rough estimate of the time until the last one is done."""

    number: int  # from 1
    count: int
    title: str
    seconds_left: float | None  # of this stage and those after it; None where it is not estimated


def ignore_stages(start: StageStart, /) -> None:
    """The default: nobody is watching."""
