"""The training loop: which view when, the record of every few steps, checkpoints, and going on where it stopped.

A recipe brings the step itself. Everything random is drawn from the seed and the step, so a state needs no generators,
and a run that was interrupted ends with the same bits as one that was not. On a processor torch computes on one thread
between kernels that use all of them, so the number of threads changes no bit either.
"""

import logging
import math
import time
from collections.abc import Callable
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any, Protocol, runtime_checkable

import torch
from torch import Tensor

from swimm3r.appearance import ColorFit
from swimm3r.io.files import metrics_log
from swimm3r.io.files.cache_key import cache_key
from swimm3r.io.files.damage import guard
from swimm3r.progress import Progress
from swimm3r.raster.cpu.threads import threads_for_kernels_alone
from swimm3r.splat.appearance import fit_to_view
from swimm3r.splat.medium.kinds import Water
from swimm3r.splat.pose_mlp import PoseMlp
from swimm3r.splat.primitives.kinds import Primitives
from swimm3r.splat.rendering import images
from swimm3r.splat.settings import SplatSettings
from swimm3r.splat.shared_settings import MapAppearanceSettings
from swimm3r.splat.training.checkpoint import StateHeader, read_state, state_remedy, write_state
from swimm3r.splat.training.observer import Observer, TrainingStep
from swimm3r.splat.training.scene import TrainingScene, with_footprints
from swimm3r.splat.training.state import State, restored, stored
from swimm3r.splat.views import TrainingView, smaller

log = logging.getLogger(__name__)

_TRAINING = 2  # raised by every change of the code that trains differently from the same settings
_FIRST_REFIT = 0.4  # of the run: every recipe has its water by then
_REFIT_SIDE = 160  # pixels of the longer side, at least, of the images that colors are fitted on
_COLORS, _SHADING = "frame_colors", "frame_shading"  # of a checkpoint
_FOOTPRINTS_EVERY = 0.1  # of the run: primitives move little, and those that take another's place take its footprint

Numbers = dict[str, float | Tensor]
"""Scalars logged by one step; tensors stay on their device until the log is written."""


@runtime_checkable  # so that the suite can check calls against it
class Recipe(Protocol):
    """A method in the training loop: one scene's first state and every step."""

    @property
    def settings(self) -> SplatSettings:
        """Every number of the method."""
        ...

    @property
    def scene(self) -> TrainingScene:
        """The scene in working units, with the views to learn from."""
        ...

    def start(self) -> State:
        """The state before step 1."""
        ...

    def step(self, state: Any, view: TrainingView, step: int) -> tuple[State, Numbers]:
        """The state after training on one view, and the numbers of the step; steps count from 1."""
        ...


@dataclass(frozen=True)
class RecipeParts:
    """A recipe's kind of primitives, its water (untrained), and its training of one scene."""

    primitives: type[Primitives]
    field: Water
    build: Callable[[TrainingScene], Recipe]


@dataclass(frozen=True)
class Schedule:
    """Length of a training, and its intervals for logs and checkpoints."""

    iterations: int
    log_every: int
    checkpoint_every: int
    seed: int
    fingerprint: str  # of settings and input: a checkpoint of another training is not continued


def schedule_of(settings: SplatSettings, *made_from: object) -> Schedule:
    """The schedule that settings ask for; a checkpoint goes on where these and what the map is made from are alike."""
    return Schedule(
        iterations=settings.iterations,
        log_every=max(1, math.ceil(settings.log_every * settings.iterations)),
        checkpoint_every=max(1, math.ceil(settings.checkpoint_every * settings.iterations)),
        seed=settings.seed,
        fingerprint=cache_key(_TRAINING, asdict(settings), *made_from)[:16],
    )


def generator(seed: int, step: int, purpose: int) -> torch.Generator:
    """The randomness of one purpose in one step."""
    mixed = (seed * 1_000_003 + step) * 1_009 + purpose
    return torch.Generator().manual_seed(mixed % (1 << 63))


def view_of_step(step: int, views: int, seed: int) -> int:
    """Each epoch visits every view once, in its own order; steps count from 1."""
    epoch, place = divmod(step - 1, views)
    return int(torch.randperm(views, generator=generator(seed, epoch, 1))[place])


