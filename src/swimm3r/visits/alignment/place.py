"""All visits in the frame of the first: each aligned with an earlier one, then those with matches mapped jointly."""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from swimm3r.errors import RegistrationError
from swimm3r.products.survey import Survey
from swimm3r.progress import Progress
from swimm3r.sim3 import IDENTITY, Sim3
from swimm3r.visits.alignment.depth import with_depth
from swimm3r.visits.alignment.joint import CheckPoints, Link, map_jointly, moved, shape_similarity
from swimm3r.visits.alignment.markers import Corners, match_markers, with_markers
from swimm3r.visits.alignment.matches import Landmarks, VisitMatches, landmarks_of, match_visits
from swimm3r.visits.alignment.misfit import Fit, fit_of
from swimm3r.visits.alignment.similarity import Alignment, align, by_georeference, known_from
from swimm3r.visits.settings import VisitSettings

_CONTRADICTED = 3.0  # standard deviations between images and georeferences that are told


@dataclass(frozen=True)
class Placed:
    """A visit in the frame of the first."""

    survey: Survey
    first_from_own: Sim3  # from the coordinates of the run's files
    fit: Fit | None  # None for the first
    notes: tuple[str, ...] = ()


@dataclass(frozen=True)
class _Visit:
    """A visit with everything that others are matched with."""

    name: str
    survey: Survey  # its points and those of its markers
    landmarks: list[Landmarks]
    corners: Corners


@dataclass(frozen=True)
class _Start:
    """The similarity that brings a visit onto an earlier one, before joint mapping."""

    first_from_own: Sim3
    onto: int
    alignment: Alignment
    matches: VisitMatches  # verified


def place_visits(
    surveys: Sequence[Survey], names: Sequence[str], settings: VisitSettings, progress: Progress
) -> list[Placed]:
    """Every visit in the axes and the unit of the first one.

    Raises RegistrationError for a visit that cannot be aligned with any before it.
    """
    visits, notes = [], []
    for name, survey in zip(names, surveys, strict=True):
        with_corners, corners, left_out = survey, Corners(), []
        if settings.markers is not None:
            with_corners, corners, left_out = with_markers(survey, settings.markers, progress)
        landmarks = landmarks_of(survey, settings.matched_frames, progress)
        visits.append(_Visit(name, with_corners, landmarks, corners))
        notes.append([f"{name}: {note}" for note in left_out])
    starts: list[_Start | None] = [None]
    for k in range(1, len(visits)):
        starts.append(_start(visits, starts, k, settings, progress))
    progress("joint mapping", 0, 1)
    placed = _mapped(visits, starts)
    progress("joint mapping", 1, 1)
    for k, start in enumerate(starts):
        off = None if start is None else start.alignment.off_georeference
        if start is not None and off is not None and off > _CONTRADICTED:
            notes[k].append(
                f"the images place {names[k]} {off:.1f} standard deviations from where its georeference and that of"
                f" {names[start.onto]} do"
            )
    return [replace(each, notes=tuple(told)) for each, told in zip(placed, notes, strict=True)]


def _start(
    visits: Sequence[_Visit], starts: Sequence[_Start | None], k: int, settings: VisitSettings, progress: Progress
) -> _Start:
    """Visit k onto the earliest one that images or georeferences align it with."""
    refused: RegistrationError | None = None
    for j in range(k):
        first_from_j = IDENTITY if (before := starts[j]) is None else before.first_from_own
        there = replace(visits[j].survey, rec=moved(visits[j].survey.rec, first_from_j), place=visits[0].survey.place)
        matches = match_visits(visits[j].landmarks, visits[k].landmarks, settings, progress)
        matches = matches.and_also(match_markers(visits[j].corners, visits[k].corners))
        known = known_from(there, visits[k].survey)
        try:
            found = align(there.rec, visits[k].survey.rec, matches, (visits[j].name, visits[k].name), known)
        except RegistrationError as error:
            refused = refused or error
            if known is None:
                continue
            return _Start(known.a_from_b, j, by_georeference(known), matches.select(np.zeros(0, np.int64)))
        agree = found.inlier[found.verified]
        kept = replace(found, inlier=agree, verified=np.ones(len(agree), bool))
        return _Start(found.a_from_b, j, kept, matches.select(found.verified))
    assert refused is not None
    raise refused


def _mapped(visits: Sequence[_Visit], starts: Sequence[_Start | None]) -> list[Placed]:
    """The visits after joint mapping of those that matches connect."""
    place = visits[0].survey.place
    recs = [
        visit.survey.rec if start is None else moved(visit.survey.rec, start.first_from_own)
        for visit, start in zip(visits, starts, strict=True)
    ]
    worth: dict[int, tuple[CheckPoints, int, float]] = {}
    for group in _groups(starts):
        links = {
            k: Link(group.index(start.onto), group.index(k), start.matches, start.alignment.inlier)
            for k in group[1:]
            if (start := starts[k]) is not None
        }
        if not links:
            continue
        joint = map_jointly([recs[k] for k in group], list(links.values()))
        for k, rec in zip(group, joint.recs, strict=True):
            recs[k] = rec
        worth |= dict(zip(links, zip(joint.checks, joint.merged, joint.errors_px, strict=True), strict=True))
    placed = []
    for k, (visit, start, rec) in enumerate(zip(visits, starts, recs, strict=True)):
        own = shape_similarity(visit.survey.rec, rec)
        survey = replace(visit.survey, rec=with_depth(visit.survey.rec, rec, float(own.scale)), place=place)
        fit = None if start is None else fit_of(visits[start.onto].name, start.alignment, worth.get(k), place)
        placed.append(Placed(survey, own, fit))
    return placed


def _groups(starts: Sequence[_Start | None]) -> list[list[int]]:
    """Visits that matches connect, each group in the order of the visits."""
    groups: list[list[int]] = []
    for k, start in enumerate(starts):
        found = None
        if start is not None and len(start.matches):
            found = next(group for group in groups if start.onto in group)
        if found is None:
            groups.append([k])
        else:
            found.append(k)
    return groups
