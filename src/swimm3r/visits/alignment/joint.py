"""Joint mapping of visits: one bundle adjustment over the frames of all, which share the points on stable ground.

One similarity leaves the bends that each visit has of its own, and a bend looks like a change of the ground. Matched
points of two visits are one point with the observations of both; poses of all visits and the points move until they
reproject best, under the soft L1 norm. The frame and the unit stay those of the first visit: its points, in the median,
do not move.

Points whose error is several times the median one lie on changed ground, stones on a bank that has risen for example,
and would pull the visits apart: they are left out, and chosen anew as errors shrink with the bends. A share of the
others stays out as well: the distances between their places by either visit alone are the worth of the alignment (check
points, as surveyors call them).
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
import torch
from jaxtyping import Bool, Float, Int
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components

from swimm3r.cameras import project
from swimm3r.geometry import Similarity
from swimm3r.medium import rescale
from swimm3r.scene.reconstruction import Reconstruction
from swimm3r.sim3 import IDENTITY, Sim3, fit_similarity
from swimm3r.visits.alignment.bundle import Sites, adjusted, with_own_points
from swimm3r.visits.alignment.matches import VisitMatches

_CHECK_EVERY = 5  # shared places of which one is a check point
_ROUNDS = 4
_STABLE = 4.0  # median reprojection errors within which a shared point lies on stable ground
_LEAST_ERROR = 0.5  # pixels
_TRIMMED = 3.0  # median distances within which points tell the similarity of two shapes
_TRIMS = 5


@dataclass(frozen=True)
class Link:
    """Verified matches of two visits, whose reconstructions have been brought onto each other."""

    earlier: int  # indices of the visits
    later: int
    matches: VisitMatches  # the earlier visit's points first
    agree: Bool[np.ndarray, " n"]  # with the similarity of the visits


@dataclass(frozen=True)
class CheckPoints:
    """Shared points that took no part in the adjustment, placed by either visit alone, in the frame of the first."""

    xyz_a: Float[np.ndarray, "n 3"]
    xyz_b: Float[np.ndarray, "n 3"]

    def __len__(self) -> int:
        return len(self.xyz_a)


@dataclass(frozen=True)
class Joint:
    """Visits after joint mapping; points are where the frames of their own visit see them."""

    recs: tuple[Reconstruction, ...]
    checks: tuple[CheckPoints, ...]  # of each link
    merged: tuple[int, ...]  # matches of each link that became one point
    errors_px: tuple[float, ...]  # their median reprojection error


def map_jointly(recs: Sequence[Reconstruction], links: Sequence[Link]) -> Joint:
    """Adjust visits to the points that they share; links connect all of them with the first one."""
    held, found = _held_out(recs, links), tuple(recs)
    good = [link.agree for link in links]
    fits = [np.ones(len(link.matches), bool) for link in links]  # False for those that did not fit as one point
    for _ in range(_ROUNDS):
        good = [_near(errors, rows) for errors, rows in zip(_errors(found, links), good, strict=True)]
        merged = [a & b & ~out for a, b, out in zip(good, fits, held, strict=True)]
        joined = adjusted(found, _sites(recs, _selected(links, merged)))
        errors = _errors(joined, links)
        fits = [a & (~of | _near(e, of)) for a, e, of in zip(fits, errors, merged, strict=True)]
        found = _onto(recs[0], with_own_points(joined))
    checks = tuple(_check_points(found, link, out & a) for link, out, a in zip(links, held, good, strict=True))
    medians = tuple(float(np.median(e[of])) for e, of in zip(errors, merged, strict=True))
    return Joint(found, checks, tuple(int(of.sum()) for of in merged), medians)


def similarity(found: Sim3) -> Similarity:
    """The similarity as poses take it."""
    scale, R, t = (torch.as_tensor(value).double() for value in (found.scale, found.R, found.t))
    return Similarity(scale, R, t)


def moved(rec: Reconstruction, onto: Sim3) -> Reconstruction:
    """Cameras, points and water of a reconstruction in other axes and another unit; its depth maps stay as stored."""
    by = similarity(onto)
    cameras = replace(rec.cameras, cam2world=by.poses(rec.cameras.cam2world.double()))
    points = replace(rec.points, xyz=by.points(rec.points.xyz.double()))
    medium = None if rec.medium is None else rescale(rec.medium, float(onto.scale))
    return replace(rec, cameras=cameras, points=points, medium=medium)


def shape_similarity(source: Reconstruction, target: Reconstruction) -> Sim3:
    """The similarity that carries most points of a reconstruction to where the same ones are in another."""
    one, other = (rec.points.xyz.double().numpy() for rec in (source, target))
    rows = np.arange(len(one))
    found = IDENTITY
    for _ in range(_TRIMS):
        found = fit_similarity(one[rows], other[rows]) or found
        off = np.linalg.norm(found(one) - other, axis=1)
        rows = np.flatnonzero(off <= _TRIMMED * np.median(off))
    return found


def _onto(first: Reconstruction, recs: Sequence[Reconstruction]) -> tuple[Reconstruction, ...]:
    """The reconstructions in the frame and the unit that the first one had."""
    back = shape_similarity(recs[0], first)
    return tuple(moved(rec, back) for rec in recs)


def _errors(recs: Sequence[Reconstruction], links: Sequence[Link]) -> list[Float[np.ndarray, " n"]]:
    """For each link, the larger of both `track_errors` of its matches, points of either visit in the other's frames."""
    found = []
    for link in links:
        a, b, of = recs[link.earlier], recs[link.later], link.matches
        xyz_a, xyz_b = (rec.points.xyz[torch.from_numpy(i)] for rec, i in ((a, of.point_a), (b, of.point_b)))
        found.append(np.maximum(track_errors(a, of.point_a, xyz_b), track_errors(b, of.point_b, xyz_a)))
    return found


