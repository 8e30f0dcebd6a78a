"""Memory in one unit, and failures for want of it in the user's words."""

import sys
from pathlib import Path

import numpy as np
import pytest
import torch

from swimm3r.memory import MB, available_mb, out_of_memory, peak_mb, return_freed

TOO_MANY = 1 << 60  # bytes


def test_the_peak_counts_what_was_taken():
    before = peak_mb()
    if before is None:
        pytest.skip("this system does not say")
    taken = np.ones(int(before + 100) * MB, np.uint8)  # beyond any peak before
    assert peak_mb() >= taken.nbytes / MB


@pytest.mark.skipif(sys.platform != "linux", reason="only glibc keeps freed memory that it can be asked for")
def test_freed_blocks_between_kept_ones_go_back_to_the_system():
    def resident_mb() -> float:
        pages = int(Path("/proc/self/statm").read_text().split()[1])
        return pages * 4096 / MB

    blocks = [b"x" * 60_000 for _ in range(5_000)]
    kept = [blocks[::50], b"x" * 1_000]  # scattered over the heap
    before = resident_mb()
    del blocks
    return_freed()
    assert before - resident_mb() > 0.8 * 5_000 * 60_000 / MB
    assert len(kept) == 2


@pytest.mark.skipif(sys.platform != "linux", reason="other systems are not asked")
def test_less_is_available_under_a_limit(monkeypatch: pytest.MonkeyPatch):
    import resource

    free = available_mb()
    assert free > 0
    monkeypatch.setattr(resource, "getrlimit", lambda _: (0, 0))
    assert available_mb() == 0


@pytest.mark.skipif(sys.platform != "linux", reason="containers are limited by Linux's cgroups")
def test_a_containers_limit_counts(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    (tmp_path / "memory.max").write_text("3000000\n")
    (tmp_path / "memory.current").write_text("2500000\n")
    (tmp_path / "memory.stat").write_text("anon 1\ninactive_file 300000\n")
    monkeypatch.setattr("swimm3r.memory._CGROUP", tmp_path)
    assert available_mb() == 0.8


def from_numpy() -> None:
    np.ones(TOO_MANY, np.uint8)


def from_torch() -> None:
    torch.ones(TOO_MANY, dtype=torch.uint8)


def from_the_interpreter() -> None:
    bytearray(TOO_MANY)


def from_threads() -> None:
    raise RuntimeError("can't start new thread")  # CPython's own words


def from_pycolmap() -> None:
    raise RuntimeError("std::bad_alloc")


def from_a_fork() -> None:
    raise OSError(12, "Cannot allocate memory")


def from_the_linker() -> None:
    raise ImportError("/lib/_ckdtree.so: failed to map segment from shared object")


@pytest.mark.parametrize(
    "fail", [from_the_linker, from_numpy, from_torch, from_the_interpreter, from_threads, from_pycolmap, from_a_fork]
)
def test_running_out_of_memory_is_said_with_its_exit_code(fail):
    with pytest.raises((MemoryError, RuntimeError, OSError, ImportError)) as failure:
        fail()
    told = out_of_memory(failure.value)
    assert told is not None
    assert told.exit_code == 5
    assert "memory" in told.what


@pytest.mark.parametrize("error", [RuntimeError("shapes differ"), OSError(28, "No space left"), ValueError("x")])
def test_other_failures_are_not_taken_for_it(error: Exception):
    assert out_of_memory(error) is None
