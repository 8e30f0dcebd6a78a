"""The similarity from one visit to another: that of the localized frame with which most agree, then least squares.

A point of visit b, moved to visit a, must project onto the feature that sees it there, and the other way round. The
residuals count with the soft L1 norm, so that points on changed ground, which fit badly, do not pull. The covariance C
of the seven parameters x is the sandwich estimate with the frames of visit b as clusters: points of one frame share the
error of its pose, and do not count as independent. Where the georeferences of both runs tell a similarity, too, with
covariance C_g, the mean of both is taken:

    x = (C^-1 + C_g^-1)^-1 (C^-1 x_images + C_g^-1 x_g)

Corners of coded markers are points that need no verification; they tell the similarity where the images do not.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, Literal

import numpy as np
import torch
from jaxtyping import Bool, Float
from scipy.optimize import least_squares
from scipy.spatial.transform import Rotation

from swimm3r.cameras import project
from swimm3r.errors import RegistrationError
from swimm3r.products.survey import Survey
from swimm3r.scene.reconstruction import Reconstruction
from swimm3r.sim3 import Sim3, fit_similarity
from swimm3r.visits.alignment.localized import among, localized_frames
from swimm3r.visits.alignment.matches import VisitMatches

LEAST = 25  # points that agree
_LEAST_SHARE = 0.1  # of the verified matches: the adjustment brings in more, where models are bent
_LEAST_FRAMES = 3  # of either visit, with points that agree
_MAX_ERROR = 12.0  # pixels of an image of 1000; never less than _LEAST_ERROR
_LEAST_ERROR = 5.0
_TRIED = 60  # localized frames, those with the most matches
_BEND = 1.5  # pixels at which a residual begins to count less
_REFITS = 5
_LEAST_CODED = 8  # corners of markers, of which at least half agree: two markers


@dataclass(frozen=True)
class Known:
    """The similarity that the georeferences of two runs tell."""

    a_from_b: Sim3
    covariance: Float[np.ndarray, "7 7"]  # of log scale, turn about `pivot` and shift, as in `Alignment`
    pivot: Float[np.ndarray, "3"]

    def less(self, found: Sim3, pivot: Float[np.ndarray, "3"]) -> Float[np.ndarray, " 7"]:
        """The parameters about a pivot that lead from a similarity to this one."""
        off = self.a_from_b.after(found.inverse())
        turn = Rotation.from_matrix(off.R).as_rotvec()
        return np.concatenate([[np.log(off.scale)], turn, off(pivot) - pivot])

    def covariance_about(self, pivot: Float[np.ndarray, "3"]) -> Float[np.ndarray, "7 7"]:
        """The covariance with the turn about another pivot."""
        onto = np.eye(7)
        onto[4:] = _moves((pivot - self.pivot)[None])[0]
        return onto @ self.covariance @ onto.T


@dataclass(frozen=True)
class Alignment:
    """Visit a from visit b, in the files' coordinates of both."""

    source: Literal["images", "markers", "georeference"]
    a_from_b: Sim3
    covariance: Float[np.ndarray, "7 7"]  # of log scale, turn (rad) about `pivot` and shift, in a's axes and unit
    pivot: Float[np.ndarray, "3"]  # mean of the shared points, in a
    inlier: Bool[np.ndarray, " n"]  # of the matches, once for every two points
    verified: Bool[np.ndarray, " n"]  # inliers, and others that agree with the pose of a localized frame
    matched: int  # pairs of points
    off_georeference: float | None = None  # distance of images and georeferences, in standard deviations

    def covariance_at(self, points: Float[np.ndarray, "n 3"]) -> Float[np.ndarray, "n 3 3"]:
        """Covariance of the places of points, in a's axes and unit, by the uncertainty of the alignment alone."""
        J = _moves(points - self.pivot)
        return J @ self.covariance @ J.transpose(0, 2, 1)


def align(
    a: Reconstruction, b: Reconstruction, matches: VisitMatches, names: tuple[str, str], known: Known | None = None
) -> Alignment:
    """The alignment of two visits by their matches, and by their georeferences; `names` are for messages.

    Raises RegistrationError where too few points agree: the dives show different places.
    """
    pairs = Pairs(a, b, matches)
    localized = localized_frames(a, b, matches, pairs.max_error)
    verified = among(matches, localized) | matches.coded
    distinct = matches.one_of_each(verified)
    verified &= distinct
    found = _most_agreed(pairs, [*_by_markers(pairs), *(each.a_from_b for each in localized[:_TRIED])], verified)
    if found is None:
        raise _apart(names, 0, int(distinct.sum()))
    for _ in range(_REFITS):
        inlier = distinct & (pairs.errors(found) < pairs.max_error)
        found = _refined(pairs, found, inlier)
        if np.array_equal(inlier, distinct & (pairs.errors(found) < pairs.max_error)):
            break
    inlier = distinct & (pairs.errors(found) < pairs.max_error)
    source = _source(matches, inlier, verified)
    if source is None:
        raise _apart(names, int(inlier.sum()), int(distinct.sum()))
    pivot = pairs.xyz_a[inlier].mean(0)
    covariance, off = _covariance(pairs, found, inlier, pivot), None
    if known is not None:
        found, covariance, off = _fused(found, covariance, pivot, known)
    return Alignment(source, found, covariance, pivot, inlier, inlier | verified, int(distinct.sum()), off)


