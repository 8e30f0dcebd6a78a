"""A large map trained: first the water on a map of parts of the dive, then block after block in that water.

A block is trained on the pixels whose surface lies in its window or the margin around it, and leaves the primitives of
the margin to later blocks. Neighbors take turns: the later one is trained beside the finished primitives of the
earlier, and so the two join. Blocks of one turn depend on nothing but their task and files of earlier turns, and a task
whose block is there already does nothing: any number of processes may share them, and one that was killed is repeated
alone, from its checkpoint.
"""

import logging
from collections.abc import Sequence
from dataclasses import asdict, dataclass, replace
from functools import partial
from pathlib import Path

import torch

from swimm3r import devices
from swimm3r.appearance import FrameColors
from swimm3r.devices import CPU
from swimm3r.errors import InputError
from swimm3r.io.files.cache_key import cache_key
from swimm3r.progress import Progress, silent
from swimm3r.scene.frames import Frames
from swimm3r.scene.reconstruction import Reconstruction
from swimm3r.scene.surface import surface_of
from swimm3r.splat.block_store import (
    FOLDER,
    BlockEntry,
    StoredBlocks,
    entry_of,
    joined,
    no_primitives,
    read_block,
    write_block,
)
from swimm3r.splat.blocks.coarse import box_of, coarse_of
from swimm3r.splat.blocks.part import BlockViews, part_of, stretches_of, views_of_blocks
from swimm3r.splat.blocks.plan import PlannedBlock
from swimm3r.splat.ground import Window, held_by_any
from swimm3r.splat.medium.field import MediumField
from swimm3r.splat.primitives.beta import BetaPrimitives, rescaled, select
from swimm3r.splat.recipes import recipe_parts
from swimm3r.splat.rendering import settings_in_scene_units
from swimm3r.splat.settings import FEWEST_PRIMITIVES, UwbsSettings, with_primitives
from swimm3r.splat.training import loop
from swimm3r.splat.training.observer import Observer
from swimm3r.splat.training.scene import Surroundings, TrainingScene, path_radius
from swimm3r.splat.training.state import map_in_scene_units
from swimm3r.splat.views import TrainingViews, median_z_depth
from swimm3r.tasks import run_tasks
from swimm3r.tasks.settings import EngineSettings

log = logging.getLogger(__name__)

_STRIP = 0.1  # of the margin: ground of finished neighbors where a block starts with primitives of its own, too


@dataclass(frozen=True, eq=False)
class BlockTask:
    """The training of one block, ready for another process."""

    number: int
    count: int  # of blocks
    turn: int
    folder: Path  # of the map
    key: str  # of the whole training
    rec: Reconstruction  # its views and points alone
    frames: Frames
    settings: UwbsSettings
    window: Window
    margin: float  # scene units
    closed: tuple[Window, ...]  # of the neighbors of earlier turns
    neighbors: tuple[str, ...]  # their files, relative to the map's folder
    scale: float  # working units per scene unit
    colors: FrameColors | None  # of single frames, all of the map's
    water: MediumField  # per working unit
    device: str

    @property
    def name(self) -> str:
        """The name of the task and of its log."""
        return f"block_{self.number:04d}"

    @property
    def file(self) -> str:
        """The block's file, relative to the map's folder."""
        return f"{FOLDER}/{self.number:04d}.safetensors"


@dataclass(frozen=True, eq=False)
class TrainedBlocks:
    """The parts of a large map."""

    settings: UwbsSettings  # poses held
    water: MediumField  # per working unit
    blocks: StoredBlocks


