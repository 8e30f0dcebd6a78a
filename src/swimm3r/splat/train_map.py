"""From a reconstruction to a map: the recipe of the settings, its run, and the map in the scene's own unit."""

import copy
import logging
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import torch

from swimm3r import devices
from swimm3r.appearance import FrameColors
from swimm3r.cameras import Cameras
from swimm3r.devices import CPU
from swimm3r.errors import UsageError
from swimm3r.imaging.appearance import decide_appearance
from swimm3r.imaging.undistortion import nearest_pixels, shown_pixels
from swimm3r.progress import Progress, silent
from swimm3r.scene.frames import Frames
from swimm3r.scene.reconstruction import Reconstruction
from swimm3r.scene.surface import Surface, surface_of
from swimm3r.splat.appearance import write_decision
from swimm3r.splat.block_store import no_primitives
from swimm3r.splat.blocks.plan import PlannedBlock, plan_blocks
from swimm3r.splat.blocks.training import train_in_blocks
from swimm3r.splat.medium.field import in_unit
from swimm3r.splat.projection.observed import MOST, SIDE, TrainingCoverage, coverage_of
from swimm3r.splat.recipes import recipe_parts
from swimm3r.splat.rendering import SplatMap
from swimm3r.splat.settings import IN_BLOCKS, BlockSettings, SplatSettings, UwbsSettings, with_primitives
from swimm3r.splat.training import loop
from swimm3r.splat.training.observer import Observer
from swimm3r.splat.training.scene import TrainingScene, path_radius
from swimm3r.splat.training.state import map_in_scene_units
from swimm3r.splat.training_poses import RefinedPoses, as_mapped, training_poses_of, write_refined
from swimm3r.splat.views import TrainingViews, median_z_depth, working_scale
from swimm3r.tasks.settings import EngineSettings

log = logging.getLogger(__name__)


def train(
    rec: Reconstruction,
    frames: Frames,
    settings: SplatSettings,
    folder: Path,
    progress: Progress = silent,
    device: torch.device = CPU,
    observer: Observer | None = None,
    engine: EngineSettings = EngineSettings(),  # noqa: B008 - records are frozen
) -> SplatMap:
    """Train a map in `folder`: checkpoint/, metrics.jsonl, appearance.json, and last map.safetensors and refined poses.

    All are in the scene's own unit; cameras.json and trajectory.tum are not written where poses are held. A static map
    of more ground than one block holds is trained in several, in blocks/ (`splat.blocks`).
    """
    if settings.recipe != "uwbs-dynamic":  # a dynamic map is trained on what moves
        frames = rec.still(frames)
    scale, depth = working_scale(rec, settings), median_z_depth(rec)
    _check_near(settings, scale * depth)
    surface = surface_of(rec, depth)
    if plan := _plan(surface, depth, settings):
        assert isinstance(settings, UwbsSettings)
        return _in_blocks(rec, frames, settings, plan, scale, folder, progress, device, observer, engine)
    settings = _for_ground(settings, float(surface.area.sum()))
    views = TrainingViews(rec, frames, settings, scale)
    views.colors = _own_colors(rec, frames, views.names, settings, folder)
    poses_in_training = training_poses_of(rec, views.names, views.cameras, scale) if settings.poses.enabled else None
    radius = path_radius(rec, scale, settings.working_depth)
    training_scene = TrainingScene(rec, scale, radius, views, poses_in_training, device)
    with devices.memory_for("this map", "fewer primitives, a smaller --splat.long-side, or --map-device cpu"):
        schedule = _schedule(settings, rec, views)
        final = loop.run(recipe_parts(settings, rec.lamp(scale)), training_scene, schedule, folder, progress, observer)
    primitives, field = map_in_scene_units(final, 1 / scale)
    poses = None
    if poses_in_training is not None and final.poses is not None:
        poses = poses_in_training.refined(final.poses)
        write_refined(folder, rec, frames, poses)
    viewpoint = _viewpoint(rec, views, poses)
    scene = SplatMap(
        primitives, field, settings, rec.metric, 1 / scale, frames.span, poses, viewpoint, colors=views.colors
    )
    scene = replace(scene, coverage=seen_in_training(scene, rec, frames, views.names))
    scene.save(folder / "map.safetensors")
    return scene


def _own_colors(
    rec: Reconstruction, frames: Frames, names: Sequence[str], settings: SplatSettings, folder: Path
) -> FrameColors | None:
    """The first colors of single frames, where they need any; the decision goes into the map's folder."""
    found = decide_appearance(rec, frames, names, settings.appearance)
    log.info("colors of single frames %s: %s", "fitted" if found.decision.on else "not fitted", found.decision.reason)
    write_decision(folder, found.decision)
    return found.colors


