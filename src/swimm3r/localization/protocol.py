"""Placing a picture in a map, by GS-CPR's protocol as the paper uses it (metrics.md 11).

1. retrieve    the references that look most like the query;
2. coarse      the query's matches with them, whose pixels have depth: PnP with RANSAC;
3. render      the map from there, with its water, and its depth;
4. match       the rendering with the query;
5. refine      the rendering's pixels as points of the world: PnP with RANSAC again.

The renderer is whatever map there is; where the last step finds too few inliers, the coarse pose stands.
"""

from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field, replace
from functools import lru_cache
from time import perf_counter
from typing import Any, Literal

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from swimm3r.cameras import Cameras, project, resized
from swimm3r.errors import InputError, RegistrationError
from swimm3r.frames import Frames
from swimm3r.localization.matchers import Matcher, matcher_for
from swimm3r.localization.references import FilmedReferences, Reference, References, RenderedReferences, rendered
from swimm3r.localization.settings import LocalizationSettings
from swimm3r.reconstruction import Reconstruction
from swimm3r.sfm.colmap import absolute_pose
from swimm3r.splat.pose_codes import as_mapped
from swimm3r.splat.rendering import SplatMap
from swimm3r.splat.views import pinhole_canvas, undistorted

_Pose = tuple[Tensor, int]  # cam2world [4, 4], inliers
STAGES = ("retrieve", "coarse", "render", "match", "refine")


@dataclass(frozen=True)
class Evidence:
    """The matches between the query and the rendering that the refined pose rests on."""

    query: Float[Tensor, "h w 3"]  # on the pinhole canvas of the rendering
    rendering: Float[Tensor, "h w 3"]
    xy_query: Float[Tensor, "m 2"]  # pixels of the canvas, centres at +0.5
    xy_rendering: Float[Tensor, "m 2"]
    inlier: Bool[Tensor, " m"]


@dataclass(frozen=True)
class Localization:
    """Where a picture was taken, and why that is believed."""

    cam2world: Float[Tensor, "4 4"]
    stage: Literal["coarse", "refined"]
    candidates: tuple[str, ...]  # references, the likest first
    coarse_inliers: int
    inliers: int  # of the refined pose; 0 where it was not found
    matches: int
    reprojection_px: float | None  # median over the inliers, pixels of the query; None without a refined pose
    evidence: Evidence | None
    seconds: dict[str, float] = field(default_factory=dict)  # by stage


