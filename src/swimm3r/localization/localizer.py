"""Placing an image in a map, by GS-CPR's protocol as the paper uses it (docs/derivations/localization.md).

1. retrieve    the references that look most like the query;
2. coarse      the query's matches with them, whose pixels have depth: PnP with RANSAC;
3. render      the map from there, with its water, and its depth;
4. match       the rendering with the query;
5. refine      the rendering's pixels as points of the world: PnP with RANSAC again.

A camera whose frames had their rows rectified (`sfm.rectified`) turned while they were exposed, and while a query was.
The coarse matches tell its pose together with its turn; the query is redrawn as at half time before anything is
compared with a rendering.

The renderer is whatever map there is. The refined pose stands where enough of its inliers agree and, unless GS-CPR's
own rule is asked for (`settings.accept`), where its standard error is smaller than that of the coarse one: a few dozen
loose matches with a poor rendering must not replace a pose that hundreds of pixels agree on.
"""

import math
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field, replace
from functools import lru_cache
from time import perf_counter
from typing import Any, Literal

import numpy as np
import torch
from jaxtyping import Bool, Float
from torch import Tensor

from swimm3r.cameras import Cameras, project
from swimm3r.errors import RegistrationError
from swimm3r.imaging.turned_rows import at_half_time, half_time_pixels, mask_at_half_time
from swimm3r.imaging.undistortion import undistorted
from swimm3r.localization.interpolation import lens_of
from swimm3r.localization.lenses import has_several_lenses, lens_at_size, unnamed_camera
from swimm3r.localization.matchers import Matcher, matcher_for
from swimm3r.localization.pose_covariance import pose_jacobian
from swimm3r.localization.references import FilmedReferences, Reference, References, RenderedReferences, rendered
from swimm3r.localization.settings import LocalizationSettings
from swimm3r.progress import Progress, silent
from swimm3r.scene.frames import Frames
from swimm3r.scene.reconstruction import Reconstruction
from swimm3r.sfm.colmap.absolute_pose import absolute_pose
from swimm3r.sfm.colmap.shutter.turning import turned_pose
from swimm3r.splat.rendering import SplatMap
from swimm3r.splat.training_poses import as_mapped, axes_of_map

STAGES = ("retrieve", "coarse", "render", "match", "refine")


@dataclass(frozen=True)
class Evidence:
    """The matches between the query and the rendering that the refined pose rests on."""

    query: Float[Tensor, "h w 3"]  # on the pinhole canvas of the rendering
    rendering: Float[Tensor, "h w 3"]
    xy_query: Float[Tensor, "m 2"]  # pixels of the canvas, centers at +0.5
    xy_rendering: Float[Tensor, "m 2"]
    inlier: Bool[Tensor, " m"]


@dataclass(frozen=True)
class Localization:
    """The pose of an image and the evidence for it."""

    cam2world: Float[Tensor, "4 4"]
    stage: Literal["coarse", "refined"]
    candidates: tuple[str, ...]  # references, the likest first
    coarse_inliers: int
    inliers: int  # of the refined pose; 0 where it was not found
    matches: int
    reprojection_px: float | None  # median over the inliers, pixels of the query; None without a refined pose
    evidence: Evidence | None
    seconds: dict[str, float] = field(default_factory=dict)  # by stage
    turn: Float[np.ndarray, "3"] | None = None  # radians, while rows were exposed; the pose is that of half time


@dataclass(frozen=True)
class _Solved:
    """Pixels of a query that show known points, and the pose that most of them agree on."""

    pixels: Float[Tensor, "m 2"]
    points: Float[Tensor, "m 3"]  # world
    camera: Cameras  # whose pixels they are; its pose unused
    max_error: float  # of an inlier, its pixels
    cam2world: Float[Tensor, "4 4"] | None  # None where too few agree
    inlier: Bool[Tensor, " m"]

    def errors(self, cam2world: Float[Tensor, "4 4"]) -> Float[Tensor, " m"]:
        """Distance of each pixel from its point seen from a pose; infinite for points behind the camera."""
        reprojected, z = project(replace(self.camera, cam2world=cam2world[None]), self.points[None])
        off = torch.linalg.vector_norm(reprojected[0] - self.pixels, dim=-1)
        return torch.where(z[0] > 0, off, torch.inf)

    def uncertainty(self, at: Float[Tensor, "k 3"]) -> float:
        """Pixels (root mean square) by which the pose's standard error moves the images of points.

        The covariance s^2 (J^T J)^-1 of least squares, s^2 from the inliers' own residuals; infinite without a pose.
        """
        if self.cam2world is None:
            return math.inf
        residuals = self.errors(self.cam2world)[self.inlier]
        J = pose_jacobian(self.camera, self.cam2world, self.points[self.inlier])
        variance = residuals.square().sum() / max(1, 2 * len(residuals) - 6)
        covariance = variance * torch.linalg.pinv(J.mT @ J, hermitian=True)
        moved = pose_jacobian(self.camera, self.cam2world, at)
        return float(torch.einsum("ij,jk,ik->i", moved, covariance, moved).sum().div(max(1, len(at))).sqrt())


