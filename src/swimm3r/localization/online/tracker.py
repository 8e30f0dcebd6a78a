"""A camera tracked in a map of landmarks, one image after another.

1. predict     the last two poses carried on to the image's time;
2. match       landmarks that should be visible with keypoints within a radius of where they should be;
3. solve       PnP with RANSAC, then once more with all landmarks near their pixels from there;
4. judge       inliers, their share, the pose's covariance and the motion since the last pose;
5. relocalize  where no pose stands: the map frames that look most like the image, all their landmarks, and from 3 on.

An image is lost unless a pose passes every test of step 4. No map is rendered. Of a camera that turned while it exposed
the map's frames (`sfm.rectified`), each pose is told together with the turn within the exposure, from the inliers of
PnP, and is that of half time.
"""

import math
from dataclasses import dataclass, replace
from typing import Literal

import numpy as np
import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from swimm3r.cameras import Cameras, project
from swimm3r.geometry import rotation_angle
from swimm3r.imaging.turned_rows import half_time_pixels
from swimm3r.io.colmap.model import silence_log
from swimm3r.localization.interpolation import between
from swimm3r.localization.lenses import lens_at_size, unnamed_camera
from swimm3r.localization.online.landmark_map import LandmarkMap
from swimm3r.localization.pose_covariance import pose_covariance
from swimm3r.localization.settings import TrackingSettings
from swimm3r.sfm.colmap.absolute_pose import absolute_pose
from swimm3r.sfm.colmap.shutter.turning import turned_pose
from swimm3r.sfm.features.settings import FeatureSettings
from swimm3r.sfm.features.sift import extract_features, match_descriptors, match_nearby, unit_descriptors

Status = Literal["tracked", "relocalized", "lost"]

_RETRIEVED = 5  # map frames that a lost image is matched with
_MAX_RATIO = 0.85  # of descriptors, where the place already tells most candidates apart
_NEAR_ENOUGH = 2.0  # times the agreement: radius of the second matching
_LEAST_STEP = 0.2  # seconds that pass between two images at least, whatever their stamps
_SLACK = 0.05, 5.0  # median distances and degrees: errors of two poses and jerks between them


@dataclass(frozen=True)
class TrackedPose:
    """The answer to one image: a pose and what speaks for it, or that there is none."""

    status: Status
    cam2world: Float[Tensor, "4 4"] | None  # None where lost
    covariance: Float[Tensor, "6 6"] | None  # as `pose_covariance`
    inliers: int
    matches: int
    reason: str = ""  # why the image is lost
    turn: Float[np.ndarray, "3"] | None = None  # radians, while rows were exposed; the pose is that of half time


@dataclass(frozen=True)
class Keypoints:
    """The keypoints of an image."""

    xy: Float[Tensor, "n 2"]  # pixels, as filmed
    descriptors: Float[Tensor, "n 128"]  # of unit length
    lens: Cameras  # of the image; its pose unused
    turning: bool = False  # the camera may have turned while rows were exposed

    def at_half_time(self, turn: Float[np.ndarray, "3"] | None) -> Float[Tensor, "n 2"]:
        """Their pixels in an image exposed at once."""
        return self.xy if turn is None else half_time_pixels(self.lens, self.xy, turn)


@dataclass(frozen=True)
class _Pose:
    cam2world: Float[Tensor, "4 4"]
    turn: Float[np.ndarray, "3"] | None  # None of an image that was exposed at once
    inlier: Bool[Tensor, " m"]


@dataclass(frozen=True)
class _Matched:
    """Keypoints and the points that they show."""

    keypoint: Int[Tensor, " m"]
    points: Float[Tensor, "m 3"]  # world
    visible: int = 0  # landmarks that the camera should see


@dataclass(frozen=True)
class _Estimate:
    cam2world: Float[Tensor, "4 4"]
    turn: Float[np.ndarray, "3"] | None
    covariance: Float[Tensor, "6 6"]
    inliers: int
    matches: int
    most: int  # landmarks in view, or keypoints where they are fewer


@dataclass(frozen=True)
class _Known:
    time: float
    cam2world: Float[Tensor, "4 4"]


