"""Views of two visits' maps by the same camera: frames of the earlier visit at the largest changed places."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from jaxtyping import Float, UInt8

from swimm3r.cameras import Cameras
from swimm3r.products.survey import Survey
from swimm3r.progress import Progress
from swimm3r.scene.reconstruction import Reconstruction
from swimm3r.scene.run_folder import MARKERS
from swimm3r.sim3 import Sim3
from swimm3r.splat.map_file import load_map
from swimm3r.splat.training_poses import axes_of_map
from swimm3r.visits.alignment.joint import similarity
from swimm3r.visits.color import linear, shown
from swimm3r.visits.places import Place

_VIEWS = 3
_LONG_SIDE = 640


@dataclass(frozen=True)
class Mapped:
    """A run whose map may be rendered."""

    run: Path
    own: Reconstruction  # in its own axes
    first_from_own: Sim3
    factors: Float[np.ndarray, "3"]  # on its linear colors, into the light of the first visit


def rendered_views(
    survey: Survey, runs: Sequence[Mapped], places: Sequence[Place], progress: Progress
) -> list[tuple[str, UInt8[np.ndarray, "h w 3"], UInt8[np.ndarray, "h w 3"]]]:
    """Captions with what both maps show, without the water, to cameras of the earlier visit (`survey`).

    None where a run has no map, or nothing has changed.
    """
    if not places or not all((run / MARKERS["splat"]).is_file() for run in (each.run for each in runs)):
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
    scene = load_map(mapped.run / MARKERS["splat"])
    to_own, to_map = similarity(mapped.first_from_own.inverse()), axes_of_map(mapped.own, scene.poses)
    views = []
    for camera in cameras:
        poses = to_own.poses(camera.cam2world.double())
        if to_map is not None:
            poses = to_map.poses(poses)
        middle = sum(scene.span) / 2  # of a dynamic map's clip
        clear = scene.render(
            replace(camera, cam2world=poses.to(camera.cam2world)), middle, backscatter=False, observed=False
        ).clear.clamp(0, 1)
        views.append((255 * shown(linear(clear.float().numpy()) * mapped.factors)).round().astype(np.uint8))
    return views
