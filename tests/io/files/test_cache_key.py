"""A key is another one wherever what decided a result is, and the same where it is not."""

import os
import shutil
from dataclasses import dataclass, replace
from pathlib import Path

import pytest

from swimm3r.io.files.cache_key import cache_key, code_version, content_digest, sample_digest, statements


@dataclass(frozen=True)
class Sweep:
    planes: int = 3
    start: Path = Path("a")


@dataclass(frozen=True)
class Other:
    planes: int = 3
    start: Path = Path("a")


def test_equal_parts_have_one_key_and_others_another():
    keys = [
        cache_key(Sweep()),
        cache_key(Sweep(planes=4)),
        cache_key(Sweep(start=Path("b"))),
        cache_key(Other()),
        cache_key(Sweep(), None),
        cache_key([Sweep()]),
        cache_key("Sweep"),
    ]
    assert len(set(keys)) == len(keys)
    assert cache_key(replace(Sweep(4), planes=3)) == keys[0]
    assert cache_key({"a": 1, "b": 2}) == cache_key({"b": 2, "a": 1})
    with pytest.raises(TypeError):
        cache_key(object())


def test_a_digest_follows_the_bytes_and_not_the_name_or_the_time(tmp_path: Path):
    one, two = tmp_path / "one", tmp_path / "two"
    one.write_bytes(b"weights")
    two.write_bytes(b"weights")
    assert content_digest(one) == content_digest(two)
    before = content_digest(one)
    os.utime(one, ns=(1, 1))
    assert content_digest(one) == before
    one.write_bytes(b"others!")
    assert content_digest(one) != before
    assert content_digest(tmp_path / "nothing") is None
    assert content_digest(None) is None


def test_a_folders_digest_is_of_names_and_bytes(tmp_path: Path):
    (tmp_path / "model").mkdir()
    (tmp_path / "model" / "points").write_bytes(b"p")
    before = content_digest(tmp_path / "model")
    (tmp_path / "model" / "points").rename(tmp_path / "model" / "cameras")
    assert content_digest(tmp_path / "model") not in (before, None)


def test_a_dive_is_known_again_on_another_disk_and_another_one_is_not(tmp_path: Path):
    dive = tmp_path / "dive"
    (dive / "masks").mkdir(parents=True)
    video = dive / "clip.mp4"
    video.write_bytes(bytes(100_000))
    (dive / "masks" / "0.png").write_bytes(b"mask")
    before = sample_digest(dive)
    copy = tmp_path / "elsewhere" / "renamed"
    shutil.copytree(dive, copy, copy_function=shutil.copyfile)
    assert sample_digest(copy) == before
    assert sample_digest(copy / "clip.mp4") == sample_digest(video) != before
    for change in (b"\1" + bytes(99_999), bytes(99_999) + b"\1", bytes(100_001)):
        (copy / "clip.mp4").write_bytes(change)
        assert sample_digest(copy) != before
    (dive / "masks" / "0.png").rename(dive / "masks" / "1.png")
    assert sample_digest(dive) != before
    (dive / "masks" / "1.png").rename(dive / "masks" / "0.png")
    (dive / "runs").mkdir()
    (dive / "runs" / "report.html").write_bytes(b"<html>")
    assert sample_digest(dive, leave_out=dive / "runs") == before


def test_a_file_that_may_not_be_read_counts_by_name_and_size(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    (tmp_path / "locked").write_bytes(b"of root")
    before = sample_digest(tmp_path)

    def refuse(*_: object) -> None:
        raise PermissionError

    monkeypatch.setattr(Path, "open", refuse)
    unread = sample_digest(tmp_path)
    assert unread != before
    (tmp_path / "locked").rename(tmp_path / "other")
    assert sample_digest(tmp_path) != unread


def test_code_is_its_statements():
    code = '''"""Says."""
def f(x):
    """Doubles."""
    return 2 * x  # why
'''
    assert statements(code) == statements("def f(x):\n\n    return 2*x")
    assert statements(code) != statements(code.replace("2 * x", "3 * x"))
    assert statements(code) != statements(code.replace("return 2", 'return "2"'))
    assert code_version() == code_version()
