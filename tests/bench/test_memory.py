"""The peak of memory belongs to the work it is measured over."""

import os

import numpy as np
import pytest

from swimm3r.bench.memory import in_own_process, with_peak_mb
from swimm3r.errors import DeviceError
from swimm3r.evaluate import NotComputed


def test_the_peak_is_of_the_work_alone():
    def work(megabytes: int) -> int:
        return len(np.ones(megabytes << 17))  # float64: 8 bytes each

    (first, much), (_, little) = with_peak_mb(lambda: work(400)), with_peak_mb(lambda: work(1))
    assert first == 400 << 17
    if isinstance(much["peak_mb"], NotComputed):  # a system that keeps no such count
        assert isinstance(little["peak_mb"], NotComputed)
        return
    assert isinstance(little["peak_mb"], float)
    assert much["peak_mb"] - little["peak_mb"] > 300


def test_work_that_is_to_be_alone_runs_in_another_process():
    assert in_own_process(os.getpid) != os.getpid()


def test_a_process_that_was_ended_from_outside_says_so():
    with pytest.raises(DeviceError, match="ended from outside"):
        in_own_process(os._exit, 9)
