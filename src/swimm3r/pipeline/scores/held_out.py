"""Held-out views: poses of the test frames, the map rendered from there, and its scores.

A frame's first pose comes from a reference where one is given, else from its matches with triangulated points and
measured depth of the reconstruction, else from its neighbors in time. A frame that matches nothing, and whose neighbors
are not registered, has no known place and is not scored. Poses are refined on the frozen map (`splat.pose_refinement`),
for a score should be about the map and not about a pose that is a pixel off. Scores count the pixels that the lens
shows and the mask admits, on the pinhole canvas of the training size.
"""

import logging
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass, fields, replace
from pathlib import Path
from typing import Literal

import numpy as np
import torch
from jaxtyping import Bool, Float
from torch import Tensor

from swimm3r import weights
from swimm3r.appearance import FrameColors
from swimm3r.cameras import Cameras
from swimm3r.evaluate import NotComputed
from swimm3r.evaluate.images import ViewScores, mean_view_scores, view_scores
from swimm3r.evaluate.lpips import Lpips, load_lpips
from swimm3r.evaluate.registration import recolored_by_halves, recolored_by_tiles
from swimm3r.geometry import Similarity, best_similarity
from swimm3r.imaging.turned_rows import at_half_time, mask_at_half_time
from swimm3r.imaging.undistortion import shown_pixels, undistorted
from swimm3r.io.view_names import view_stems
from swimm3r.localization.interpolation import is_beside_registered, lens_of, neighbors, pose_from_neighbors
from swimm3r.localization.landmarks import Located, landmarks_of, locate
from swimm3r.pipeline.renders import display_style, write_view
from swimm3r.pipeline.scores.part_scores import (
    CoveredScores,
    MotionScores,
    ObservedScores,
    StillScores,
    covered_scores,
    mean_part,
    motion_scores,
    not_computed,
    observed_scores,
    still_scores,
)
from swimm3r.progress import Progress, silent
from swimm3r.scene.coverage import TrainingCoverage
from swimm3r.scene.frames import Frames
from swimm3r.scene.ground_truth import GroundTruth
from swimm3r.scene.reconstruction import Reconstruction
from swimm3r.sfm.colmap.shutter.turning import turned_pose
from swimm3r.sfm.features.settings import FeatureSettings
from swimm3r.sfm.medium.settings import RestoreSettings
from swimm3r.sfm.moving.still_scene import still_scene
from swimm3r.splat.pose_refinement import refine_pose
from swimm3r.splat.rendering import SplatMap
from swimm3r.splat.settings import PoseRefinementSettings
from swimm3r.splat.training_poses import axes_of_map

log = logging.getLogger(__name__)

Source = Literal["reference", "2D-3D matches", "neighbors"]
_REFERENCES = 6  # registered frames, the nearest in time, that a held-out frame is matched with


@dataclass(frozen=True)
class FirstPose:
    """The pose from which a frame's refinement starts."""

    cam2world: Float[Tensor, "4 4"]
    source: Source
    turn: Float[np.ndarray, "3"] | None = None  # of the camera while rows were exposed, where training frames turned


@dataclass(frozen=True)
class HeldOutView:
    """One frame that training did not see, as the map shows it."""

    name: str
    time: float  # seconds of the clip
    lens: Cameras  # the frame's own camera, its pose refined
    canvas: Cameras  # its pinhole at the training size
    window: "Crop"  # of the canvas that was rendered and scored
    first: FirstPose
    scores: ViewScores
    covered: CoveredScores
    observed: ObservedScores
    still: StillScores
    motion: MotionScores


def first_poses(
    rec: Reconstruction,
    frames: Frames,
    features: FeatureSettings,
    reference: GroundTruth | None = None,
    progress: Progress = silent,
) -> dict[str, FirstPose]:
    """A pose of every test frame that has a known place, in the axes and unit of the reconstruction."""
    known = {} if reference is None else reference_poses(rec, reference)
    landmarks = landmarks_of(rec, rec.still(frames), features)
    poses, without_lens, unplaced = {}, [], []
    for done, name in enumerate(frames.test.names):
        progress("placing test frames", done, len(frames.test))
        lens = lens_of(rec, frames, name)
        if lens is None:
            without_lens.append(name)
            continue
        if name in known and not frames.rows_rectified:
            poses[name] = FirstPose(known[name], "reference")
            continue
        f, near = frames.index(name), neighbors(rec, frames, name, _REFERENCES)
        located = locate(frames.image(f), frames.mask(f), lens, [landmarks(other) for other in near], features)
        first = _first_pose(rec, frames, name, lens, located)
        if name in known:
            turn = None if first is None else first.turn
            first = FirstPose(known[name], "reference", turn)
        if first is None:
            unplaced.append(name)
        else:
            poses[name] = first
    progress("placing test frames", len(frames.test), len(frames.test))
    if unplaced:
        log.warning(
            "test frames that match nothing, with no registered frame near, not scored: %s", ", ".join(unplaced)
        )
    if without_lens:
        log.warning(
            "test frames of a camera whose lens is not known, as none of its frames is registered and no calibration"
            " states it, not scored: %s",
            ", ".join(without_lens),
        )
    return poses


