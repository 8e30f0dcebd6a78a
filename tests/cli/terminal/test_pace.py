"""Time left, rounds and compilation, as a user reads them in a log or sees them as bars."""

import re

import numba
import pytest

from swimm3r.cli.terminal.console import drawn_progress, lines
from swimm3r.cli.terminal.pace import Countdown, Pace, WorkClock


class Clock:
    """Seconds that pass when told to."""

    def __init__(self) -> None:
        self.now = 0.0

    def __call__(self) -> float:
        return self.now


def test_the_item_that_took_longest_does_not_count():
    clock = Clock()
    pace = Pace(clock)
    assert pace.reach(0, 100) is None
    clock.now += 860  # kernels compile within the first item
    assert pace.reach(1, 100) is None  # which alone tells nothing: 85,140 s would be said
    clock.now += 1
    assert pace.reach(2, 100) == pytest.approx(98)
    clock.now += 9
    assert pace.reach(12, 100) == pytest.approx((1 + 9) / 11 * 88)
    assert pace.reach(100, 100) is None


def test_a_step_that_begins_anew_is_its_next_round():
    clock = Clock()
    pace = Pace(clock)
    for round_ in (1, 2, 3):
        for done in (0, 1, 2, 3):
            clock.now += round_
            left = pace.reach(done, 4)
        assert pace.round == round_
        assert left == pytest.approx(round_)  # not of the rounds before
    assert pace.seconds == pytest.approx(9)


def test_the_clock_stands_still_while_kernels_are_compiled():
    clock = Clock()
    work = WorkClock(clock)
    clock.now = 5
    work.stop()
    clock.now = 90
    assert work() == 5
    work.go_on()
    clock.now = 92
    assert work() == 7


def test_rounds_are_named_and_each_is_monotone(capsys: pytest.CaptureFixture[str]):
    say = lines(Clock())
    for placed in (0, 1, 3, 3, 0, 2, 3, 3):
        say("placing the frames left over", placed, 3)
    told = capsys.readouterr().err.splitlines()
    assert [line.split(" (")[0] for line in told] == [
        "placing the frames left over 0/3",
        "placing the frames left over 3/3",
        "placing the frames left over, round 2 0/3",
        "placing the frames left over, round 2 3/3",
    ]


def test_compilation_is_said_once_and_takes_no_part_in_the_estimate(capsys: pytest.CaptureFixture[str]):
    @numba.njit
    def callee(x: float) -> float:
        return x + 1

    @numba.njit
    def kernel(x: float) -> float:
        return callee(x) * 2

    with drawn_progress() as progress:
        progress("training the map", 0, 2)
        assert kernel(1.0) == 4
        progress("training the map", 2, 2)
    told = capsys.readouterr().err
    assert told.count("compiling kernels (first run only)") == 1
    (seconds,) = re.findall(r"training the map 2/2 \((\d+) s\)", told)
    assert int(seconds) <= 1
    with drawn_progress():
        kernel(2.0)
    assert "compiling" not in capsys.readouterr().err


def test_the_estimate_of_a_run_runs_down_and_is_renewed():
    clock = Clock()
    countdown = Countdown(clock)
    assert countdown.left() is None
    countdown.set(100)
    clock.now = 30
    assert countdown.left() == 70
    countdown.set(20)
    clock.now = 60
    assert countdown.left() == 0
    countdown.set(None)
    assert countdown.left() is None
