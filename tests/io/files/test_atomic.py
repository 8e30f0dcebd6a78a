"""Whole or absent, even where the power fails: drafts, syncs and renames."""

import os
from pathlib import Path

import pytest

from swimm3r.errors import StorageError
from swimm3r.io.files.atomic import DRAFT, atomic_folder, atomic_path, drafts_in, write_text


@pytest.fixture
def calls(monkeypatch: pytest.MonkeyPatch) -> list[str]:
    """The syncs and renames in their order, by what they were done to."""
    told: list[str] = []
    fsync, replace, rename = os.fsync, os.replace, Path.replace

    def telling_fsync(handle: int) -> None:
        told.append("sync " + ("folder" if os.path.isdir(f"/proc/self/fd/{handle}") else "file"))
        fsync(handle)

    def telling_replace(a: Path, b: Path) -> None:
        told.append("rename")
        replace(a, b)

    def telling_rename(self: Path, target: Path) -> Path:
        told.append("rename")
        return rename(self, target)

    monkeypatch.setattr(os, "fsync", telling_fsync)
    monkeypatch.setattr(os, "replace", telling_replace)
    monkeypatch.setattr(Path, "replace", telling_rename)
    return told


def test_a_file_is_on_the_disk_before_it_has_its_name(tmp_path: Path, calls: list[str]):
    write_text(tmp_path / "a.txt", "whole")
    assert [call for i, call in enumerate(calls) if call != calls[i - 1] or i == 0] == [
        "sync file",
        "rename",
        "sync folder",
    ]
    assert (tmp_path / "a.txt").read_text() == "whole"


def test_a_folder_is_on_the_disk_before_it_has_its_name(tmp_path: Path, calls: list[str]):
    with atomic_folder(tmp_path / "model") as draft:
        (draft / "a.bin").write_bytes(b"1")
    assert calls.index("rename") > max(calls.index("sync file"), calls.index("sync folder"))
    assert calls[-1] == "sync folder"


def test_a_folder_takes_the_place_of_the_old_one(tmp_path: Path):
    for content in ("old", "new"):
        with atomic_folder(tmp_path / "model") as draft:
            (draft / content).touch()
    assert [path.name for path in (tmp_path / "model").iterdir()] == ["new"]
    assert [path.name for path in tmp_path.iterdir()] == ["model"]


@pytest.mark.parametrize("make", [atomic_path, atomic_folder])
def test_what_fails_leaves_the_old_content_and_no_draft(tmp_path: Path, make):
    place = tmp_path / "model"
    with make(place) as draft:
        (draft / "old").touch() if draft.is_dir() else draft.write_text("old")
    with pytest.raises(RuntimeError), make(place):
        raise RuntimeError
    assert (place / "old").is_file() if place.is_dir() else place.read_text() == "old"
    assert drafts_in(tmp_path) == []


def test_drafts_of_every_kind_are_found(tmp_path: Path):
    with atomic_path(tmp_path / "deep" / "a.json") as file, atomic_folder(tmp_path / "model") as folder:
        (folder / f"{DRAFT}inner").touch()
        found = drafts_in(tmp_path)
        assert file in found
        assert folder in found
        assert all(path.parent != folder for path in found)


def test_the_longest_names_have_drafts_too(tmp_path: Path):
    for name in ("n" * 251 + ".png", "a." + "s" * 253):
        write_text(tmp_path / name, "whole")
        assert (tmp_path / name).read_text() == "whole"


def test_a_place_that_cannot_take_a_file_is_told(tmp_path: Path):
    (tmp_path / "folder").mkdir()
    (tmp_path / "file").touch()
    for place in (tmp_path / "folder", tmp_path / "file" / "a.json", Path("/proc/swimm3r/a.json")):
        with pytest.raises(StorageError, match="cannot be written"):
            write_text(place, "x")
    with pytest.raises(StorageError, match="cannot be written"), atomic_folder(tmp_path / "file"):
        pass
    assert list((tmp_path / "folder").iterdir()) == []
