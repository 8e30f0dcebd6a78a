"""`swimm3r weights`: what it prints for scripts, what it refuses, and how soon."""

import hashlib
from pathlib import Path

import pytest

from swimm3r import weights as store
from swimm3r.cli.main import main

BODY = b"not a network, but long enough to have a checksum"


@pytest.fixture(autouse=True)
def home(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """An empty folder for downloads, without network."""
    monkeypatch.setenv("SWIMM3R_WEIGHTS_DIR", str(tmp_path / "weights"))
    monkeypatch.setenv("SWIMM3R_CACHE", str(tmp_path / "cache"))
    monkeypatch.setenv("HF_HUB_OFFLINE", "1")
    return tmp_path / "weights"


@pytest.fixture
def small(home: Path) -> Path:
    """A file in the place of weights whose size and checksum nobody publishes."""
    path = home / store.entry("mast3r-retrieval").filename
    home.mkdir()
    path.write_bytes(BODY)
    return path


def test_a_folder_that_cannot_be_read_is_said_to_be_one(
    home: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
):
    def is_file(path: Path) -> bool:  # tests may run as root, whom no folder refuses
        raise PermissionError(13, "Permission denied", str(path))

    monkeypatch.setattr(Path, "is_file", is_file)
    code, out, _ = outcome(capsys, "list")
    assert code == 0
    assert f"{home} cannot be looked into (Permission denied)" in out
    code, _, err = outcome(capsys, "path", "mast3r")
    assert code == 4
    assert "chmod" in err


def outcome(capsys: pytest.CaptureFixture[str], *arguments: str) -> tuple[int, str, str]:
    code = 0
    try:
        main(["weights", *arguments])
    except SystemExit as stop:
        code = int(stop.code or 0)
    shown = capsys.readouterr()
    return code, shown.out, shown.err


def test_list_tells_what_is_here_and_what_is_not(capsys: pytest.CaptureFixture[str], home: Path):
    home.mkdir()
    (home / store.entry("uranker").filename).write_bytes(b"x")
    (home / store.entry("lpips-vgg").filename).write_bytes(b"too short")
    code, shown, _ = outcome(capsys, "list")
    rows = {line.split()[0]: line for line in shown.splitlines() if line[:1].islower()}
    assert code == 0
    assert rows.keys() == {w.name for w in store.MANIFEST}
    assert "not here" in rows["mast3r"]
    assert str(home / store.entry("uranker").filename) in rows["uranker"]
    assert "has 9 bytes, expected 7,289" in rows["lpips-vgg"]
    assert "CC BY-NC-SA 4.0" in shown
    assert str(home) in shown


def test_path_is_alone_on_its_line_for_scripts(capsys: pytest.CaptureFixture[str], home: Path, small: Path):
    assert outcome(capsys, "path") == (0, f"{home}\n", "")
    assert outcome(capsys, "path", "mast3r-retrieval") == (0, f"{small}\n", "")
    assert outcome(capsys, "get", "mast3r-retrieval") == (0, f"{small}\n", "")  # here already: no network, no license


def test_verify_trusts_the_first_use_and_finds_a_later_change(capsys: pytest.CaptureFixture[str], small: Path):
    digest = hashlib.sha256(BODY).hexdigest()
    for said in ("has no published checksum", "is unchanged since its first use"):
        code, shown, _ = outcome(capsys, "verify", "mast3r-retrieval")
        assert code == 0
        assert said in shown
        assert f"{len(BODY)} bytes, sha256 {digest}" in shown
    small.write_bytes(BODY[::-1])
    code, _, message = outcome(capsys, "verify", "mast3r-retrieval")
    assert code == 4
    assert digest in message


def test_verify_takes_a_file_that_lies_elsewhere(capsys: pytest.CaptureFixture[str], small: Path, tmp_path: Path):
    other = small.rename(tmp_path / small.name)
    assert str(other) in outcome(capsys, "verify", "mast3r-retrieval", "--file", str(other))[1]


def test_the_license_is_accepted_by_nobody_else(capsys: pytest.CaptureFixture[str]):
    code, _, message = outcome(capsys, "get", "mast3r")
    assert code == 4
    assert "CC BY-NC-SA 4.0" in message
    assert "swimm3r weights get mast3r --accept-license" in message


def test_offline_get_tells_everything_needed_by_hand(capsys: pytest.CaptureFixture[str], home: Path):
    code, _, message = outcome(capsys, "get", "mast3r", "--accept-license")
    assert code == 4
    entry = store.entry("mast3r")
    for part in (entry.filename, "2755 MB", entry.urls[0], str(home)):
        assert part in message


def test_a_missing_file_is_exit_4_and_a_mistyped_name_exit_2(capsys: pytest.CaptureFixture[str]):
    assert outcome(capsys, "path", "mast3r")[0] == 4
    code, _, message = outcome(capsys, "path", "mastr")
    assert code == 2
    assert "mast3r" in message