class Localizer:
    """Places images in one map; what it learns of the references serves every query.

    Poses are in the axes and unit of the map, and so of `rec`, the reconstruction with the poses as the map's training
    left them; `in_axes_of_sfm` takes them back to those of structure from motion.
    """

    def __init__(
        self,
        scene: SplatMap,
        rec: Reconstruction,
        frames: Frames | None = None,
        settings: LocalizationSettings | None = None,
        matcher: Matcher | None = None,
        progress: Progress = silent,
    ) -> None:
        to_map, rec = axes_of_map(rec, scene.poses), as_mapped(rec, scene.poses)
        self.scene, self.rec, self.frames = scene, rec, frames
        self._to_sfm = None if to_map is None else to_map.inverse()
        self.settings = settings or LocalizationSettings()
        self.matcher = matcher or matcher_for(self.settings)
        self.long_side = self.settings.long_side or scene.settings.long_side
        self.references: References = (
            RenderedReferences(rec, scene, self.long_side, self.settings.min_alpha)
            if frames is None
            else FilmedReferences(rec, frames)
        )
        self._turning = frames is not None and frames.rows_rectified
        self._reference = lru_cache(maxsize=64)(self._described_reference)
        described: set[str] = set()

        def description(name: str) -> Any:
            described.add(name)
            progress("describing references", len(described), len(rec.names))
            return self._reference(name)[1]

        self._likeness = self.matcher.index(rec.names, description)

    def locate(
        self,
        image: Float[Tensor, "h w 3"],
        mask: Bool[Tensor, "h w"] | None = None,
        lens: Cameras | None = None,
        time: float | None = None,
        frame: str | None = None,
    ) -> Localization:
        """The pose of one image (0..1), taken through `lens` (its pose unused), by default the reconstruction's.

        A lens of images of another size is scaled. `frame` names an image of the clip, and so the camera of the rig
        that took it. `time`, seconds of the clip, matters to dynamic maps: it is the moment they are shown at, where it
        is known.

        Raises RegistrationError where too few matches agree on any pose, InputError where the image's shape is not
        that of its lens, or a rig has several lenses and neither `lens` nor `frame` is given.
        """
        s = self.settings
        height, width = image.shape[:2]
        mask = torch.ones(height, width, dtype=torch.bool) if mask is None else mask
        seconds: dict[str, float] = {stage: 0.0 for stage in STAGES}
        with _timed(seconds, "retrieve"):
            query = self.matcher.describe(image, mask)
            likest = torch.argsort(self._likeness(query), descending=True, stable=True)[: s.candidates].tolist()
            candidates = tuple(self.rec.names[k] for k in likest)
        turning = self._turning and lens is None
        lens = lens_at_size(self._own_lens(likest[0], frame) if lens is None else lens, width, height)
        with _timed(seconds, "coarse"):
            coarse = self._coarse(query, candidates, lens)
        if coarse.cam2world is None:
            raise RegistrationError(
                f"the image could not be placed: fewer than {s.min_inliers} of its matches agree on a pose",
                cause="it shows a place that the map does not, or too little of it, or through very different water",
                hint="an image from nearer to the dive's path, or more --candidates",
            )
        turn = None
        if turning:
            with _timed(seconds, "coarse"):
                coarse, turn = self._at_half_time(coarse)
                image = torch.from_numpy(at_half_time(image.numpy(), lens, turn)).clamp(0, 1)
                mask = torch.from_numpy(mask_at_half_time(mask.numpy(), lens, turn))
        assert coarse.cam2world is not None
        coarse_inliers = int(coarse.inlier.sum())
        best = Localization(coarse.cam2world, "coarse", candidates, coarse_inliers, 0, 0, None, None, seconds, turn)
        before = coarse
        for _ in range(s.rounds):
            there = replace(lens, cam2world=best.cam2world[None])
            solved, evidence = self._against_rendering(image, mask, there, time, seconds)
            best = replace(best, matches=len(solved.pixels), evidence=evidence)
            if solved.cam2world is None or not self._stands(solved, before):
                break
            before, per_pixel = solved, lens.width / solved.camera.width
            error = float(solved.errors(solved.cam2world)[solved.inlier].median()) * per_pixel
            best = replace(
                best,
                cam2world=solved.cam2world,
                stage="refined",
                inliers=int(solved.inlier.sum()),
                reprojection_px=error,
            )
        return best

    def _stands(self, refined: _Solved, before: _Solved) -> bool:
        """Return whether a refined pose takes the place of the pose before it."""
        if refined.cam2world is None or self.settings.accept == "inliers":
            return refined.cam2world is not None
        seen = torch.cat([before.points[before.inlier], refined.points[refined.inlier]])
        per_pixel = before.camera.width / refined.camera.width
        return refined.uncertainty(seen) * per_pixel < before.uncertainty(seen)

    def in_axes_of_sfm(self, cam2world: Float[Tensor, "4 4"]) -> Float[Tensor, "4 4"]:
        """A pose of the map where structure from motion has it: the map's training may have moved all cameras."""
        return cam2world if self._to_sfm is None else self._to_sfm.poses(cam2world.double())

    def _described_reference(self, name: str) -> tuple[Reference, Any]:
        reference = self.references[name]
        return reference, self.matcher.describe(reference.rgb, reference.usable)

    def _own_lens(self, nearest: int, frame: str | None) -> Cameras:
        """The lens of a frame of the clip, else that of the nearest reference."""
        if frame is not None and self.frames is not None:
            own = lens_of(self.rec, self.frames, frame)
            if own is None:
                raise RegistrationError(
                    f"{frame} could not be placed: its lens is not known",
                    cause="no frame of the camera that took it is registered, and the rig is not calibrated",
                    hint="swimm3r run with --rig-calibration, which states the lens of every camera",
                )
            return own
        if has_several_lenses(self.rec, self.frames):
            raise unnamed_camera()
        return self.rec.cameras[nearest]

    def _coarse(self, query: Any, candidates: tuple[str, ...], lens: Cameras) -> _Solved:
        """The query's matches with the references, whose pixels are points of the world."""
        pixels, points = [], []
        for name in candidates:
            reference, described = self._reference(name)
            xy_query, xy_reference = self.matcher.match(query, described)
            xyz, known = reference.points(xy_reference)
            pixels.append(xy_query[known])
            points.append(xyz)
        return self._solved(torch.cat(pixels), torch.cat(points), lens, self.settings.max_error)

    def _at_half_time(self, coarse: _Solved) -> tuple[_Solved, Float[np.ndarray, "3"]]:
        """The coarse matches as seen by a camera that does not turn within an exposure, and the turn that they tell."""
        assert coarse.cam2world is not None
        there = replace(coarse.camera, cam2world=coarse.cam2world[None])
        cam2world, turn = turned_pose(there, coarse.pixels[coarse.inlier], coarse.points[coarse.inlier])
        pixels = half_time_pixels(coarse.camera, coarse.pixels, turn)
        moved = replace(coarse, pixels=pixels, cam2world=cam2world)
        inlier = moved.errors(cam2world) <= coarse.max_error
        return replace(moved, inlier=inlier), turn

    def _against_rendering(
        self,
        image: Float[Tensor, "h w 3"],
        mask: Bool[Tensor, "h w"],
        lens: Cameras,
        time: float | None,
        seconds: dict[str, float],
    ) -> tuple[_Solved, Evidence]:
        """One round of rendering, matching and PnP from the pose of `lens`."""
        s = self.settings
        with _timed(seconds, "render"):
            reference = rendered(self.scene, lens, self.long_side, s.min_alpha, time)
        with _timed(seconds, "match"):
            canvas = lens.drawn(self.long_side)
            shown, usable = undistorted(image, mask, lens, canvas)
            xy_query, xy_rendering = self.matcher.match(
                self.matcher.describe(shown, usable), self.matcher.describe(reference.rgb, reference.usable)
            )
            size = torch.tensor([canvas.width, canvas.height])
            inner = ((xy_rendering > s.border) & (xy_rendering < size - s.border)).all(-1)
            xyz, known = reference.points(xy_rendering[inner])
            xy_query, xy_rendering = xy_query[inner][known], xy_rendering[inner][known]
        with _timed(seconds, "refine"):
            solved = self._solved(xy_query, xyz, canvas, s.max_error * canvas.width / lens.width)
        return solved, Evidence(shown, reference.rgb, xy_query, xy_rendering, solved.inlier)

    def _solved(
        self, pixels: Float[Tensor, "n 2"], points: Float[Tensor, "n 3"], camera: Cameras, max_error: float
    ) -> _Solved:
        """PnP with RANSAC where enough matches agree, and which do."""
        enough = len(pixels) >= self.settings.min_inliers
        estimate = absolute_pose(pixels, points, camera, max_error) if enough else None
        if estimate is None or int(estimate[1].sum()) < self.settings.min_inliers:
            return _Solved(pixels, points, camera, max_error, None, torch.zeros(len(pixels), dtype=torch.bool))
        return _Solved(pixels, points, camera, max_error, *estimate)


@contextmanager
def _timed(seconds: dict[str, float], stage: str) -> Iterator[None]:
    """Adds the time its block takes."""
    started = perf_counter()
    try:
        yield
    finally:
        seconds[stage] += perf_counter() - started
