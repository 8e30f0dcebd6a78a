"""Colors of surface points, blended from the frames that see them along seams that do not show.

    color = sum v_k low_k / sum v_k  +  sum w_k (image_k - low_k) / sum w_k,    v = s^2,  w = s^32

in two bands (Burt & Adelson 1983): low is the frame blurred, and changes from frame to frame over a wide margin, so
that no step in brightness is left; the detail comes from the best frame, so that nothing is doubled. The rank s of a
frame at a point is high from straight above, with small pixels on the ground, and in the middle of the frame. A frame
whose depth map shows something nearer does not see the point; one without depth there counts only where no other frame
does.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np
import torch
from jaxtyping import Float, Float32, Int64

from swimm3r.cameras import Cameras, project
from swimm3r.products.survey import Colors, Survey

_TOLERANCE = 0.03  # of the depth, between a point and the depth map of a frame that sees it
_UNCONFIRMED = 0.25  # rank of a frame that has no depth at a point: 4^32 times less detail than a confirmed one
_WIDE, _NARROW = 2, 32  # powers of the rank in the two bands
_BLUR = 0.03  # of the long side, standard deviation of the low band
_BLURRED = 8.0  # the same in pixels of the low band: between them, reading it linearly errs by 2e-4
_NEARNESS = 0.5, 2.0  # bounds of the usual pixel on the ground by that of a frame: a fish may be very near
_TAPER = 0.15  # of the short side: within it of the border, the rank falls to 0
_REACH = 0.3  # of the ground that a frame's depth map shows, beyond it, where the frame may show more
_LEAST_FACING = 0.05  # cosine between ray and normal below which a frame sees a surface too obliquely


@dataclass(frozen=True)
class Points:
    """Places on the surface, local; `normals` None: all face up."""

    xyz: Float[np.ndarray, "n 3"]
    normals: Float[np.ndarray, "n 3"] | None = None
    size: float = 0.0  # of the area that a point stands for; images with smaller pixels are averaged

    def select(self, which: np.ndarray) -> "Points":
        """Some of the points."""
        return Points(self.xyz[which], None if self.normals is None else self.normals[which], self.size)


@dataclass(frozen=True)
class Sight:
    """A frame's view of points."""

    column: Float32[np.ndarray, " n"]  # pixels of the frame; index coordinates
    row: Float32[np.ndarray, " n"]
    rank: Float32[np.ndarray, " n"]  # 0 where the frame does not see the point
    pixel: float  # size of a pixel at the points, local

    def select(self, which: np.ndarray) -> "Sight":
        """The view of some of the points."""
        return Sight(self.column[which], self.row[which], self.rank[which], self.pixel)


def blended(
    survey: Survey, points: Points, frames: Sequence[int], colors: Sequence[Colors]
) -> dict[Colors, Float32[np.ndarray, "n 3"]]:
    """The colors of points, 0..1 and NaN where no frame sees them, of each kind; frames are read one at a time."""
    sums: dict[Colors, _Sums] = {kind: _Sums.empty(len(points.xyz)) for kind in colors}
    for i in frames:
        (near,) = np.nonzero(_within_reach(survey, points, i))
        if not len(near):
            continue
        seen = sight(survey, points.select(near), i)
        kept = seen.rank > 0
        if not kept.any():
            continue
        seen, near = seen.select(kept), near[kept]
        for kind in colors:
            image = survey.image(kind, i)
            if image is not None:
                sums[kind].add(_scaled(image, points.size, seen.pixel), seen, near, survey.rec.cameras)
    return {kind: added.colors() for kind, added in sums.items()}


@dataclass(frozen=True)
class Shown:
    """Points as one frame shows them."""

    which: Int64[np.ndarray, " k"]  # indices of the points that it sees
    colors: Float32[np.ndarray, "k 3"]  # 0..1
    rank: Float32[np.ndarray, " k"]


def shown_by(survey: Survey, points: Points, i: int, kind: Colors) -> Shown | None:
    """The colors of the points that a frame sees, not blended with others'; None where it sees none."""
    (near,) = np.nonzero(_within_reach(survey, points, i))
    if not len(near):
        return None
    seen = sight(survey, points.select(near), i)
    kept = seen.rank > 0
    image = survey.image(kind, i) if kept.any() else None
    if image is None:
        return None
    seen, near = seen.select(kept), near[kept]
    image = _scaled(image, points.size, seen.pixel)
    return Shown(near, _sampled(image, seen, survey.rec.cameras, cv2.INTER_LINEAR), seen.rank)


def sight(survey: Survey, points: Points, i: int) -> Sight:
    """The pixels at which a frame sees points, and its rank there."""
    camera, center = survey.rec.cameras[i], survey.centers[i]
    world = survey.place.from_local(points.xyz)
    at, z = project(camera, torch.from_numpy(world)[None])
    pixels, depth = at[0].numpy() - 0.5, z[0].numpy() * survey.scale
    away = center - points.xyz
    distance = np.linalg.norm(away, axis=1)
    up = away[:, 2] if points.normals is None else (away * points.normals).sum(1)
    facing = up / np.maximum(distance, 1e-12)
    inside = (depth > 0) & (pixels >= 0).all(1) & (pixels <= np.array([camera.width - 1, camera.height - 1])).all(1)
    inside &= facing > _LEAST_FACING
    (kept,) = np.nonzero(inside)
    focal = float(torch.sqrt(camera.K[0, 0, 0] * camera.K[0, 1, 1]))
    rank = np.zeros(len(depth), np.float32)
    if len(kept):
        nearest = np.rint(pixels[kept]).astype(np.int64)
        border = np.minimum(pixels[kept], np.array([camera.width, camera.height]) - 1 - pixels[kept]).min(1)
        taper = np.clip((border + 0.5) / (_TAPER * min(camera.width, camera.height)), 0, 1)
        value = facing[kept] * np.clip(survey.footprint * focal / distance[kept], *_NEARNESS) * taper
        value *= _confirmed(survey, i, nearest, depth[kept])
        value *= survey.usable(i)[nearest[:, 1], nearest[:, 0]]
        rank[kept] = value
    pixel = float(np.median(depth[kept])) / focal if len(kept) else 0.0
    return Sight(pixels[:, 0].astype(np.float32), pixels[:, 1].astype(np.float32), rank, pixel)


