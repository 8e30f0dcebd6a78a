"""Matches between two visits: keypoints on triangulated points of either, of frames that look alike.

Frames are compared by VLAD over a vocabulary learned from both visits; keypoints by SIFT, which sees gradients and not
the color of the water. Several pairs of frames may match the same two points.
"""

from collections.abc import Sequence
from dataclasses import dataclass, fields
from typing import Any

import numpy as np
import torch
from jaxtyping import Bool, Float, Int
from scipy.spatial import KDTree
from torch import Tensor

from swimm3r.io.colmap.model import silence_log
from swimm3r.products.survey import Survey
from swimm3r.progress import Progress, silent
from swimm3r.sfm.features import vlad
from swimm3r.sfm.features.settings import FeatureSettings
from swimm3r.sfm.features.sift import extract_features, match_descriptors, unit_descriptors
from swimm3r.visits.settings import VisitSettings

_SAME_KEYPOINT = 1.0  # pixels between an observation and the keypoint that it is


@dataclass(frozen=True)
class Landmarks:
    """Keypoints of one frame on points of its reconstruction."""

    frame: int  # index into Reconstruction.names
    descriptors: Float[Tensor, "n 128"]  # of unit length
    point: Int[np.ndarray, " n"]  # index into Reconstruction.points
    xy: Float[np.ndarray, "n 2"]  # pixels


@dataclass(frozen=True)
class VisitMatches:
    """Points of two visits that may be the same, a frame of either visit that observes each, and where."""

    point_a: Int[np.ndarray, " n"]
    point_b: Int[np.ndarray, " n"]
    frame_a: Int[np.ndarray, " n"]
    frame_b: Int[np.ndarray, " n"]
    xy_a: Float[np.ndarray, "n 2"]  # pixels
    xy_b: Float[np.ndarray, "n 2"]
    coded: Bool[np.ndarray, " n"]  # corners of coded markers, which cannot be taken for each other

    def __len__(self) -> int:
        return len(self.point_a)

    def select(self, rows: np.ndarray) -> "VisitMatches":
        """Some of the matches."""
        return VisitMatches(*(getattr(self, field.name)[rows] for field in fields(self)))

    def reversed(self) -> "VisitMatches":
        """The matches with the visits exchanged."""
        return VisitMatches(self.point_b, self.point_a, self.frame_b, self.frame_a, self.xy_b, self.xy_a, self.coded)

    def and_also(self, others: "VisitMatches") -> "VisitMatches":
        """These matches, then others of the same visits."""
        pairs = ((getattr(each, field.name) for each in (self, others)) for field in fields(self))
        return VisitMatches(*(np.concatenate(list(both)) for both in pairs))

    def one_of_each(self, preferred: Bool[np.ndarray, " n"]) -> Bool[np.ndarray, " n"]:
        """True for one match of every two points, a preferred one where there is any."""
        order = np.argsort(~preferred, kind="stable")
        first = np.unique(np.column_stack([self.point_a, self.point_b])[order], axis=0, return_index=True)[1]
        found = np.zeros(len(self), bool)
        found[order[first]] = True
        return found


def landmarks_of(survey: Survey, max_frames: int, progress: Progress = silent) -> list[Landmarks]:
    """The landmarks of a visit's frames, or of `max_frames` of them, spread evenly; those without any are left out."""
    silence_log()
    rec, frames, settings = survey.rec, survey.frames, FeatureSettings()
    count = len(rec.names)
    chosen = np.unique(np.linspace(0, count - 1, min(count, max_frames)).round().astype(int)).tolist()
    found = []
    for done, i in enumerate(chosen):
        progress(f"features of {survey.folder.name}", done, len(chosen))
        f = frames.index(rec.names[i])
        features = extract_features(frames.image(f), frames.mask(f), settings)
        rows = np.flatnonzero(rec.tracks.frame.numpy() == i)
        if not len(rows) or not len(features.keypoints):
            continue
        xy = rec.tracks.xy.numpy()[rows]
        closest: Any = KDTree(xy).query(features.keypoints[:, :2])
        distance, nearest = closest
        near = distance < _SAME_KEYPOINT
        if near.any():
            row = rows[nearest[near]]
            found.append(
                Landmarks(
                    i,
                    unit_descriptors(features.descriptors[near]),
                    rec.tracks.point.numpy()[row],
                    rec.tracks.xy.numpy()[row].astype(np.float64),
                )
            )
    progress(f"features of {survey.folder.name}", len(chosen), len(chosen))
    return found


def match_visits(
    a: Sequence[Landmarks], b: Sequence[Landmarks], settings: VisitSettings, progress: Progress = silent
) -> VisitMatches:
    """Matches between the landmarks of two visits, not yet verified."""
    max_ratio = FeatureSettings().max_ratio
    rows: list[np.ndarray] = []
    pairs = _alike(a, b, settings.candidates)
    for done, (i, j) in enumerate(pairs):
        progress("matching the visits", done, len(pairs))
        found = match_descriptors(a[i].descriptors, b[j].descriptors, max_ratio).numpy()
        one, other = a[i], b[j]
        ends = [one.point[found[:, 0]], other.point[found[:, 1]]]
        ends += [np.full(len(found), one.frame), np.full(len(found), other.frame)]
        rows.append(np.column_stack([*ends, one.xy[found[:, 0]], other.xy[found[:, 1]]]))
    progress("matching the visits", len(pairs), len(pairs))
    table = np.concatenate(rows) if rows else np.zeros((0, 8))
    whole, coded = table[:, :4].astype(np.int64), np.zeros(len(table), bool)
    return VisitMatches(whole[:, 0], whole[:, 1], whole[:, 2], whole[:, 3], table[:, 4:6], table[:, 6:8], coded)


def _alike(a: Sequence[Landmarks], b: Sequence[Landmarks], count: int) -> list[tuple[int, int]]:
    """Each frame of b with the `count` most similar ones of a, and the other way round."""
    if not a or not b:
        return []
    words = vlad.vocabulary([each.descriptors for each in (*a, *b)], torch.Generator().manual_seed(0))
    described_a, described_b = (torch.stack([vlad.summed(each.descriptors, words) for each in of]) for of in (a, b))
    likeness = described_a @ described_b.mT
    from_b = likeness.topk(min(count, len(a)), dim=0).indices
    from_a = likeness.topk(min(count, len(b)), dim=1).indices
    pairs = {(i, j) for j in range(len(b)) for i in from_b[:, j].tolist()}
    return sorted(pairs | {(i, j) for i in range(len(a)) for j in from_a[i].tolist()})