def _fused(
    found: Sim3, covariance: Float[np.ndarray, "7 7"], pivot: Float[np.ndarray, "3"], known: Known
) -> tuple[Sim3, Float[np.ndarray, "7 7"], float]:
    """The mean of a similarity by images and of the known one, its covariance, and their distance in deviations."""
    x, other = known.less(found, pivot), known.covariance_about(pivot)
    gain = covariance @ np.linalg.inv(covariance + other)
    distance = float(np.sqrt(x @ np.linalg.solve(covariance + other, x) / len(x)))
    return _moved(found, gain @ x, pivot), covariance - gain @ covariance, distance


def _source(
    matches: VisitMatches, inlier: Bool[np.ndarray, " n"], verified: Bool[np.ndarray, " n"]
) -> Literal["images", "markers"] | None:
    """The kind of points that enough agree of; None for neither."""
    agreeing = matches.select(inlier)
    frames = min(len(np.unique(agreeing.frame_a)), len(np.unique(agreeing.frame_b)))
    if len(agreeing) >= max(LEAST, _LEAST_SHARE * verified.sum()) and frames >= _LEAST_FRAMES:
        return "images"
    coded = int(agreeing.coded.sum())
    return "markers" if coded >= max(_LEAST_CODED, matches.coded.sum() / 2) else None


def known_from(a: Survey, b: Survey) -> Known | None:
    """The similarity by georeferences; None where either run has none, or they are of different reference systems."""
    one, other = a.place, b.place
    if one.epsg is None or one.epsg != other.epsg or one.scale is None or other.scale is None:
        return None
    R = one.R.T @ other.R
    scale = other.scale / one.scale
    t = one.from_crs(other.to_crs(np.zeros(3)))
    stds = [np.array(place.origin_std or (1.0, 1.0, 1.0)) for place in (one, other)]
    turns = [np.radians(place.rotation_std_deg or (2.0, 2.0, 2.0)) for place in (one, other)]
    relative = sum((place.scale_std or 0.01) ** 2 for place in (one, other))
    covariance = np.zeros((7, 7))
    covariance[0, 0] = relative
    covariance[1:4, 1:4] = one.R.T @ np.diag(turns[0] ** 2 + turns[1] ** 2) @ one.R
    covariance[4:, 4:] = one.R.T @ np.diag(stds[0] ** 2 + stds[1] ** 2) @ one.R / one.scale**2
    return Known(Sim3(scale, R, t), covariance, t)


def by_georeference(known: Known) -> Alignment:
    """The alignment that georeferences alone tell."""
    none = np.zeros(0, bool)
    return Alignment("georeference", known.a_from_b, known.covariance, known.pivot, none, none, 0, 0.0)


class Pairs:
    """Matched points of two visits with the cameras that observe them."""

    def __init__(self, a: Reconstruction, b: Reconstruction, matches: VisitMatches) -> None:
        self.a, self.b, self.matches = a, b, matches
        self.xyz_a = a.points.xyz.double().numpy()[matches.point_a]
        self.xyz_b = b.points.xyz.double().numpy()[matches.point_b]
        longest = max(a.cameras.width, a.cameras.height, b.cameras.width, b.cameras.height)
        self.max_error = max(_LEAST_ERROR, _MAX_ERROR * longest / 1000)

    def residuals(self, found: Sim3, rows: np.ndarray) -> Float[np.ndarray, "n 4"]:
        """Reprojection errors in the frame of a (x, y), then of b, pixels; infinite behind a camera."""
        chosen = self.matches.select(rows)
        in_a, z_a = _projected(self.a, chosen.frame_a, found(self.xyz_b[rows]))
        in_b, z_b = _projected(self.b, chosen.frame_b, found.inverse()(self.xyz_a[rows]))
        out = np.column_stack([in_a - chosen.xy_a, in_b - chosen.xy_b])
        return np.where(((z_a > 0) & (z_b > 0))[:, None], out, np.inf)

    def errors(self, found: Sim3, rows: np.ndarray | None = None) -> Float[np.ndarray, " n"]:
        """The larger of both reprojection errors of each pair, or of some of them, pixels."""
        off = self.residuals(found, np.arange(len(self.matches)) if rows is None else rows)
        return np.maximum(np.linalg.norm(off[:, :2], axis=1), np.linalg.norm(off[:, 2:], axis=1))


def _by_markers(pairs: Pairs) -> list[Sim3]:
    """The similarity of the corners of coded markers that both visits have, where these tell one."""
    rows = np.flatnonzero(pairs.matches.coded)
    found = fit_similarity(pairs.xyz_b[rows], pairs.xyz_a[rows]) if len(rows) >= _LEAST_CODED else None
    return [] if found is None else [found]


