"""Views of two visits' maps by the same camera: frames of the earlier visit at the largest changed places."""

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
from jaxtyping import Float, UInt8

from swimm3r.cameras import Cameras
from swimm3r.products.survey import Survey
from swimm3r.progress import Progress
from swimm3r.scene.reconstruction import Reconstruction
from swimm3r.scene.run_folder import MARKERS
from swimm3r.splat.map_file import load_map
from swimm3r.splat.training_poses import axes_of_map
from swimm3r.visits.adjustment import similarity
from swimm3r.visits.color import linear, shown
from swimm3r.visits.misfit import Fit
from swimm3r.visits.places import Place

_VIEWS = 3
_LONG_SIDE = 640

Mapped = tuple[Path, Reconstruction, Fit | None, Float[np.ndarray, "3"]]
"""A run, its reconstruction in its own axes, its fit onto the first visit, and factors on its linear colors."""


def rendered_views(
    survey: Survey, runs: tuple[Mapped, Mapped], places: Sequence[Place], progress: Progress
) -> list[tuple[str, UInt8[np.ndarray, "h w 3"], UInt8[np.ndarray, "h w 3"]]]:
    """Captions with what both maps show, without the water, to cameras of the earlier visit (`survey`).

    None where a run has no map, or nothing has changed.
    """
    if not places or not all((run / MARKERS["splat"]).is_file() for run, *_ in runs):
        return []
    frames = _frames_at(survey, places)
    cameras = [survey.rec.cameras[i].pinhole(_LONG_SIDE) for i in frames]
    found = []
    for done, mapped in enumerate(runs):
        progress("rendering both maps", done, len(runs))
        found.append(_rendered(mapped, cameras))
    progress("rendering both maps", len(runs), len(runs))
    return [(f"Both maps from {survey.rec.names[i]}", *views) for i, *views in zip(frames, *found, strict=True)]


def _frames_at(survey: Survey, places: Sequence[Place]) -> list[int]:
    """For each of the largest places the frame whose view has it nearest to its middle."""
    frames = sorted(survey.overview)
    middle = np.stack([np.median(survey.overview[i][:, :2], axis=0) for i in frames])
    chosen: list[int] = []
    for place in places:
        at = (np.array([place.x, place.y]) - np.array(survey.place.origin[:2])) / survey.place.grid_scale
        frame = frames[int(np.linalg.norm(middle - at, axis=1).argmin())]
        if frame not in chosen:
            chosen.append(frame)
        if len(chosen) == _VIEWS:
            break
    return chosen


def _rendered(mapped: Mapped, cameras: Sequence[Cameras]) -> list[UInt8[np.ndarray, "h w 3"]]:
    """Views of a map by cameras of the common frame, without the water, in the light of the first visit."""
    run, own, fit, factors = mapped
    scene = load_map(run / MARKERS["splat"])
    to_map = axes_of_map(own, scene.poses)
    views = []
    for camera in cameras:
        poses = camera.cam2world.double()
        if fit is not None:
            poses = similarity(fit.alignment.a_from_b).inverse().poses(poses)
        if to_map is not None:
            poses = to_map.poses(poses)
        middle = sum(scene.span) / 2  # of a dynamic map's clip
        clear = scene.render(replace(camera, cam2world=poses.to(camera.cam2world)), middle).clear.clamp(0, 1)
        views.append((255 * shown(linear(clear.float().numpy()) * factors)).round().astype(np.uint8))
    return views
