"""Work on frames by several threads: the order of results, how many wait, and errors."""

import threading
import time

import pytest

from swimm3r.sfm.medium.side_by_side import in_order


def test_results_come_in_the_order_of_the_items():
    def work(item: int) -> int:
        time.sleep(0.002 * (item % 5))
        return item * item

    assert list(in_order(work, range(40), threads=4)) == [i * i for i in range(40)]


def test_no_more_than_two_results_per_thread_wait_to_be_taken():
    lock, made = threading.Lock(), [0]

    def work(item: int) -> int:
        with lock:
            made[0] += 1
        return item

    for taken, _ in enumerate(in_order(work, range(60), threads=2)):
        time.sleep(0.001)
        assert made[0] <= taken + 1 + 2 * 2


def test_the_error_of_one_frame_ends_the_work():
    def work(item: int) -> int:
        if item == 7:
            raise ValueError("frame 7")
        return item

    seen: list[int] = []
    with pytest.raises(ValueError, match="frame 7"):
        seen.extend(in_order(work, range(1000), threads=2))
    assert seen == list(range(7))
