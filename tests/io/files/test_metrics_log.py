"""metrics.jsonl after a training was killed: whole rows stay, what was cut off goes."""

import json
from pathlib import Path

import pytest

from swimm3r.io.files.metrics_log import append_row, drop_rows_after, read_rows

ROWS = [{"step": 5, "loss": 0.5}, {"step": 10, "validation": {"loss": 0.25, "by": {"water": 0.125}}}]


@pytest.fixture
def log(tmp_path: Path) -> Path:
    path = tmp_path / "metrics.jsonl"
    for row in ROWS:
        append_row(path, row)
    return path


def test_rows_come_back_as_they_were_written(log: Path):
    assert read_rows(log) == ROWS
    assert read_rows(log.with_name("absent.jsonl")) == []


def test_a_row_cut_anywhere_is_dropped(log: Path):
    """Behind an inner brace, too, where the cut row ends like a whole one."""
    whole, row = log.read_bytes(), json.dumps({"step": 15, "validation": {"by": {"water": 1.0}, "loss": 2.0}}).encode()
    for end in range(1, len(row)):
        log.write_bytes(whole + row[:end])
        assert read_rows(log) == ROWS, row[:end]
        drop_rows_after(log, 10)
        assert log.read_bytes() == whole


@pytest.mark.parametrize(
    "garbage", [b"\x00\xff\xfe", b"[1, 2]", b"null", b'{"loss": 1.0}', b'{"step": "six"}', b"[" * 100_000]
)
def test_what_is_no_row_is_dropped(log: Path, garbage: bytes):
    log.write_bytes(log.read_bytes() + garbage + b"\n")
    assert read_rows(log) == ROWS


def test_rows_of_steps_that_are_done_again_are_dropped(log: Path):
    drop_rows_after(log, 9)
    assert read_rows(log) == ROWS[:1]
    append_row(log, ROWS[1])
    assert read_rows(log) == ROWS