def train_in_blocks(
    views: TrainingViews,
    plan: Sequence[PlannedBlock],
    folder: Path,
    progress: Progress = silent,
    device: torch.device = CPU,
    observer: Observer | None = None,
    engine: EngineSettings = EngineSettings(),  # noqa: B008 - records are frozen
) -> TrainedBlocks:
    """Train a map's parts in `folder`: checkpoint/ and metrics.jsonl of the water, blocks/ with those of each block.

    Poses and colors of single frames are held, as blocks have to agree on them. The observer sees the training of the
    water. Raises the error of the first block that failed; those that are finished stay.
    """
    assert isinstance(views.settings, UwbsSettings)
    poses, appearance = replace(views.settings.poses, enabled=False), replace(views.settings.appearance, refits=0)
    settings = replace(views.settings, poses=poses, appearance=appearance)
    key = _key(settings, views, plan)
    water = _train_water(settings, views, folder, key, progress, device, observer)
    tasks = _tasks(settings, views, plan, folder, key, water, device)
    steps = sum(task.settings.iterations for task in tasks)
    log.info("%d blocks are trained in %d steps in all", len(tasks), steps)
    here = engine.engine == "local" and engine.at_once(1) == 1  # one after another, each with its own progress
    work = partial(train_block, progress=progress) if here else train_block
    for turn in sorted({task.turn for task in tasks}):
        now = [task for task in tasks if task.turn == turn]
        label = f"training blocks, turn {turn + 1}"
        failures = run_tasks(work, now, engine, progress, label, logs=folder / FOLDER / "logs")
        for failure in failures:
            log.warning("%s of the map's %d blocks: %s", failure.name, len(tasks), failure.message)
        if failures:
            raise failures[0].error
    entries = tuple(entry_of(folder, task.file, key) for task in tasks)
    if not any(entry.primitives for entry in entries):
        raise InputError(
            "no block of the map holds any primitive",
            cause="hardly any depth was found, or every primitive of the map became transparent",
            hint="--splat.blocks.largest 0 for a map of one block, or another reconstruction",
        )
    return TrainedBlocks(settings, water, StoredBlocks(folder, key, entries))


def train_block(task: BlockTask, progress: Progress = silent) -> None:
    """Train a block from its checkpoint, if there is one, and write its files; where they are there, do nothing."""
    if _is_finished(task):
        return
    device = torch.device(task.device)
    around = task.window.widened(task.margin)
    views = TrainingViews(task.rec, task.frames, task.settings, task.scale, around, task.colors)
    radius = path_radius(task.rec, task.scale, task.settings.working_depth)
    scene = TrainingScene(task.rec, task.scale, radius, views, None, device, surroundings_of(task, device))
    schedule = loop.schedule_of(task.settings, task.key, task.number)
    folder = task.folder / FOLDER / f"{task.number:04d}"
    with devices.memory_for("this block", "a smaller --splat.blocks.largest, or --map-device cpu"):
        final = loop.run(
            recipe_parts(task.settings, task.rec.lamp(task.scale)),
            scene,
            schedule,
            folder,
            progress,
            what=f"training block {task.number + 1} of {task.count}",
        )
    primitives, _ = map_in_scene_units(final.to(CPU), 1 / task.scale)
    assert isinstance(primitives, BetaPrimitives)
    kept = (task.window, *task.closed)  # beside what is closed there they were trained; the rest is a later block's
    own = select(primitives, held_by_any(kept, primitives.xyz))
    few = coarse_of(own)
    render = settings_in_scene_units(task.settings, 1 / task.scale).render
    box = box_of(own, render) if len(own.xyz) else (torch.zeros(3), torch.zeros(3))
    path = task.folder / task.file
    low, high = (tuple(corner.tolist()) for corner in box)
    entry = BlockEntry(task.file, len(own.xyz), len(few.primitives.xyz), few.spacing, low, high)
    write_block(task.folder / entry.coarse_file, few.primitives, task.key)
    write_block(path, own, task.key, entry)


def surroundings_of(task: BlockTask, device: torch.device) -> Surroundings:
    """The water, and the primitives of finished neighbors in the block's margin."""
    near = task.window.widened(task.margin)
    parts = [no_primitives()]
    for file in task.neighbors:
        theirs = read_block(task.folder / file, task.key)
        parts.append(select(theirs, near.holds(theirs.xyz)))
    neighbors = rescaled(joined(parts), task.scale).to(device)
    return Surroundings(task.water, neighbors)


