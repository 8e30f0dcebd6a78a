"""One chunk of a long clip, placed by itself as a small clip is; its models are kept as files.

The chunk's folder, models named 0, 1, ..., appears when they are whole: a killed run repeats the chunks it was at.
"""

import logging
import shutil
import tempfile
from collections.abc import Sequence
from concurrent.futures import ALL_COMPLETED, ThreadPoolExecutor, wait
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from threading import Event
from typing import TYPE_CHECKING

from swimm3r.errors import DeviceError
from swimm3r.io.files.atomic import atomic_folder
from swimm3r.progress import Progress, silent
from swimm3r.sfm.colmap.calibration.start import set_camera
from swimm3r.sfm.colmap.chunks.parts import LEAST_FRAMES
from swimm3r.sfm.colmap.mapping import map_frames, place_leftovers, replace_misplaced
from swimm3r.sfm.features.database import FeatureDatabase, full_disk_said_plainly, write_excerpt
from swimm3r.sfm.settings import ColmapSettings
from swimm3r.tasks import run_tasks
from swimm3r.tasks.outcome import Failure, TaskError, attempt
from swimm3r.tasks.settings import EngineSettings

if TYPE_CHECKING:
    import pycolmap


log = logging.getLogger(__name__)


@dataclass(frozen=True)
class ChunkTask:
    """A chunk to be placed under a lens that is held; plain values, so that another process can place it."""

    name: str
    database: Path
    frames: int  # of the whole clip
    images: tuple[int, ...]  # image ids of the whole clip's database
    lens: tuple[str, tuple[float, ...]]  # COLMAP's model name and parameters
    settings: ColmapSettings
    folder: Path  # that receives the models
    little_overlap: bool = False  # of the whole clip's frames (`FeatureDatabase`)


def place_chunk(task: ChunkTask, progress: Progress = silent) -> None:
    """Place the frames of a chunk, unless its folder is there already."""
    if task.folder.is_dir():
        return
    task.folder.parent.mkdir(parents=True, exist_ok=True)
    with (
        full_disk_said_plainly(task.folder.parent),
        tempfile.TemporaryDirectory(dir=task.folder.parent, prefix=".mapping.") as scratch,
    ):
        whole = FeatureDatabase(task.database, task.frames, little_overlap=task.little_overlap)
        store = write_excerpt(whole, Path(scratch) / "database.db", task.images)
        name, parameters = task.lens
        with store.open() as database:
            camera = database.read_camera(1)
        set_camera(store, lens_with(camera, name, parameters))
        held = replace(task.settings, intrinsics="fixed")
        models = grown(store, map_frames(store, held, progress), held, progress)
    with atomic_folder(task.folder) as draft:
        for k, model in enumerate(m for m in models if m.num_reg_images() >= LEAST_FRAMES):
            (draft / str(k)).mkdir()
            model.write_binary(str(draft / str(k)))


def grown(
    store: FeatureDatabase,
    models: "list[pycolmap.Reconstruction]",
    settings: ColmapSettings,
    progress: Progress,
) -> "list[pycolmap.Reconstruction]":
    """The models of a chunk that fell apart, the largest first, each with the frames that looser limits can add.

    A model most of whose frames a larger one took over is left out.
    """
    out: list[pycolmap.Reconstruction] = []
    taken: set[int] = set()
    for model in models:
        own = set(model.reg_image_ids())
        if 2 * len(own & taken) > len(own):
            continue
        if len(own) < store.frames:
            more = place_leftovers(store, model, settings, progress)
            model = replace_misplaced(store, more, settings, progress)
        out.append(model)
        taken |= set(model.reg_image_ids())
    return out


def place_chunks(
    tasks: Sequence[ChunkTask],
    threads: int,
    label: str,
    progress: Progress,
    engine: EngineSettings = EngineSettings(),  # noqa: B008 - records are frozen
) -> None:
    """Place several chunks at a time, in threads (COLMAP releases the interpreter) or where `engine` says.

    `progress` may stop it. A chunk that failed or whose process was killed for good is said in the log and left out; a
    repeated run tries it again. Where all failed, the error of the first is raised, and so is any that is no chunk's
    own: of the disk, the input or this process's memory.
    """
    if engine.is_in_this_process:
        failures, own = _place_in_threads(tasks, threads, label, progress), (TaskError,)
    else:
        absolute = [replace(task, database=task.database.resolve(), folder=task.folder.resolve()) for task in tasks]
        logs = absolute[0].database.parent / "logs" if absolute else None
        failures, own = run_tasks(place_chunk, absolute, engine, progress, label, logs=logs), (TaskError, DeviceError)
    for failure in failures:
        if not isinstance(failure.error, own) or len(failures) == len(tasks):
            raise failure.error
        log.warning("a chunk of frames is left out: %s", failure.message)


def _place_in_threads(tasks: Sequence[ChunkTask], threads: int, label: str, progress: Progress) -> tuple[Failure, ...]:
    """Place chunks in threads of this process and return the failures; `progress` may stop it."""
    stopped = Event()

    def watch(what: str, done: int, total: int, /) -> None:
        if stopped.is_set():
            raise KeyboardInterrupt

    progress(label, 0, len(tasks))
    with ThreadPoolExecutor(threads) as pool:
        pending = [pool.submit(attempt, partial(place_chunk, progress=watch), task) for task in tasks]
        try:
            done = 0
            while done < len(tasks):  # told twice a second, so that ^C is heard between two chunks, too
                done = len(wait(pending, timeout=0.5, return_when=ALL_COMPLETED).done)
                progress(label, done, len(tasks))
            errors = [future.result().error for future in pending]
        except BaseException:
            stopped.set()
            pool.shutdown(wait=True, cancel_futures=True)
            raise
    return tuple(Failure(task.name, error) for task, error in zip(tasks, errors, strict=True) if error is not None)


def placed_models(folder: Path) -> "list[pycolmap.Reconstruction]":
    """The models of a chunk, none where it was not placed; images are named by their number in the clip."""
    import pycolmap

    if not folder.is_dir():
        return []
    return [pycolmap.Reconstruction(str(path)) for path in sorted(folder.iterdir(), key=lambda path: int(path.name))]


def lens_with(camera: "pycolmap.Camera", name: str, parameters: tuple[float, ...]) -> "pycolmap.Camera":
    """A camera of the same size under another lens."""
    import pycolmap

    return pycolmap.Camera(
        model=name, width=camera.width, height=camera.height, params=list(parameters), camera_id=camera.camera_id
    )


def remove_stale(folder: Path, current: set[str]) -> None:
    """Remove chunks that were placed under other settings, another lens or other matches."""
    if folder.is_dir():
        for path in folder.iterdir():
            if path.name not in current:
                shutil.rmtree(path)