class Localizer:
    """Places pictures in one map; what it learns of the references serves every query."""

    def __init__(
        self,
        scene: SplatMap,
        rec: Reconstruction,
        frames: Frames | None = None,
        settings: LocalizationSettings | None = None,
        matcher: Matcher | None = None,
    ) -> None:
        rec = as_mapped(rec, scene.poses)
        self.scene, self.rec = scene, rec
        self.settings = settings or LocalizationSettings()
        self.matcher = matcher or matcher_for(self.settings)
        self.long_side = self.settings.long_side or scene.settings.long_side
        self.references: References = (
            RenderedReferences(rec, scene, self.long_side, self.settings.min_alpha)
            if frames is None
            else FilmedReferences(rec, frames)
        )
        self._reference = lru_cache(maxsize=64)(self._described_reference)
        self._likeness = self.matcher.index(rec.names, lambda name: self._reference(name)[1])

    def locate(
        self,
        picture: Float[Tensor, "h w 3"],
        mask: Bool[Tensor, "h w"] | None = None,
        lens: Cameras | None = None,
        time: float | None = None,
    ) -> Localization:
        """The pose of one picture (0..1), taken through `lens` (its pose unused), by default the reconstruction's.

        `time`, seconds of the clip, matters to dynamic maps: it is the moment they are shown at, where it is known.

        Raises RegistrationError where too few matches agree on any pose, InputError where the picture's shape is not
        that of the reconstruction's frames and no lens is given.
        """
        s = self.settings
        height, width = picture.shape[:2]
        mask = torch.ones(height, width, dtype=torch.bool) if mask is None else mask
        seconds: dict[str, float] = {stage: 0.0 for stage in STAGES}
        with _timed(seconds, "retrieve"):
            query = self.matcher.describe(picture, mask)
            likest = torch.argsort(self._likeness(query), descending=True, stable=True)[: s.candidates].tolist()
            candidates = tuple(self.rec.names[k] for k in likest)
        lens = self._own_lens(likest[0], width, height) if lens is None else lens
        with _timed(seconds, "coarse"):
            found = self._coarse(query, candidates, lens)
        if found is None:
            raise RegistrationError(
                f"the picture could not be placed: fewer than {s.min_inliers} of its matches agree on a pose",
                cause="it shows a place that the map does not, or too little of it, or through very different water",
                hint="a picture from nearer to the dive's path, or more --settings.candidates",
            )
        pose, coarse_inliers = found
        best = Localization(pose, "coarse", candidates, coarse_inliers, 0, 0, None, None, seconds)
        for _ in range(s.rounds):
            refined = self._refined(picture, mask, replace(lens, cam2world=best.cam2world[None]), time, seconds)
            best = replace(best, matches=refined.matches, evidence=refined.evidence)
            if refined.inliers < s.min_inliers:
                break
            best = replace(refined, candidates=candidates, coarse_inliers=coarse_inliers, seconds=seconds)
        return best

    def _described_reference(self, name: str) -> tuple[Reference, Any]:
        reference = self.references[name]
        return reference, self.matcher.describe(reference.rgb, reference.usable)

    def _own_lens(self, nearest: int, width: int, height: int) -> Cameras:
        """The lens of the nearest reference, for a picture of this size."""
        lens = self.rec.cameras[nearest]
        if abs(width / height - lens.width / lens.height) > 0.01 * lens.width / lens.height:
            raise InputError(
                f"the picture is {width} x {height}, the map's frames are {lens.width} x {lens.height}: another lens",
                cause="it comes from another camera, or was cropped or turned",
                hint="its own lens: --lens with a cameras.json that has it",
            )
        return resized(lens, width, height)

    def _coarse(
        self, query: Any, candidates: tuple[str, ...], lens: Cameras
    ) -> tuple[Float[Tensor, "4 4"], int] | None:
        pixels, points = [], []
        for name in candidates:
            reference, described = self._reference(name)
            xy_query, xy_reference = self.matcher.match(query, described)
            xyz, known = reference.points(xy_reference)
            pixels.append(xy_query[known])
            points.append(xyz)
        return self._pose(torch.cat(pixels), torch.cat(points), lens, self.settings.max_error)[0]

    def _refined(
        self,
        picture: Float[Tensor, "h w 3"],
        mask: Bool[Tensor, "h w"],
        lens: Cameras,
        time: float | None,
        seconds: dict[str, float],
    ) -> Localization:
        """One round of rendering, matching and PnP from the pose of `lens`."""
        s = self.settings
        with _timed(seconds, "render"):
            reference = rendered(self.scene, lens, self.long_side, s.min_alpha, time)
        with _timed(seconds, "match"):
            canvas = pinhole_canvas(lens, self.long_side)
            shown, usable = undistorted(picture, mask, lens, canvas)
            xy_query, xy_rendering = self.matcher.match(
                self.matcher.describe(shown, usable), self.matcher.describe(reference.rgb, reference.usable)
            )
            size = torch.tensor([canvas.width, canvas.height])
            inner = ((xy_rendering > s.border) & (xy_rendering < size - s.border)).all(-1)
            xyz, known = reference.points(xy_rendering[inner])
            xy_query, xy_rendering = xy_query[inner][known], xy_rendering[inner][known]
        with _timed(seconds, "refine"):
            per_canvas_pixel = lens.width / canvas.width
            found, inlier = self._pose(xy_query, xyz, canvas, s.max_error / per_canvas_pixel)
        evidence = Evidence(shown, reference.rgb, xy_query, xy_rendering, inlier)
        if found is None:
            return Localization(lens.cam2world[0], "coarse", (), 0, 0, len(xyz), None, evidence)
        pose, count = found
        reprojected = project(replace(canvas, cam2world=pose[None]), xyz[inlier][None])[0][0]
        error = torch.linalg.vector_norm(reprojected - xy_query[inlier], dim=-1).median() * per_canvas_pixel
        return Localization(pose, "refined", (), 0, count, len(xyz), float(error), evidence)

    def _pose(
        self, pixels: Float[Tensor, "n 2"], points: Float[Tensor, "n 3"], lens: Cameras, max_error: float
    ) -> tuple[_Pose | None, Bool[Tensor, " n"]]:
        """PnP with RANSAC where enough matches agree, and which do."""
        nothing = torch.zeros(len(pixels), dtype=torch.bool)
        if len(pixels) < self.settings.min_inliers:
            return None, nothing
        estimate = absolute_pose(pixels, points, lens, max_error)
        if estimate is None or int(estimate[1].sum()) < self.settings.min_inliers:
            return None, nothing
        return (estimate[0], int(estimate[1].sum())), estimate[1]


@contextmanager
def _timed(seconds: dict[str, float], stage: str) -> Iterator[None]:
    """Adds the time its block takes."""
    started = perf_counter()
    try:
        yield
    finally:
        seconds[stage] += perf_counter() - started
