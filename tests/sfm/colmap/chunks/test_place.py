"""Chunks that other processes place: finished ones are left alone, and one that cannot be placed is told."""

from pathlib import Path

import pytest

from swimm3r.errors import StorageError
from swimm3r.progress import silent
from swimm3r.sfm.colmap.chunks import place
from swimm3r.sfm.colmap.chunks.place import ChunkTask, place_chunks, placed_models
from swimm3r.sfm.settings import ColmapSettings
from swimm3r.tasks import EngineSettings
from swimm3r.tasks.outcome import Failure


def test_chunks_in_processes_are_left_alone_where_they_are_finished_and_told_where_they_fail(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
):
    def task(name: str) -> ChunkTask:
        database = tmp_path / "missing.db"
        return ChunkTask(name, database, 3, (1, 2, 3), ("PINHOLE", ()), ColmapSettings(), tmp_path / "chunks" / name)

    finished = tmp_path / "chunks" / "finished"
    finished.mkdir(parents=True)
    engine = EngineSettings(jobs=2, retries=0)
    place_chunks([task("finished")], 1, "placing chunks", silent, engine)
    assert list(finished.iterdir()) == []
    place_chunks([task("lost"), task("finished")], 1, "placing chunks", silent, engine)
    assert "a chunk of frames is left out: lost failed" in caplog.text
    assert placed_models(tmp_path / "chunks" / "lost") == []
    assert "Traceback" in (tmp_path / "logs" / "lost.log").read_text()


def test_an_error_of_the_disk_is_no_chunks_own(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    full = Failure("a", StorageError("the disk is full", cause="large surveys", hint="another disk"))
    monkeypatch.setattr(place, "run_tasks", lambda *_, **__: (full,))
    task = ChunkTask("a", tmp_path / "a.db", 3, (1, 2, 3), ("PINHOLE", ()), ColmapSettings(), tmp_path / "chunks" / "a")
    with pytest.raises(StorageError, match="disk is full"):
        place_chunks([task], 1, "placing chunks", silent, EngineSettings(jobs=2))