@threads_for_kernels_alone()
def run(
    parts: RecipeParts,
    scene: TrainingScene,
    schedule: Schedule,
    folder: Path,
    progress: Progress,
    observer: Observer | None = None,
    what: str = "training the map",
) -> State:
    """Train from the checkpoint in `folder`, if there is one of this training, else from the start."""
    recipe = parts.build(scene)
    path, metrics = folder / "checkpoint" / "state.safetensors", folder / "metrics.jsonl"
    folder.mkdir(parents=True, exist_ok=True)
    state, done = _resume(recipe, parts, path, metrics, schedule)
    state = state.to(recipe.scene.device)
    measured_every = math.ceil(_FOOTPRINTS_EVERY * schedule.iterations)
    refits = refit_steps(recipe.settings.appearance, schedule.iterations)
    started, cpu_started, first = time.perf_counter(), time.process_time(), done
    sums: dict[str, tuple[float | Tensor, int]] = {}
    for step in range(done + 1, schedule.iterations + 1):
        progress(what, step - 1, schedule.iterations)
        view = recipe.scene.view(view_of_step(step, len(recipe.scene.views), schedule.seed))
        if (step - 1) % measured_every == 0:
            state = with_footprints(recipe.scene, state)
        state, numbers = recipe.step(state, view, step)
        for name, value in numbers.items():
            total, count = sums.get(name, (0.0, 0))
            sums[name] = total + (value.detach() if isinstance(value, Tensor) else value), count + 1
        last = step == schedule.iterations
        if step % schedule.log_every == 0 or last:
            row = {"step": step} | {name: float(total) / count for name, (total, count) in sums.items()}
            row["seconds_per_step"] = (time.perf_counter() - started) / (step - first)
            row["cpu_seconds_per_step"] = (time.process_time() - cpu_started) / (step - first)
            metrics_log.append_row(metrics, row)
            sums = {}
        if step in refits and scene.surroundings is None:
            fit_frame_colors_again(recipe, state)
        if step % schedule.checkpoint_every == 0 or last:
            write_state(path, stored(state) | _stored_colors(scene), StateHeader(step, schedule.fingerprint))
        if observer is not None:
            observer(TrainingStep(step, schedule.iterations, numbers, view, recipe.scene, state))
    progress(what, schedule.iterations, schedule.iterations)
    return state


def refit_steps(settings: MapAppearanceSettings, iterations: int) -> frozenset[int]:
    """The steps after which the frames' colors are fitted again, from `_FIRST_REFIT` of the run on."""
    shares = (_FIRST_REFIT + (1 - _FIRST_REFIT) * k / settings.refits for k in range(settings.refits))
    return frozenset(max(1, round(share * iterations)) for share in shares)


@torch.no_grad()
def fit_frame_colors_again(recipe: Recipe, state: State) -> None:
    """Fit the maps of the training frames to what the map shows of each by now; nothing where there are none."""
    scene, settings = recipe.scene, recipe.settings
    colors = scene.views.colors
    if colors is None:
        return
    fits: list[ColorFit] = []
    for k in range(len(scene.views)):
        view = scene.view(k)
        view = smaller(view, max(1, max(view.seen.shape) // _REFIT_SIDE))
        shown = images(state.primitives, state.field, scene.pinhole_view(view, state.poses), settings, view.time)
        shaded = colors.shading is not None
        fits.append(fit_to_view(shown.rgb.cpu(), view.rgb.cpu(), view.measured.float().cpu(), shaded=shaded))
    scene.views.colors = colors.refitted(fits)


def _stored_colors(scene: TrainingScene) -> dict[str, Tensor]:
    colors = scene.views.colors
    if colors is None:
        return {}
    return {_COLORS: colors.maps} | ({} if colors.shading is None else {_SHADING: colors.shading})


def _restore_colors(scene: TrainingScene, tensors: dict[str, Tensor]) -> None:
    """Raises KeyError or ValueError where a state has no maps, or those of another number of frames."""
    colors = scene.views.colors
    if colors is None:
        return
    kept = {_COLORS: colors.maps} if colors.shading is None else {_COLORS: colors.maps, _SHADING: colors.shading}
    for name, now in kept.items():
        if tensors[name].shape != now.shape:
            raise ValueError(f"{name} has the shape {tuple(tensors[name].shape)} for {len(colors.names)} frames")
    shading = None if colors.shading is None else tensors[_SHADING]
    scene.views.colors = replace(colors, maps=tensors[_COLORS], shading=shading)


def _resume(recipe: Recipe, parts: RecipeParts, path: Path, metrics: Path, schedule: Schedule) -> tuple[State, int]:
    """The state to go on from, and its step; rows of metrics beyond it are dropped."""
    done = 0
    state = None
    if path.is_file():
        kept = read_state(path)
        if kept.about.fingerprint == schedule.fingerprint:
            with guard(path, state_remedy(path)):
                cameras = recipe.scene.refined_cameras
                poses = PoseMlp(cameras, recipe.settings.poses) if cameras else None
                state = restored(kept.tensors, parts.primitives, parts.field, poses)
                _restore_colors(recipe.scene, kept.tensors)
            done = kept.about.step
            log.info("going on from step %d", done)
        else:
            log.warning("%s belongs to a training with other settings or input; starting anew", path)
    metrics_log.drop_rows_after(metrics, done)
    return (recipe.start(), 0) if state is None else (state, done)
