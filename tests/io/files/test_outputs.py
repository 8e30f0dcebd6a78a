"""Places that cannot be written to are told before any work, and nothing is left of a try."""

import os
import subprocess
import sys
import time
from pathlib import Path

import pytest

from swimm3r.errors import StorageError, Swimm3rError, UsageError
from swimm3r.io.files.folder_lock import folder_lock
from swimm3r.io.files.outputs import check_file, output_file, output_folder


def is_a_file(here: Path) -> Path:
    (here / "f").write_text("mine")
    return here / "f"


def below_a_file(here: Path) -> Path:
    return is_a_file(here) / "a" / "b"


def dangling_link(here: Path) -> Path:
    (here / "link").symlink_to(here / "nowhere")
    return here / "link"


def below_a_dangling_link(here: Path) -> Path:
    return dangling_link(here) / "run"


def looping_link(here: Path) -> Path:
    (here / "loop").symlink_to(here / "loop")
    return here / "loop"


def below_a_looping_link(here: Path) -> Path:
    return looping_link(here) / "run"


def too_long(here: Path) -> Path:
    return here / ("a" * 300)


def path_too_long(here: Path) -> Path:
    return here.joinpath(*["a" * 200] * 30)


def a_pipe(here: Path) -> Path:
    os.mkfifo(here / "pipe")
    return here / "pipe"


def in_proc(here: Path) -> Path:
    return Path("/proc/swimm3r")


@pytest.mark.parametrize(
    "place",
    [
        is_a_file, below_a_file, dangling_link, below_a_dangling_link, looping_link, below_a_looping_link, too_long,
        path_too_long, a_pipe, in_proc,
    ],
)  # fmt: skip
def test_a_place_that_can_be_no_folder_is_told(place, tmp_path: Path):
    path = place(tmp_path)
    before = sorted(tmp_path.rglob("*"))
    with pytest.raises((UsageError, StorageError)) as refusal, output_folder(path):
        pytest.fail("the work must not begin")
    assert refusal.value.exit_code in (2, 7)
    assert sorted(tmp_path.rglob("*")) == before


def test_a_link_to_a_folder_is_a_folder(tmp_path: Path):
    (tmp_path / "there").mkdir()
    (tmp_path / "link").symlink_to(tmp_path / "there")
    with output_folder(tmp_path / "link" / "run") as made:
        assert made.is_dir()


def test_folders_that_were_made_go_again_where_the_work_fails(tmp_path: Path):
    with pytest.raises(RuntimeError), output_folder(tmp_path / "a" / "b" / "c"):
        raise RuntimeError
    assert list(tmp_path.iterdir()) == []
    with output_folder(tmp_path / "a"):
        (tmp_path / "a" / "note").write_text("of somebody else")
    with pytest.raises(RuntimeError), output_folder(tmp_path / "a" / "b"):
        raise RuntimeError
    assert [path.name for path in tmp_path.rglob("*")] == ["a", "note"]


def test_a_folder_is_no_place_for_a_file(tmp_path: Path):
    for refused in (tmp_path, Path("/dev/null"), looping_link(tmp_path)):
        with pytest.raises(Swimm3rError):
            check_file(refused, "--ply")
    with pytest.raises(UsageError, match="it is a folder"), output_file(tmp_path, "--ply"):
        pytest.fail("the work must not begin")
    with output_file(tmp_path / "new" / "a.ply") as path:
        path.write_text("x")


HOLD = """
import sys, time
from pathlib import Path
from swimm3r.io.files.folder_lock import folder_lock
with folder_lock(Path(sys.argv[1])):
    print("held", flush=True)
    time.sleep(600)
"""


def test_two_processes_do_not_write_into_one_folder(tmp_path: Path):
    with subprocess.Popen([sys.executable, "-c", HOLD, str(tmp_path)], stdout=subprocess.PIPE, text=True) as other:
        assert other.stdout is not None
        assert other.stdout.readline() == "held\n"
        with pytest.raises(UsageError, match=f"process {other.pid}"), folder_lock(tmp_path):
            pytest.fail("the folder is held")
        other.kill()
    for _ in range(100):  # the system lets go of it when the process is gone
        try:
            with folder_lock(tmp_path):
                break
        except UsageError:
            time.sleep(0.1)
    else:
        pytest.fail("the lock of a dead process blocks")
