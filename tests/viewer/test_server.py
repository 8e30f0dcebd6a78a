"""The address, the errors that a user can cause, and the end by Ctrl-C or SIGTERM."""

import re
import signal
import socket
import subprocess
import sys
import urllib.request
from collections.abc import Iterator
from pathlib import Path

import pytest

from swimm3r.cli.main import main
from swimm3r.errors import UsageError
from swimm3r.viewer.server import address_lines, free_port
from swimm3r.viewer.settings import ViewerSettings

HERE = "127.0.0.1"


@pytest.fixture
def taken() -> Iterator[int]:
    """A port that another program serves."""
    with socket.socket() as other:
        other.bind((HERE, 0))
        other.listen()
        yield other.getsockname()[1]


def test_a_port_that_is_taken_is_left_to_the_other_program(taken: int):
    found = free_port(HERE, taken)
    assert found > taken
    lines = address_lines(ViewerSettings(port=taken), found)
    assert lines[0] == f"Port {taken} is taken; using {found}."
    assert lines[1] == f"Viewer: http://localhost:{found}"


def test_the_ssh_line_forwards_the_port():
    lines = address_lines(ViewerSettings(), 8080)
    assert f"ssh -L 8080:localhost:8080 user@{socket.gethostname()}" in lines[-1]


def test_an_open_server_says_that_it_is_open():
    lines = address_lines(ViewerSettings(host="0.0.0.0"), 8080)
    assert lines[0] == "Viewer: http://localhost:8080"
    assert "everyone who can reach it" in lines[-1]


@pytest.mark.parametrize("host", ["203.0.113.7", "no.such.host.invalid"])
def test_the_address_of_another_computer_is_refused(host: str):
    with pytest.raises(UsageError, match="cannot serve"):
        free_port(host, 8080)


def code_of(*arguments: str) -> int:
    with pytest.raises(SystemExit) as stop:
        main(arguments)
    assert isinstance(stop.value.code, int)
    return stop.value.code


def test_without_viser_the_extra_is_named(
    wall_run: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
):
    monkeypatch.setitem(sys.modules, "viser", None)
    assert code_of("view", str(wall_run)) == 2
    assert "pip install 'swimm3r[view]'" in capsys.readouterr().err


def test_a_folder_that_is_no_run_is_named(tmp_path: Path, capsys: pytest.CaptureFixture[str]):
    assert code_of("view", str(tmp_path)) == 3
    assert "is no run folder" in capsys.readouterr().err


def test_a_run_without_structure_from_motion_is_refused(sfm_run: Path, capsys: pytest.CaptureFixture[str]):
    (sfm_run / "sfm" / "reconstruction.json").unlink()
    assert code_of("view", str(sfm_run)) == 3
    assert "swimm3r run" in capsys.readouterr().err


def test_another_run_without_water_is_refused_for_its_water(
    wall_run: Path, sfm_run: Path, capsys: pytest.CaptureFixture[str]
):
    (sfm_run / "sfm" / "medium.json").write_text("{}")
    assert code_of("view", str(wall_run), "--water", str(sfm_run)) == 3
    assert "knows no water" in capsys.readouterr().err


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_a_signal_ends_it_cleanly(wall_run: Path, number: signal.Signals):
    port = free_port(HERE, 18_080)
    command = [sys.executable, "-m", "swimm3r", "view", str(wall_run), "--port", str(port), "--map-device", "cpu"]
    with subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True) as server:
        assert server.stdout is not None
        lines = [server.stdout.readline() for _ in range(3)]
        assert lines[-1] == "Ctrl-C ends it.\n", lines
        found = re.search(r"http://localhost:(\d+)", "".join(lines))
        assert found is not None
        with urllib.request.urlopen(f"http://{HERE}:{found[1]}/", timeout=20) as page:
            assert b"<html" in page.read().lower()
        server.send_signal(number)
        out, err = server.communicate(timeout=60)
    assert server.returncode == 0
    assert out == ""
    assert err.splitlines()[-1].startswith("preparing the view 3/3")  # nothing was said about the end