def _first_pose(
    rec: Reconstruction, frames: Frames, name: str, lens: Cameras, located: Located | None
) -> FirstPose | None:
    """The pose of a test frame by its matches, else by its camera's frames around it; None where these are far away."""
    if located is None:
        near = is_beside_registered(rec, frames, name)
        return FirstPose(pose_from_neighbors(rec, frames, name), "neighbors") if near else None
    if frames.rows_rectified:
        return _turned(replace(lens, cam2world=located.cam2world[None]), located)
    return FirstPose(located.cam2world, "2D-3D matches")


def _turned(camera: Cameras, located: Located) -> FirstPose:
    """The pose of a camera that turned while its rows were exposed, near the one that it has without."""
    cam2world, turn = turned_pose(camera, located.pixels, located.points)
    return FirstPose(cam2world, "2D-3D matches", turn)


def reference_poses(rec: Reconstruction, reference: GroundTruth) -> dict[str, Float[Tensor, "4 4"]]:
    """The reference's poses in the reconstruction's axes and unit; none where the frames they share do not align."""
    place = {name: i for i, name in enumerate(reference.names)}
    shared = [name for name in rec.names if name in place]
    theirs = reference.cameras.cam2world[[place[name] for name in shared]].double()
    ours = rec.cameras.cam2world[[rec.index(name) for name in shared]].double()
    to_ours = best_similarity(theirs, ours)
    if to_ours is None:
        return {}
    moved = to_ours.poses(reference.cameras.cam2world.double())
    return {name: moved[i] for name, i in place.items()}


def in_axes_of(scene: SplatMap, rec: Reconstruction, poses: dict[str, FirstPose]) -> dict[str, FirstPose]:
    """The reconstruction's poses in the axes and unit of the map, whose training cameras may have moved together."""
    to_map = axes_of_map(rec, scene.poses)
    if to_map is None:
        return poses
    return {name: replace(pose, cam2world=to_map.poses(pose.cam2world.double())) for name, pose in poses.items()}


def score_views(
    scene: SplatMap,
    rec: Reconstruction,
    frames: Frames,
    poses: dict[str, FirstPose],
    folder: Path,
    settings: PoseRefinementSettings | None = None,
    restore: RestoreSettings | None = None,
    progress: Progress = silent,
    truth: GroundTruth | None = None,
) -> list[HeldOutView]:
    """Refine, render and score each frame of `poses`; its images go to `folder` (`renders.write_view`).

    The clear ones look like the frames that `restore` made. A `truth` may say what moves.
    """
    perceptual = published_lpips()
    views, stems = [], view_stems(frames.names)
    surfaces = None if rec.moving is None else still_scene(rec, frames)
    to_map = axes_of_map(rec, scene.poses)
    style, coverage = display_style(scene, rec, restore), TrainingCoverage(rec)
    for done, (name, first) in enumerate(poses.items()):
        progress("scoring test frames", done, len(poses))
        f = frames.index(name)
        lens = lens_of(rec, frames, name)
        assert lens is not None, name  # `first_poses` leaves such frames out
        lens = replace(lens, cam2world=first.cam2world[None].to(lens.cam2world))
        time, image, mask = frames.frames[f].time, frames.image(f), frames.mask(f)
        if first.turn is not None:
            image = torch.from_numpy(at_half_time(image.numpy(), lens, first.turn)).clamp(0, 1)
            mask = torch.from_numpy(mask_at_half_time(mask.numpy(), lens, first.turn))
        lens = refine_pose(scene, lens, image, mask, settings, time=time).camera
        canvas = lens.drawn(scene.settings.long_side)
        window = visible_window(lens, canvas)
        target, seen = (part[window.rows, window.columns] for part in undistorted(image, mask, lens, canvas))
        camera = cut(canvas, window)
        out = scene.render(camera, time)
        write_view(folder, stems[name], out, camera, style)
        known, unturned = coverage.of(_in_axes_of_rec(camera, to_map)), _in_axes_of_rec(lens, to_map)
        found = None if surfaces is None else surfaces.moving_in(unturned, image, neighbors(rec, frames, name, 2))
        true = None if truth is None else truth.moving(name)
        quiet, unmoved = (
            None if moving is None else undistorted(image, mask & ~moving, lens, canvas)[1][window.rows, window.columns]
            for moving in (found, true)
        )
        told = seen & (known if out.observed is None else out.observed)
        shown = _in_colors_of(target, out.rgb, told if quiet is None else told & quiet, scene.colors)
        scores = view_scores(shown, target, perceptual, seen)
        covered = covered_scores(shown, target, seen, known if quiet is None else known & quiet)
        observed = observed_scores(shown, target, seen, out.observed)
        still, motion = still_scores(shown, target, seen, quiet), motion_scores(shown, target, seen, unmoved)
        views.append(HeldOutView(name, time, lens, canvas, window, first, scores, covered, observed, still, motion))
    progress("scoring test frames", len(poses), len(poses))
    return views