def _most_agreed(pairs: Pairs, tried: Sequence[Sim3], verified: Bool[np.ndarray, " n"]) -> Sim3 | None:
    """The similarity with which most verified matches agree; None where too few do."""
    rows = np.flatnonzero(verified)
    best, most = None, 0
    for each in tried:
        agree = int((pairs.errors(each, rows) < 2 * pairs.max_error).sum())  # that of a single frame is a rough one
        if agree > most:
            best, most = each, agree
    return best if most >= _LEAST_CODED else None


def _refined(pairs: Pairs, start: Sim3, inlier: Bool[np.ndarray, " n"]) -> Sim3:
    (rows,) = np.nonzero(inlier)
    if len(rows) < _LEAST_CODED:
        return start
    pivot = pairs.xyz_a[rows].mean(0)
    found: Any = least_squares(
        lambda x: _finite(pairs.residuals(_moved(start, x, pivot), rows)).ravel(),
        np.zeros(7), x_scale=_steps(pairs, rows, pivot), loss="soft_l1", f_scale=_BEND, max_nfev=40,
    )  # fmt: skip
    return _moved(start, found.x, pivot)


def _covariance(
    pairs: Pairs, found: Sim3, inlier: Bool[np.ndarray, " n"], pivot: Float[np.ndarray, "3"]
) -> Float[np.ndarray, "7 7"]:
    """Cluster-robust covariance of the seven parameters; clusters are the frames of b."""
    (rows,) = np.nonzero(inlier)
    step = 1e-4 * _steps(pairs, rows, pivot)

    def residuals(x: np.ndarray) -> np.ndarray:
        return _finite(pairs.residuals(_moved(found, x, pivot), rows))

    ahead_behind = [residuals(d) - residuals(-d) for d in np.diag(step)]
    J = np.stack(ahead_behind, -1) / (2 * step)  # [n, 4, 7]
    r = residuals(np.zeros(7))
    weight = 1 / np.sqrt(1 + (r / _BEND) ** 2)
    bread = np.linalg.pinv(np.einsum("nkp,nk,nkq->pq", J, weight, J), hermitian=True)
    scores = np.einsum("nkp,nk->np", J, weight * r)
    frame = pairs.matches.frame_b[rows]
    clusters = np.unique(frame)
    sums = np.stack([scores[frame == f].sum(0) for f in clusters])
    few = len(clusters) / max(1, len(clusters) - 1)
    return few * bread @ (sums.T @ sums) @ bread


def _moves(arm: Float[np.ndarray, "n 3"]) -> Float[np.ndarray, "n 3 7"]:
    """Derivatives of points at an arm from the pivot by log scale, turn and shift."""
    J = np.zeros((len(arm), 3, 7))
    J[:, :, 0] = arm
    J[:, 0, 2], J[:, 0, 3] = arm[:, 2], -arm[:, 1]  # turn x arm
    J[:, 1, 1], J[:, 1, 3] = -arm[:, 2], arm[:, 0]
    J[:, 2, 1], J[:, 2, 2] = arm[:, 1], -arm[:, 0]
    J[:, :, 4:] = np.eye(3)
    return J


def _moved(start: Sim3, x: Float[np.ndarray, " 7"], pivot: Float[np.ndarray, "3"]) -> Sim3:
    """A similarity changed by log scale, turn about a pivot and shift."""
    grown, turn = float(np.exp(x[0])), Rotation.from_rotvec(x[1:4]).as_matrix()
    return Sim3(grown, turn, pivot - grown * turn @ pivot + x[4:]).after(start)


def _steps(pairs: Pairs, rows: np.ndarray, pivot: Float[np.ndarray, "3"]) -> Float[np.ndarray, " 7"]:
    """Changes of the parameters that move points by like amounts."""
    spread = float(np.sqrt(((pairs.xyz_a[rows] - pivot) ** 2).sum(1).mean()))
    return np.array([1e-2] * 4 + [1e-2 * spread] * 3)


def _finite(residuals: Float[np.ndarray, "n 4"]) -> Float[np.ndarray, "n 4"]:
    return np.nan_to_num(residuals, posinf=1e3, neginf=-1e3)


def _projected(
    rec: Reconstruction, frame: np.ndarray, xyz: Float[np.ndarray, "n 3"]
) -> tuple[Float[np.ndarray, "n 2"], Float[np.ndarray, " n"]]:
    """Pixels and z depths of points, each in its own frame."""
    xy, z = np.zeros((len(frame), 2)), np.zeros(len(frame))
    for i in np.unique(frame):
        mine = frame == i
        found, depth = project(rec.cameras[int(i)], torch.from_numpy(xyz[mine])[None])
        xy[mine], z[mine] = found[0].double().numpy(), depth[0].double().numpy()
    return xy, z


def _apart(names: tuple[str, str], agreeing: int, matches: int) -> RegistrationError:
    return RegistrationError(
        f"{names[1]} could not be aligned with {names[0]}: {agreeing} of {matches} matched points agree",
        cause="the dives show different places, overlap too little, or too little of the ground is unchanged",
        hint="dives that overlap by a third or more, seen from like heights and directions; or runs of more frames",
    )
