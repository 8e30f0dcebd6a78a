"""Mapping of a long clip: pilot chunk -> lens -> every chunk under it -> joined -> one adjustment.

A chunk is placed by the method for small clips, so that its errors are found by the checks for small clips. Chunks that
fail, and frames that a chunk leaves over, are those of no part; models that nothing joins are handed back beside the
largest.
"""

from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from swimm3r.io.files.cache_key import cache_key
from swimm3r.progress import Progress
from swimm3r.sfm.colmap.calibration.refinement import adjust_lens, adjust_poses
from swimm3r.sfm.colmap.calibration.start import set_camera
from swimm3r.sfm.colmap.chunks.assemble import assemble
from swimm3r.sfm.colmap.chunks.join import Joined, join_parts
from swimm3r.sfm.colmap.chunks.links import link
from swimm3r.sfm.colmap.chunks.parts import Part, coherent_models, coherent_parts, part_of, shared_points
from swimm3r.sfm.colmap.chunks.pilot import PILOT, PilotLens, pilot_lens
from swimm3r.sfm.colmap.chunks.place import ChunkTask, place_chunks, placed_models, remove_stale
from swimm3r.sfm.colmap.chunks.plan import order_by_matches, plan_chunks
from swimm3r.sfm.colmap.settings import MappingSettings
from swimm3r.sfm.features.database import FeatureDatabase, match_counts
from swimm3r.sfm.settings import ColmapSettings
from swimm3r.tasks.settings import EngineSettings
from swimm3r.tasks.threads import thread_count

if TYPE_CHECKING:
    import pycolmap

_FOLDER = "chunks"  # in the working folder
_PLACING, _LINKING = "placing chunks", "linking chunks"


def is_long(frames: int, settings: MappingSettings) -> bool:
    """Return whether a clip of so many frames is mapped in chunks."""
    return settings.method == "auto" and frames > 2 * settings.chunk_frames


@dataclass(frozen=True)
class LongClip:
    """The models of a long clip, adjusted under one lens, which is left in the database; the largest first."""

    models: "list[pycolmap.Reconstruction]"
    lens_determined: bool  # by the images; else assumed, or held for the user


def map_long_clip(
    store: FeatureDatabase,
    settings: ColmapSettings,
    *,
    ordered: bool,
    progress: Progress,
    engine: EngineSettings = EngineSettings(),  # noqa: B008 - records are frozen
) -> LongClip:
    """Map a clip of any length in chunks; `engine` says where they are placed."""
    matches = match_counts(store)
    order = list(range(store.frames)) if ordered else order_by_matches(store.frames, matches).tolist()
    windows = plan_chunks(order, settings.mapping.chunk_frames, settings.mapping.chunk_overlap)
    chunks = [tuple(i + 1 for i in window) for window in windows]
    folder = store.path.parent / _FOLDER
    lens = pilot_lens(store, chunks, matches, settings, folder / PILOT, progress)
    if lens is None:
        return LongClip([], lens_determined=False)
    tasks = [_task(store, chunk, lens, matches, settings, folder) for chunk in chunks]
    remove_stale(folder, {task.folder.name for task in tasks} | {PILOT})
    place_chunks(tasks, settings.threads or thread_count(), _PLACING, progress, engine)
    placed = [part_of(model) for task in tasks for model in placed_models(task.folder)]
    parts = [piece for part in placed for piece in coherent_parts(part)]
    models = _join(store, parts, lens, settings, progress) if parts else []
    return LongClip(models, lens.determined)


def _task(
    store: FeatureDatabase,
    chunk: tuple[int, ...],
    lens: PilotLens,
    matches: dict[tuple[int, int], int],
    settings: ColmapSettings,
    folder: Path,
) -> ChunkTask:
    own = set(chunk)
    inside = sorted((i, j, count) for (i, j), count in matches.items() if i + 1 in own and j + 1 in own)
    key = cache_key(chunk, inside, lens.model, lens.params, settings.mapping, store.little_overlap)
    held = (lens.model, lens.params)
    return ChunkTask(key, store.path, store.frames, chunk, held, settings, folder / key, store.little_overlap)


def _join(
    store: FeatureDatabase, parts: list[Part], pilot: PilotLens, settings: ColmapSettings, progress: Progress
) -> "list[pycolmap.Reconstruction]":
    """The parts that hang together, each group one model, adjusted; the largest first, and its lens for all."""
    with store.open() as database:
        lens = pilot.camera(database.read_camera(1))
        used = sorted({image for part in parts for image in part.images})
        pixels = {image: database.read_keypoints(image)[:, :2].astype(np.float64) for image in used}
    shared = shared_points(store, parts)
    links = []
    for done, ((a, b), points) in enumerate(sorted(shared.items())):
        progress(_LINKING, done, len(shared))
        found = link(a, b, parts, points, pixels, lens)
        if found is not None:
            links.append(found)
    progress(_LINKING, len(shared), len(shared))
    groups = join_parts(len(parts), links, lens.mean_focal_length())
    models: list[pycolmap.Reconstruction] = []
    for group in sorted(groups, key=lambda group: _frames_of(group, parts), reverse=True):
        model = assemble(store, parts, group, lens, progress)
        if pilot.determined and not models and not store.little_overlap:
            model = adjust_lens(store, model, settings, progress, is_large=True)
            lens = model.cameras[1]
        else:
            model = adjust_poses(store, model)
        models.extend(coherent_models(model))
    set_camera(store, lens)
    return sorted(models, key=lambda model: model.num_reg_images(), reverse=True)


def _frames_of(group: Joined, parts: list[Part]) -> int:
    return len({image for part in group.from_part for image in parts[part].images})