def _within_reach(survey: Survey, points: Points, i: int) -> np.ndarray:
    """Mask of the points that lie above the ground that a frame shows, or close to it."""
    ground = survey.overview[i][:, :2]
    low, high = ground.min(0), ground.max(0)
    margin = _REACH * (high - low)
    return ((points.xyz[:, :2] >= low - margin) & (points.xyz[:, :2] <= high + margin)).all(1)


def _confirmed(survey: Survey, i: int, pixels: np.ndarray, depth: Float[np.ndarray, " n"]) -> Float[np.ndarray, " n"]:
    """1 where the depth map of a frame has the points, little where it is empty, 0 where it shows something else."""
    stored = survey.rec.depth[survey.rec.names[i]].z_depth.numpy()
    camera = survey.rec.cameras
    scale = np.array([stored.shape[1] / camera.width, stored.shape[0] / camera.height])
    column, row = ((pixels + 0.5) * scale).astype(np.int64).T
    found = stored[row, column] * survey.scale
    agrees = np.abs(found - depth) <= _TOLERANCE * depth
    return np.where(found <= 0, _UNCONFIRMED, np.where(agrees, 1.0, 0.0))


@dataclass
class _Sums:
    """Weighted sums of the two bands."""

    low: Float32[np.ndarray, "n 3"]
    low_weight: Float32[np.ndarray, " n"]
    detail: Float[np.ndarray, "n 3"]
    detail_weight: Float[np.ndarray, " n"]

    @staticmethod
    def empty(n: int) -> "_Sums":
        return _Sums(
            np.zeros((n, 3), np.float32), np.zeros(n, np.float32), np.zeros((n, 3), np.float64), np.zeros(n, np.float64)
        )

    def add(self, image: Float32[np.ndarray, "h w 3"], seen: Sight, which: np.ndarray, cameras: Cameras) -> None:
        """Add a frame's view of these points, with its image, which may be smaller than the frame."""
        low = _sampled(low_band(image), seen, cameras, cv2.INTER_LINEAR)
        detail = _sampled(image, seen, cameras, cv2.INTER_CUBIC) - low
        rank = seen.rank.astype(np.float64)
        wide, narrow = rank**_WIDE, rank**_NARROW + 1e-300
        self.low[which] += (wide[:, None] * low).astype(np.float32)
        self.low_weight[which] += wide.astype(np.float32)
        self.detail[which] += narrow[:, None] * detail
        self.detail_weight[which] += narrow

    def colors(self) -> Float32[np.ndarray, "n 3"]:
        """The blend; NaN where nothing was added."""
        with np.errstate(invalid="ignore", divide="ignore"):
            found = self.low / self.low_weight[:, None] + self.detail / self.detail_weight[:, None]
        return np.clip(found, 0, 1).astype(np.float32)


def _scaled(image: Float32[np.ndarray, "h w 3"], size: float, pixel: float) -> Float32[np.ndarray, "h2 w2 3"]:
    """The image with pixels about as large as the area that a point stands for, averaged, where its own are smaller."""
    scale = pixel / size if size > 0 else 1.0  # of the frame, whose image is of its size
    if scale >= 0.75:
        return image
    height, width = image.shape[:2]
    to = max(2, round(width * scale)), max(2, round(height * scale))
    return cv2.resize(image, to, interpolation=cv2.INTER_AREA)


def low_band(image: Float32[np.ndarray, "h w 3"]) -> Float32[np.ndarray, "h2 w2 3"]:
    """The image blurred, on as many pixels as a blurred image needs.

    Pixels are averaged first, and the variance of that is taken off the blur's, which then takes 1 % of the time for a
    large image.
    """
    height, width = image.shape[:2]
    std = max(_BLUR * max(height, width), 0.5)
    shrink = max(1.0, std / _BLURRED)
    size = max(2, round(width / shrink)), max(2, round(height / shrink))
    averaged = image if shrink == 1 else cv2.resize(image, size, interpolation=cv2.INTER_AREA)
    scale = averaged.shape[1] / width, averaged.shape[0] / height
    left = [math.sqrt((std * each) ** 2 - (1 - each**2) / 12) for each in scale]
    return cv2.GaussianBlur(averaged, (0, 0), left[0], sigmaY=left[1], borderType=cv2.BORDER_REFLECT)


def _sampled(image: np.ndarray, seen: Sight, cameras: Cameras, how: int) -> Float32[np.ndarray, "n 3"]:
    """An image of frames, of their size or smaller, at scattered places.

    OpenCV wants maps with fewer than 32768 rows and columns.
    """
    scale = image.shape[1] / cameras.width, image.shape[0] / cameras.height
    places = [(at + 0.5) * each - 0.5 for at, each in zip((seen.column, seen.row), scale, strict=True)]
    n, wide = len(places[0]), 16_384
    maps = [np.pad(at, (0, -n % wide), mode="edge").reshape(-1, wide).astype(np.float32) for at in places]
    found = cv2.remap(image, maps[0], maps[1], how, borderMode=cv2.BORDER_REPLICATE)
    return found.reshape(-1, 3)[:n]