class Tracker:
    """Places the images of one camera, in the order they were taken; poses are in the axes and unit of the map."""

    def __init__(self, landmarks: LandmarkMap, settings: TrackingSettings | None = None) -> None:
        silence_log()
        self.map, self.settings = landmarks, settings or TrackingSettings()
        s = self.settings
        self._features = replace(FeatureSettings(), count=s.keypoints, long_side=s.image_side)
        self._last: _Known | None = None  # the last pose that was believed
        self._before: _Known | None = None  # the one before, where tracking did not break off between

    def describe(
        self, image: Float[Tensor, "h w 3"], mask: Bool[Tensor, "h w"] | None = None, lens: Cameras | None = None
    ) -> Keypoints:
        """The keypoints of an image (0..1) taken through `lens`, by default that of the map; no state is touched.

        Where the map is of rectified frames, an image without a `lens` may be as the camera takes it, and has no mask.
        Raises InputError where the image's shape is not that of its lens, or the map is of several lenses and none is
        given.
        """
        if lens is None and mask is None and self.map.rectification is not None:
            image = torch.from_numpy(self.map.rectification.any_image(image.numpy()))
        height, width = image.shape[:2]
        turning = self.map.rows_rectified and lens is None
        if lens is None and self.map.several_lenses:
            raise unnamed_camera()
        lens = lens_at_size(self.map.cameras[0] if lens is None else lens, width, height)
        usable = torch.ones(height, width, dtype=torch.bool) if mask is None else mask
        found = extract_features(image, usable, self._features, upsample=False)
        xy = torch.from_numpy(found.keypoints[:, :2]).double()
        return Keypoints(xy, unit_descriptors(found.descriptors), lens, turning)

    def locate(self, seen: Keypoints, time: float) -> TrackedPose:
        """The pose of the next image, taken at `time`, seconds, by what `describe` found in it."""
        estimate, status = (None if self._last is None else self._tracked(seen, time)), "tracked"
        if estimate is None or self._fault(estimate, time):
            estimate, status = self._relocalized(seen), "relocalized"
        reason = "no landmarks agree on a pose" if estimate is None else self._fault(estimate, time)
        if estimate is None or reason:
            self._before = None
            counts = (0, 0) if estimate is None else (estimate.inliers, estimate.matches)
            return TrackedPose("lost", None, None, *counts, reason)
        self._before = self._last if status == "tracked" else None
        self._last = _Known(time, estimate.cam2world)
        counts = (estimate.inliers, estimate.matches)
        return TrackedPose(status, estimate.cam2world, estimate.covariance, *counts, turn=estimate.turn)

    def _predicted(self, time: float) -> Float[Tensor, "4 4"]:
        """The last pose carried on at the speed and turn rate between the last two."""
        assert self._last is not None
        if self._before is None or self._last.time <= self._before.time:
            return self._last.cam2world
        share = (time - self._before.time) / (self._last.time - self._before.time)
        return between(self._before.cam2world, self._last.cam2world, share)

    def _tracked(self, seen: Keypoints, time: float) -> _Estimate | None:
        """From the landmarks near where the predicted pose sees them."""
        camera = replace(seen.lens, cam2world=self._predicted(time)[None])
        radius = self.settings.radius * max(camera.width, camera.height)
        return self._solved(seen, self._matches(seen, seen.xy, camera, radius))

    def _relocalized(self, seen: Keypoints) -> _Estimate | None:
        """From the landmarks of the map frames that look most like the image, wherever they are."""
        found = []
        for frame in self.map.alike(seen.descriptors, _RETRIEVED):
            rows = self.map.of_frame(frame)
            pairs = match_descriptors(seen.descriptors, self.map.described(rows), self._features.max_ratio)
            found.append(torch.stack([pairs[:, 0], self.map.point[rows[pairs[:, 1]]]], -1))
        if not found:
            return None
        keypoint, point = torch.cat(found).unbind(-1)
        shown = torch.cat([seen.xy[keypoint], point[:, None]], -1).numpy()
        once = torch.from_numpy(np.unique(shown, axis=0, return_index=True)[1])  # a point that several frames saw
        return self._solved(seen, _Matched(keypoint[once], self.map.xyz[point[once]]))

    def _solved(self, seen: Keypoints, matched: _Matched) -> _Estimate | None:
        """The pose that most matches agree on, then that of all landmarks near their pixels from there."""
        first = self._pose(seen, seen.xy, matched)
        if first is None:
            return None
        camera = replace(seen.lens, cam2world=first.cam2world[None])
        upright = seen.at_half_time(first.turn)
        matched = self._matches(seen, upright, camera, _NEAR_ENOUGH * self._agreement(camera))
        final = self._pose(seen, upright, matched)
        if final is None:
            return None
        pixels, points = seen.xy[matched.keypoint[final.inlier]], matched.points[final.inlier]
        covariance = pose_covariance(camera, final.cam2world, points, pixels, final.turn)
        most = min(matched.visible, len(seen.xy))
        return _Estimate(final.cam2world, final.turn, covariance, len(points), len(matched.keypoint), most)

    def _pose(self, seen: Keypoints, xy: Float[Tensor, "n 2"], matched: _Matched) -> _Pose | None:
        """The pose that most matches agree on where keypoints are at `xy`, and the turn that these tell."""
        least = self.settings.least_inliers
        if len(matched.keypoint) < least:
            return None
        found = absolute_pose(xy[matched.keypoint], matched.points, seen.lens, self._agreement(seen.lens))
        if found is None:
            return None
        cam2world, inlier = found
        if not seen.turning or int(inlier.sum()) < least:
            return _Pose(cam2world, None, inlier)
        there = replace(seen.lens, cam2world=cam2world[None])
        return _Pose(*turned_pose(there, seen.xy[matched.keypoint[inlier]], matched.points[inlier]), inlier)

    def _matches(self, seen: Keypoints, xy: Float[Tensor, "n 2"], camera: Cameras, radius: float) -> _Matched:
        """Keypoints, taken to be at `xy`, and the landmarks within `radius` of which the camera sees them."""
        rows = self.map.visible(camera, self.settings.map_frames)
        points = self.map.xyz[self.map.point[rows]]
        there = project(camera, points[None])[0][0]
        pairs = match_nearby(self.map.described(rows), seen.descriptors, there, xy, radius, _MAX_RATIO)
        return _Matched(pairs[:, 1], points[pairs[:, 0]], len(rows))

    def _agreement(self, camera: Cameras) -> float:
        """Largest reprojection error of an inlier, in pixels of the image."""
        return self.settings.agreement * max(1.0, max(camera.width, camera.height) / self.settings.image_side)

    def _fault(self, found: _Estimate, time: float) -> str:
        """The fault by which an estimate is no pose; empty where it is one."""
        s = self.settings
        if found.inliers < s.least_inliers:
            return f"{found.inliers} landmarks agree on a pose, fewer than {s.least_inliers}"
        if found.inliers < s.least_share * found.matches:
            return f"only {found.inliers} of {found.matches} matches agree on a pose"
        if found.inliers < s.least_seen * found.most:
            return f"only {found.inliers} of {found.most} keypoints or landmarks in view agree on the pose"
        variance = found.covariance.diagonal()
        shift, turn = float(variance[:3].sum().sqrt()), math.degrees(float(variance[3:].sum().sqrt()))
        if not shift <= s.most_shift_error * self.map.distance:
            return f"the standard error of the camera's place is {shift / self.map.distance:.1%} of the distance"
        if not turn <= s.most_turn_error:
            return f"the standard error of the camera's direction is {turn:.2g} degrees"
        return self._leap(found, time)

    def _leap(self, found: _Estimate, time: float) -> str:
        """The fault of a motion that no camera makes since the last pose; empty where one may."""
        if self._last is None:
            return ""
        s, seconds = self.settings, max(_LEAST_STEP, abs(time - self._last.time))
        shift = float((found.cam2world[:3, 3] - self._last.cam2world[:3, 3]).norm()) / self.map.distance
        turn = math.degrees(float(rotation_angle(self._last.cam2world[:3, :3].mT @ found.cam2world[:3, :3])))
        if shift > s.most_speed * seconds + _SLACK[0]:
            return f"the pose lies {shift:.2g} median distances from the last one, {seconds:.2g} s before"
        if turn > s.most_turn_rate * seconds + _SLACK[1]:
            return f"the pose is turned by {turn:.0f} degrees from the last one, {seconds:.2g} s before"
        return ""