def _in_blocks(
    rec: Reconstruction,
    frames: Frames,
    settings: UwbsSettings,
    plan: Sequence[PlannedBlock],
    scale: float,
    folder: Path,
    progress: Progress,
    device: torch.device,
    observer: Observer | None,
    engine: EngineSettings,
) -> SplatMap:
    """A map whose primitives stay on disk."""
    views = TrainingViews(rec, frames, settings, scale)
    views.colors = _own_colors(rec, frames, views.names, settings, folder)
    trained = train_in_blocks(views, plan, folder, progress, device, observer, engine)
    field = in_unit(copy.deepcopy(trained.water), 1 / scale)
    viewpoint = _viewpoint(rec, views, None)
    blocks = trained.blocks
    scene = SplatMap(
        no_primitives(), field, trained.settings, rec.metric, 1 / scale, frames.span, None, viewpoint, blocks,
        colors=views.colors,
    )  # fmt: skip
    scene = replace(scene, coverage=seen_in_training(scene.to(device), rec, frames, views.names))
    scene.save(folder / "map.safetensors")
    return scene.to(device)


def seen_in_training(scene: SplatMap, rec: Reconstruction, frames: Frames, names: Sequence[str]) -> TrainingCoverage:
    """Small images of the training frames as the finished map renders their depth."""
    cameras = as_mapped(rec, scene.poses).cameras
    chosen, canvases, views, admitted = names[:: -(-len(names) // MOST)], [], [], []
    for name in chosen:
        lens, f = cameras[rec.index(name)], frames.index(name)
        canvases.append(lens.drawn(SIDE))
        views.append(scene.render(canvases[-1], frames.frames[f].time, backscatter=False, observed=False))
        row, column = nearest_pixels(lens, canvases[-1])
        admitted.append(shown_pixels(lens, canvases[-1]) & frames.mask(f)[row, column])
    small = cameras[[rec.index(name) for name in chosen]].drawn(SIDE)
    return coverage_of(small, [view.z_depth for view in views], [view.alpha for view in views], admitted)


def _viewpoint(rec: Reconstruction, views: TrainingViews, poses: RefinedPoses | None) -> Cameras:
    """The pinhole camera of the middle training frame, where the training left it, scene units."""
    name = views.names[len(views) // 2]
    camera = rec.cameras[rec.index(name)].pinhole(views.settings.long_side)
    if poses is None:
        return camera
    return replace(camera, cam2world=poses.cam2world[[poses.names.index(name)]])


def _check_near(settings: SplatSettings, median_depth: float) -> None:
    """Raise UsageError where half of the scene would not be drawn; the depth is in working units."""
    if settings.render.near >= median_depth:
        raise UsageError(
            f"the near plane ({settings.render.near:g}) lies behind half of the scene, whose median depth is"
            f" {median_depth:g} working units",
            cause="it was given in another unit than metres, or than thirds of the median depth",
            hint="leave --splat.render.near out for the default",
        )


def _schedule(settings: SplatSettings, rec: Reconstruction, views: TrainingViews) -> loop.Schedule:
    cameras = [rec.cameras.cam2world.tolist(), rec.cameras.K.tolist()]
    matches = []
    if settings.poses.enabled:
        matches.append(float(rec.matches.xy_i.double().sum() + rec.matches.xy_j.double().sum()))
    colors = []
    if views.colors is not None:
        colors = [part.tolist() for part in views.colors.tensors()]
    return loop.schedule_of(settings, views.names, views.times, *cameras, *matches, *colors)


def _limits(settings: SplatSettings) -> BlockSettings:
    return settings.blocks if isinstance(settings, UwbsSettings) else BlockSettings()


def _for_ground(settings: SplatSettings, area: float) -> SplatSettings:
    """Settings of a map in one piece, with primitives for its ground, in images, but for no more than a block holds."""
    return with_primitives(settings, max(1.0, min(area, _limits(settings).largest) / settings.full_area))


def _plan(surface: Surface, depth: float, settings: SplatSettings) -> tuple[PlannedBlock, ...]:
    """The blocks of a map; none where it is trained as a whole."""
    limits = _limits(settings)
    if not limits.largest:
        return ()
    plan = plan_blocks(surface, depth, limits)
    if len(plan) == 1:
        return ()
    area = float(surface.area.sum())
    if settings.recipe not in IN_BLOCKS:
        log.warning(
            "the ground is %.0f images large, and maps of %s have one block, made for %g: expect less detail",
            area, settings.recipe, limits.largest,
        )  # fmt: skip
        return ()
    log.info("the ground is %.0f images large: the map has %d blocks, and the poses are held", area, len(plan))
    return plan