def track_errors(
    rec: Reconstruction, point: Int[np.ndarray, " n"], xyz: Float[torch.Tensor, "n 3"]
) -> Float[np.ndarray, " n"]:
    """Root mean square reprojection errors of points over the frames that observe them, if they were at `xyz`, pixels.

    A frame straight above a point sees no change of its height; others of its track do. Infinite behind a camera.
    """
    order = np.argsort(rec.tracks.point.numpy(), kind="stable")
    counts = np.bincount(rec.tracks.point.numpy(), minlength=len(rec.points.xyz))
    starts = np.cumsum(counts) - counts
    which = np.repeat(np.arange(len(point)), counts[point])
    within = np.arange(len(which)) - np.repeat(np.cumsum(counts[point]) - counts[point], counts[point])
    rows = order[starts[point][which] + within]
    frame, seen = rec.tracks.frame.numpy()[rows], rec.tracks.xy.double()[torch.from_numpy(rows)]
    squared = np.full(len(rows), np.inf)
    for i in np.unique(frame).tolist():
        mine = np.flatnonzero(frame == i)
        found, z = project(rec.cameras[i], xyz[torch.from_numpy(which[mine])].double()[None])
        off = ((found[0] - seen[torch.from_numpy(mine)]) ** 2).sum(-1).numpy()
        squared[mine] = np.where(z[0].numpy() > 0, off, np.inf)
    return np.sqrt(np.bincount(which, squared, len(point)) / np.maximum(counts[point], 1))


def _near(errors: Float[np.ndarray, " n"], typical: Bool[np.ndarray, " n"]) -> Bool[np.ndarray, " n"]:
    return errors <= max(_LEAST_ERROR, _STABLE * float(np.median(errors[typical])))


def _selected(links: Sequence[Link], rows: Sequence[Bool[np.ndarray, " n"]]) -> list[Link]:
    return [
        replace(link, matches=link.matches.select(of), agree=link.agree[of])
        for link, of in zip(links, rows, strict=True)
    ]


def _sites(recs: Sequence[Reconstruction], links: Sequence[Link]) -> Sites:
    """A number for every point of every visit, the same for points that are matched."""
    counts = [len(rec.points.xyz) for rec in recs]
    starts = np.concatenate([[0], np.cumsum(counts)])
    one = np.concatenate([starts[link.earlier] + link.matches.point_a for link in links]).astype(np.int64)
    other = np.concatenate([starts[link.later] + link.matches.point_b for link in links]).astype(np.int64)
    graph = coo_array((np.ones(len(one), bool), (one, other)), shape=(starts[-1], starts[-1]))
    labels: Int[np.ndarray, " p"] = connected_components(graph, directed=False)[1]
    return tuple(np.split(labels.astype(np.int64), starts[1:-1]))


def _held_out(recs: Sequence[Reconstruction], links: Sequence[Link]) -> list[Bool[np.ndarray, " n"]]:
    """True for the matches of every fifth shared place."""
    sites = _sites(recs, links)
    of_matches = [sites[link.earlier][link.matches.point_a] for link in links]
    order = np.unique(np.concatenate(of_matches), return_inverse=True)[1].reshape(-1)
    held = order % _CHECK_EVERY == 0
    return np.split(held, np.cumsum([len(rows) for rows in of_matches])[:-1])


def _check_points(recs: Sequence[Reconstruction], link: Link, rows: Bool[np.ndarray, " n"]) -> CheckPoints:
    chosen = link.matches.select(rows)
    a, b = (recs[i].points.xyz.double().numpy() for i in (link.earlier, link.later))
    return CheckPoints(a[chosen.point_a], b[chosen.point_b])