def _in_axes_of_rec(camera: Cameras, to_map: Similarity | None) -> Cameras:
    """A camera of the map where the reconstruction, whose points and depth have its own unit and axes, has it."""
    return camera if to_map is None else replace(camera, cam2world=to_map.inverse().poses(camera.cam2world.double()))


def _in_colors_of(
    target: Float[Tensor, "h w 3"],
    render: Float[Tensor, "h w 3"],
    told: Bool[Tensor, "h w"],
    colors: FrameColors | None,
) -> Float[Tensor, "h w 3"]:
    """A rendering as it is compared: each part in the colors that the other parts have where they are `told`.

    As it is where all frames were exposed alike.
    """
    if colors is None:
        return render
    return (recolored_by_halves if colors.shading is None else recolored_by_tiles)(render, target, told)


def protocol(views: Sequence[HeldOutView], settings: PoseRefinementSettings, colors: FrameColors | None) -> str:
    """In words, how the poses of the scored frames, and the colors they are compared in, came about."""
    if not views:
        return "every 8th frame; none could be placed"
    counts = Counter(view.first.source for view in views)
    starts = ", ".join(f"{count} from {source}" for source, count in counts.items())
    turned = "; rows rectified by the turn that the same matches tell" * any(v.first.turn is not None for v in views)
    fit = "; each half in colors fitted on the other half, as frames differ in exposure" if colors else ""
    if colors is not None and colors.shading is not None:
        fit += ", and in gains over the image: halves of a chessboard"
    by = "local differences of all pixels" if settings.pixels == "all" else "edges"
    return f"every 8th frame; poses {starts}, refined {settings.steps} steps on the frozen map by {by}{turned}{fit}"


def mean_scores(views: Sequence[HeldOutView]) -> dict[str, float | NotComputed]:
    """The scores averaged over frames, and their number, by the names of summary.json; of no frames, none is known."""
    if not views:
        nothing = NotComputed("none of the test frames could be placed")
        return {
            **dict.fromkeys((f.name for f in fields(ViewScores) if f.name not in ("views", "variant")), nothing),
            "views": 0,
            **not_computed(ObservedScores, nothing).summary(),
            **not_computed(CoveredScores, nothing).summary(),
            **not_computed(StillScores, nothing).summary(),
        }
    whole = mean_view_scores([view.scores for view in views])
    return {
        **{f.name: getattr(whole, f.name) for f in fields(whole) if f.name != "variant"},
        **mean_part([view.observed for view in views]).summary(),
        **mean_part([view.covered for view in views]).summary(),
        **mean_part([view.still for view in views]).summary(),
    }


@dataclass(frozen=True)
class Crop:
    """A rectangle of a canvas: rows and columns."""

    rows: slice
    columns: slice


def visible_window(lens: Cameras, canvas: Cameras) -> Crop:
    """The part of a lens's pinhole canvas that its image fills, cut straight."""
    shown = shown_pixels(lens, canvas)
    top, bottom, left, right = 0, canvas.height, 0, canvas.width
    while True:
        part = shown[top:bottom, left:right]
        # the side that misses the most of its length goes first; a hole inside is no matter of borders
        missing = [float((~edge).float().mean()) for edge in (part[0], part[-1], part[:, 0], part[:, -1])]
        worst = missing.index(max(missing))
        if missing[worst] == 0 or min(part.shape) <= 16:
            return Crop(slice(top, bottom), slice(left, right))
        top, bottom = top + (worst == 0), bottom - (worst == 1)
        left, right = left + (worst == 2), right - (worst == 3)


def cut(canvas: Cameras, window: Crop) -> Cameras:
    """The cameras of a window of a pinhole canvas."""
    K = canvas.K.clone()
    K[:, 0, 2] -= window.columns.start
    K[:, 1, 2] -= window.rows.start
    height, width = (part.stop - part.start for part in (window.rows, window.columns))
    return replace(canvas, K=K, width=width, height=height)


def published_lpips() -> Lpips | NotComputed:
    """LPIPS where its two weight files are on this computer, else how to get the first that is missing."""
    found = {name: weights.find(name) for name in ("vgg16", "lpips-vgg")}
    for name, path in found.items():
        if path is None:
            return NotComputed(f"the weights {name!r} are not on this computer (swimm3r weights get {name})")
    return load_lpips(found["vgg16"], found["lpips-vgg"])
