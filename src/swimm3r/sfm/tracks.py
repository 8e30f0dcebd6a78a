"""Tracks from two-view matches: pixels of many frames that are joined by matches show one point.

Matches are edges between (frame, pixel) nodes; a track is a connected component (union-find), with one pixel per frame:
where a chain of matches comes back to a frame at another pixel, the more confident one stays. Before and after, what
does not reproject within a bound is dropped: a single wrong match would join two points.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Bool, Float, Int64
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components
from torch import Tensor

from swimm3r.cameras import Cameras, project, rows_of_frames
from swimm3r.scene.frames import Frames
from swimm3r.scene.reconstruction import Points, Tracks


@dataclass(frozen=True)
class FrameMatches:
    """Matches of all pairs of frames, one row each."""

    i: Int64[Tensor, " m"]
    j: Int64[Tensor, " m"]
    xy_i: Int64[Tensor, "m 2"]  # whole pixels
    xy_j: Int64[Tensor, "m 2"]
    confidence: Float[Tensor, " m"]
    xyz: Float[Tensor, "m 3"]  # where an alignment puts the point

    def __len__(self) -> int:
        return len(self.i)

    def select(self, rows: Tensor) -> "FrameMatches":
        """Some of the matches."""
        return FrameMatches(*(value[rows] for value in vars(self).values()))


@dataclass(frozen=True)
class MatchTracks:
    """p points and their o observations, at most one per frame; observations of one point stand together."""

    xyz: Float[Tensor, "p 3"]
    point: Int64[Tensor, " o"]
    frame: Int64[Tensor, " o"]
    xy: Int64[Tensor, "o 2"]


def reprojection_errors(
    cameras: Cameras, frame: Int64[Tensor, " m"], xy: Float[Tensor, "m 2"], xyz: Float[Tensor, "m 3"]
) -> Float[Tensor, " m"]:
    """Pixels between observations and the projections of their points, each in its own camera; infinite behind it."""
    order = torch.argsort(frame, stable=True)
    bounds = torch.searchsorted(frame[order], torch.arange(len(cameras) + 1))
    errors = torch.full((len(frame),), torch.inf, dtype=torch.float64)
    for k in range(len(cameras)):
        rows = order[bounds[k] : bounds[k + 1]]
        uv, z = project(cameras[k], xyz[rows].double()[None])
        distance = torch.linalg.vector_norm(uv[0] - xy[rows].double(), dim=-1)
        errors[rows] = torch.where(z[0] > 0, distance, torch.inf)
    return errors


def consistent(matches: FrameMatches, cameras: Cameras, max_error: float) -> Bool[Tensor, " m"]:
    """Mask of matches within `max_error` of their point in both frames; cameras are of the matches' pixel grid."""
    ends = ((matches.i, matches.xy_i), (matches.j, matches.xy_j))
    errors = [reprojection_errors(cameras, frame, xy + 0.5, matches.xyz) for frame, xy in ends]
    return torch.maximum(*errors) <= max_error


def join(matches: FrameMatches, width: int, height: int) -> MatchTracks:
    """The connected components of matches over images of one size."""
    pixels = width * height
    ends = [
        f * pixels + xy[:, 1] * width + xy[:, 0] for f, xy in ((matches.i, matches.xy_i), (matches.j, matches.xy_j))
    ]
    nodes, index = torch.unique(torch.cat(ends), return_inverse=True)
    first, second = index.unflatten(0, (2, -1)).numpy()
    graph = coo_array((np.ones(len(first), np.int8), (first, second)), shape=(len(nodes), len(nodes)))
    count, label = connected_components(graph, directed=False)
    track = torch.from_numpy(label.astype(np.int64))
    weight = matches.confidence.double().clamp(min=1e-6)
    best = torch.zeros(len(nodes), dtype=torch.float64)
    best.scatter_reduce_(0, index, weight.repeat(2), "amax")
    total = torch.zeros(count, dtype=torch.float64).index_add_(0, track[index[: len(matches)]], weight)
    xyz = torch.zeros(count, 3, dtype=torch.float64)
    xyz.index_add_(0, track[index[: len(matches)]], matches.xyz.double() * weight[:, None])
    frame = nodes // pixels
    # by track, then frame, then confidence downwards: the first of each (track, frame) stays
    order = torch.from_numpy(np.lexsort((-best.numpy(), frame.numpy(), track.numpy())))
    place = torch.stack([track[order], frame[order]], -1)
    fresh = torch.ones(len(order), dtype=torch.bool)
    fresh[1:] = (place[1:] != place[:-1]).any(-1)
    kept = order[fresh]
    pixel = nodes[kept] % pixels
    xy = torch.stack([pixel % width, pixel // width], -1)
    return MatchTracks(xyz / total[:, None], track[kept], frame[kept], xy)


def without(tracks: MatchTracks, dropped: Bool[Tensor, " o"]) -> MatchTracks:
    """Without some observations, then without points seen in fewer than 2 frames."""
    seen = torch.bincount(tracks.point[~dropped], minlength=len(tracks.xyz))
    return _selected(tracks, torch.nonzero(seen >= 2)[:, 0], ~dropped)


def most_seen(tracks: MatchTracks, most: int) -> MatchTracks:
    """At most so many points, those that are seen in most frames first."""
    if len(tracks.xyz) <= most:
        return tracks
    seen = torch.bincount(tracks.point, minlength=len(tracks.xyz))
    chosen = torch.argsort(seen, descending=True, stable=True)[:most].sort().values
    return _selected(tracks, chosen, torch.ones(len(tracks.point), dtype=torch.bool))


def _selected(tracks: MatchTracks, points: Int64[Tensor, " k"], observations: Bool[Tensor, " o"]) -> MatchTracks:
    """Some of the points with some of their observations."""
    number = torch.full((len(tracks.xyz),), -1)
    number[points] = torch.arange(len(points))
    kept = observations & (number[tracks.point] >= 0)
    return MatchTracks(tracks.xyz[points], number[tracks.point[kept]], tracks.frame[kept], tracks.xy[kept])


def as_points(
    tracks: MatchTracks, xy: Float[Tensor, "o 2"], cameras: Cameras, frames: Frames, order: Sequence[int]
) -> tuple[Points, Tracks]:
    """Points with colors and errors, and their tracks; `xy` and cameras are of the prepared frames, of which
    `frames.image(order[k])` is the k-th."""
    error = reprojection_errors(cameras, tracks.frame, xy, tracks.xyz[tracks.point])
    seen = torch.bincount(tracks.point, minlength=len(tracks.xyz)).clamp(min=1)
    mean = torch.zeros(len(tracks.xyz), dtype=torch.float64).index_add_(0, tracks.point, error) / seen
    color = torch.zeros(len(tracks.xyz), 3)
    x = xy[:, 0].long().clamp(0, frames.width - 1)
    y = xy[:, 1].long().clamp(0, frames.height - 1)
    for rows, i in zip(rows_of_frames(tracks.frame, len(order)), order, strict=True):
        color.index_add_(0, tracks.point[rows], frames.image(i)[y[rows], x[rows]])
    points = Points(tracks.xyz, color / seen[:, None], mean)
    return points, Tracks(tracks.point, tracks.frame, xy.double())
