"""Chunks that threads and other processes place, and those that fall apart.

Finished ones are left alone, and one that cannot be placed is told.
"""

import errno
import shutil
from dataclasses import replace
from pathlib import Path

import pycolmap
import pytest

from swimm3r.errors import DeviceError, StorageError
from swimm3r.prepare import read_frames
from swimm3r.progress import silent
from swimm3r.sfm.colmap import mapping, poses
from swimm3r.sfm.colmap.chunks import place
from swimm3r.sfm.colmap.chunks.place import ChunkTask, grown, place_chunks, placed_models
from swimm3r.sfm.features.database import FeatureDatabase
from swimm3r.sfm.settings import ColmapSettings
from swimm3r.synthetic import write_dive
from swimm3r.synthetic.settings import DiveSettings
from swimm3r.tasks import EngineSettings
from swimm3r.tasks.outcome import Failure, TaskError


@pytest.mark.parametrize("jobs", [1, 2])
def test_chunks_are_left_alone_where_they_are_finished_and_told_where_they_fail(
    jobs: int, tmp_path: Path, caplog: pytest.LogCaptureFixture
):
    def task(name: str) -> ChunkTask:
        database = tmp_path / "missing.db"
        return ChunkTask(name, database, 3, (1, 2, 3), ("PINHOLE", ()), ColmapSettings(), tmp_path / "chunks" / name)

    finished = tmp_path / "chunks" / "finished"
    finished.mkdir(parents=True)
    engine = EngineSettings(jobs=jobs, retries=0)
    place_chunks([task("finished")], 1, "placing chunks", silent, engine)
    assert list(finished.iterdir()) == []
    place_chunks([task("lost"), task("finished")], 1, "placing chunks", silent, engine)
    assert "a chunk of frames is left out: lost failed" in caplog.text
    assert placed_models(tmp_path / "chunks" / "lost") == []
    assert "Traceback" in (caplog.text if jobs == 1 else (tmp_path / "logs" / "lost.log").read_text())
    with pytest.raises(TaskError, match="lost failed"):
        place_chunks([task("lost")], 1, "placing chunks", silent, engine)


def test_an_error_of_the_disk_is_no_chunks_own(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    full = Failure("a", StorageError("the disk is full", cause="large surveys", hint="another disk"))
    monkeypatch.setattr(place, "run_tasks", lambda *_, **__: (full,))
    task = ChunkTask("a", tmp_path / "a.db", 3, (1, 2, 3), ("PINHOLE", ()), ColmapSettings(), tmp_path / "chunks" / "a")
    with pytest.raises(StorageError, match="disk is full"):
        place_chunks([task], 1, "placing chunks", silent, EngineSettings(jobs=2))


@pytest.mark.parametrize(
    ("error", "raised"),
    [
        (KeyboardInterrupt(), KeyboardInterrupt),
        (RuntimeError("[sqlite3_utils.h:50] SQLite error: database or disk is full"), StorageError),
        (OSError(errno.ENOSPC, "No space left on device"), StorageError),
        (MemoryError(), DeviceError),
    ],
)
def test_an_error_that_is_no_chunks_own_ends_the_placing_in_threads(
    error: BaseException, raised: type[BaseException], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
):
    def failing(*_: object) -> None:
        raise error

    monkeypatch.setattr(place, "write_excerpt", failing)
    tasks = [
        ChunkTask(name, tmp_path / "a.db", 3, (1, 2, 3), ("PINHOLE", ()), ColmapSettings(), tmp_path / "chunks" / name)
        for name in ("finished", "failing")
    ]
    tasks[0].folder.mkdir(parents=True)
    with pytest.raises(raised):
        place_chunks(tasks, 1, "placing chunks", silent)


def of_frames(model: pycolmap.Reconstruction, images: set[int]) -> pycolmap.Reconstruction:
    """The model without its other frames."""
    out = pycolmap.Reconstruction(model)
    for image in set(out.reg_image_ids()) - images:
        out.deregister_frame(out.images[image].frame_id)
    return out


@pytest.mark.long
def test_the_models_of_a_chunk_that_fell_apart_grow_and_those_taken_over_are_left_out(tmp_path: Path):
    write_dive(DiveSettings(frames=10, width=240, height=160), tmp_path / "dive")
    frames = read_frames(tmp_path / "dive", folder=tmp_path / "prepare").train
    settings = ColmapSettings(threads=1, mapping=replace(ColmapSettings().mapping, method="incremental"))
    poses.reconstruct(frames, settings, tmp_path / "sfm")
    shutil.copyfile(tmp_path / "sfm" / "database.db", tmp_path / "mapping.db")
    store = FeatureDatabase(tmp_path / "mapping.db", len(frames))
    held = replace(settings, intrinsics="fixed")
    whole = mapping.map_frames(store, held, silent)[0]
    images = sorted(whole.reg_image_ids())
    fallen = [of_frames(whole, set(images[:5])), of_frames(whole, set(images[5:]))]
    (found,) = grown(store, fallen, held, silent)
    assert sorted(found.reg_image_ids()) == images
    assert found.compute_mean_reprojection_error() < 1.2 * whole.compute_mean_reprojection_error()
    (same,) = grown(store, [whole], held, silent)
    assert same is whole
