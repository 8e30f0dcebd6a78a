"""Coded markers that several visits have filmed: their corners are points of each visit, matched by their codes.

A corner counts like any other point: it is found to a fifth of a pixel, but what moves it is the error of the poses,
and that is the same for both.
"""

from collections.abc import Mapping
from dataclasses import dataclass, field, replace

import numpy as np
import torch

from swimm3r.products.survey import Survey
from swimm3r.progress import Progress
from swimm3r.scale.markers import find_markers, placed_markers
from swimm3r.scale.settings import MarkerFamily
from swimm3r.scale.sources import reprojection_noise
from swimm3r.scene.reconstruction import Points, Reconstruction, Tracks
from swimm3r.visits.alignment.matches import VisitMatches

Corner = tuple[int, int]  # id of a marker, number of its corner


@dataclass(frozen=True)
class Corners:
    """Corners of markers among the points of a visit."""

    point: Mapping[Corner, int] = field(default_factory=dict)  # index into Reconstruction.points
    frame: Mapping[Corner, int] = field(default_factory=dict)  # one that sees it
    xy: Mapping[Corner, tuple[float, float]] = field(default_factory=dict)  # there


def with_markers(survey: Survey, family: MarkerFamily, progress: Progress) -> tuple[Survey, Corners, list[str]]:
    """The visit with the corners of its markers as further points, and notes on markers that were left out."""
    rec = survey.rec
    sightings = find_markers(rec, survey.frames, family, progress=progress)
    placed, notes = placed_markers(rec, sightings, reprojection_noise(rec))
    point, frame, xy = {}, {}, {}
    xyz, tracks = [], []
    for marker, corners in sorted(placed.items()):
        for k, corner in enumerate(corners):
            number = len(rec.points.xyz) + len(xyz)
            xyz.append(corner.xyz)
            tracks += [(number, each.frame, *each.xy) for each in sightings[marker][k]]
            first = sightings[marker][k][0]
            point[marker, k], frame[marker, k], xy[marker, k] = number, first.frame, first.xy
    if not xyz:
        return survey, Corners(), notes
    extended = _extended(rec, np.array(xyz), np.array(tracks, np.float64))
    return replace(survey, rec=extended), Corners(point, frame, xy), notes


def match_markers(a: Corners, b: Corners) -> VisitMatches:
    """The corners that both visits have."""
    both = sorted(set(a.point) & set(b.point))
    return VisitMatches(
        np.array([a.point[each] for each in both], np.int64),
        np.array([b.point[each] for each in both], np.int64),
        np.array([a.frame[each] for each in both], np.int64),
        np.array([b.frame[each] for each in both], np.int64),
        np.array([a.xy[each] for each in both], np.float64).reshape(-1, 2),
        np.array([b.xy[each] for each in both], np.float64).reshape(-1, 2),
        np.ones(len(both), bool),
    )


def _extended(rec: Reconstruction, xyz: np.ndarray, tracks: np.ndarray) -> Reconstruction:
    """The reconstruction with further points; rows of `tracks` are point, frame, x and y."""
    points, old = rec.points, rec.tracks
    gray, error = torch.full((len(xyz), 3), 0.5), torch.zeros(len(xyz))
    rows = torch.from_numpy(tracks)
    return replace(
        rec,
        points=Points(
            torch.cat([points.xyz.double(), torch.from_numpy(xyz)]),
            torch.cat([points.rgb, gray.to(points.rgb)]),
            torch.cat([points.error, error.to(points.error)]),
        ),
        tracks=Tracks(
            torch.cat([old.point, rows[:, 0].to(old.point)]),
            torch.cat([old.frame, rows[:, 1].to(old.frame)]),
            torch.cat([old.xy, rows[:, 2:].to(old.xy)]),
        ),
    )