def _is_finished(task: BlockTask) -> bool:
    """Return whether the block's files are there, whole and of this training."""
    if not (task.folder / task.file).is_file():
        return False
    try:
        entry_of(task.folder, task.file, task.key)
    except InputError as error:
        log.warning("%s is trained again: %s", task.name, error.what)
        return False
    return True


def _train_water(
    settings: UwbsSettings,
    views: TrainingViews,
    folder: Path,
    key: str,
    progress: Progress,
    device: torch.device,
    observer: Observer | None,
) -> MediumField:
    """The water of a map of stretches spread over the dive, with the ground of one block; per working unit.

    A map of all ground would be so coarse, and each primitive drawn so seldom, that the water, which is drawn in every
    step, would take the primitives' colors.
    """
    rec, scale = views.rec, views.scale
    surface = surface_of(rec, median_z_depth(rec))
    part = stretches_of(rec, views.names, surface, settings.blocks.largest)
    views = TrainingViews(part, views.frames, settings, scale, colors=views.colors)
    short = replace(settings, iterations=max(1, round(settings.blocks.water_steps * settings.iterations)))
    radius = path_radius(rec, scale, settings.working_depth)
    scene = TrainingScene(views.rec, scale, radius, views, None, device)
    schedule = loop.schedule_of(short, key, "water")
    with devices.memory_for("the water's map", "a smaller --splat.long-side, or --map-device cpu"):
        final = loop.run(
            recipe_parts(short, rec.lamp(scale)), scene, schedule, folder, progress, observer, "training the water"
        )
    return final.to(CPU).field.requires_grad_(False)


def _tasks(
    settings: UwbsSettings,
    views: TrainingViews,
    plan: Sequence[PlannedBlock],
    folder: Path,
    key: str,
    water: MediumField,
    device: torch.device,
) -> list[BlockTask]:
    """A task for each block that a view sees."""
    tasks: dict[int, BlockTask] = {}
    rec, seen_by = views.rec, views_of_blocks(views.rec, views.names, plan)
    for k in sorted(range(len(plan)), key=lambda k: plan[k].turn):
        block, seeing = plan[k], seen_by[k]
        before = [tasks[j] for j in block.before if j in tasks]
        closed = tuple(task.window for task in before)
        inner = [window.widened(-_STRIP * block.margin) for window in closed]
        part = part_of(rec, seeing.names, block.window.widened(block.margin), inner)
        points = part.points.xyz if part.cloud is None else part.cloud.xyz
        if not seeing.names or len(points) < FEWEST_PRIMITIVES:
            log.warning("block %d of %d is left empty: no training frame sees it", k + 1, len(plan))
            continue
        tasks[k] = BlockTask(
            k, len(plan), block.turn, folder, key, part, views.frames, of_block(settings, block, seeing), block.window,
            block.margin, closed, tuple(task.file for task in before), views.scale, views.colors, water, str(device),
        )  # fmt: skip
    return [tasks[k] for k in sorted(tasks)]


def of_block(settings: UwbsSettings, block: PlannedBlock, views: BlockViews) -> UwbsSettings:
    """The settings of a block, with primitives and steps in proportion to its area.

    Views of which it is a part alone are more than the images that they make up; each takes its turn, so that the
    ground is seen as often as in a map of one block. The image loss is a mean over whole views, so that what is weighed
    against it, for all primitives in every step, has less weight by the share of the views that takes part.
    """
    taking_part = views.images / len(views.names)
    count = round(settings.blocks.steps * block.area / settings.blocks.largest / taking_part * settings.iterations)
    w = settings.weights
    weights = replace(w, opacity=taking_part * w.opacity, scale=taking_part * w.scale)
    dense = with_primitives(settings, block.open_area / settings.full_area)
    return replace(dense, iterations=max(1, count), weights=weights)


def _key(settings: UwbsSettings, views: TrainingViews, plan: Sequence[PlannedBlock]) -> str:
    cameras = [views.rec.cameras.cam2world.tolist(), views.rec.cameras.K.tolist()]
    colors = [] if views.colors is None else [each.tolist() for each in views.colors.tensors()]
    return cache_key(asdict(settings), views.names, *cameras, *colors, [asdict(block) for block in plan])[:16]
