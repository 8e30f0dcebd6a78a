"""The lens of a clip as a polynomial, where no model of COLMAP's explains its images.

Poses, points and the lens (`cameras`, POLYNOMIAL) are adjusted together (`extended_adjustment`). COLMAP's adjustment
has no such lens, and shifting observations in turn with it (`shutter.readout`) does not get there: poses take up most
of the bend.

A polynomial of 40 numbers fits its own observations better than a lens of 4. So one observation of each longer track is
left out of all adjustments, and their median error decides, first against the lens that there is, then by degree.
"""

import logging
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np
import torch
from jaxtyping import Bool, Float, Int
from scipy import sparse

from swimm3r.cameras import DISTORTION_PARAMETERS, EXPONENTS, Cameras
from swimm3r.progress import Progress, silent
from swimm3r.sfm.colmap.extended_adjustment import Bundle, adjusted, division_jacobian, places

if TYPE_CHECKING:
    import pycolmap

_WIDTH = 0.5  # px, of the loss
_GOOD = 0.25  # px; where observations are off by less there is nothing to explain
_LEAST_FRAMES = 6
_LEAST_HELD = 100  # observations left out, below which their median says little
_FEW, _MOST = 6_000, 30_000  # observations that are adjusted, on trial and then; of more, those of some points
_LONG = 5  # observations of a track of which one is left out
_TRIAL = 8  # steps on trial
_STEPS = 60  # at most
_TRIED = 0.8  # of the held-out error, to go on after the trial: models' clips have 0.94 to 1.08, bent ones 0.43 to 0.60
_BETTER = 0.8  # of the held-out error, for the polynomial to be the lens
_NEXT = 0.97  # of the held-out error, for its higher degree

_DEGREES = np.array(EXPONENTS).sum(1)

_STAGE = "lens beyond models"

log = logging.getLogger(__name__)


@dataclass(frozen=True)
class _Observed:
    """Observed pixels of points in frames, and the degree up to which their lens is unknown (0: it is held)."""

    frame: Int[np.ndarray, " m"]
    point: Int[np.ndarray, " m"]
    xy: Float[np.ndarray, "m 2"]
    degree: int = 0
    width: float = _WIDTH
    prior_std: float = np.inf

    def some(self, chosen: Bool[np.ndarray, " m"]) -> "_Observed":
        return replace(self, frame=self.frame[chosen], point=self.point[chosen], xy=self.xy[chosen])

    def errors(self, bundle: Bundle) -> Float[np.ndarray, "m 2"]:
        lens = _Lens.of(bundle)
        return lens.distorted(self._plane(bundle)) * lens.K[:2] + lens.K[2:] - self.xy

    def by_place(self, bundle: Bundle) -> Float[np.ndarray, "m 2 3"]:
        lens, at = _Lens.of(bundle), places(bundle, self)
        _, by_x, by_y = _monomials(at[:, :2] / at[:, 2:])
        bent = np.stack([by_x @ lens.bend.T, by_y @ lens.bend.T], 2) + np.eye(2)
        return (bent * lens.K[:2, None]) @ division_jacobian(at)

    def by_others(self, bundle: Bundle) -> sparse.csr_array:
        lens, plane = _Lens.of(bundle), self._plane(bundle)
        J = np.zeros((len(plane), 2, len(bundle.others)))
        if self.degree:
            distorted, value = lens.distorted(plane), _monomials(plane)[0] * (self.degree >= _DEGREES)
            for axis in range(2):
                J[:, axis, axis] = distorted[:, axis]
                J[:, axis, 2 + axis] = 1
                first = 4 + axis * len(EXPONENTS)
                J[:, axis, first : first + len(EXPONENTS)] = value * lens.K[axis]
        return sparse.csr_array(J.reshape(-1, J.shape[2]))

    def _plane(self, bundle: Bundle) -> Float[np.ndarray, "m 2"]:
        at = places(bundle, self)
        return at[:, :2] / at[:, 2:]


@dataclass(frozen=True)
class _Clip:
    """Poses, points and lens to begin with, and the observations that they are adjusted to and judged by."""

    start: Bundle
    fitted: _Observed
    judge: _Observed

    def adjusted(self, bundle: Bundle, degree: int, steps: int = _STEPS) -> Bundle:
        """A bundle adjusted with its lens up to a degree, 0 to hold it."""
        return adjusted(bundle, replace(self.fitted, degree=degree), steps)

    def error(self, bundle: Bundle) -> float:
        """Median error in pixels of the observations left out."""
        return float(np.median(np.linalg.norm(self.judge.errors(bundle), axis=1)))


@dataclass(frozen=True)
class _Lens:
    """u = f (x + sum a_ij x^i y^j) + c, with (x, y) on the plane z = 1: the other unknowns of a bundle."""

    K: Float[np.ndarray, "4"]  # fx, fy, cx, cy
    bend: Float[np.ndarray, "2 t"]

    @classmethod
    def of(cls, bundle: Bundle) -> "_Lens":
        return cls(bundle.others[:4], bundle.others[4:].reshape(2, -1))

    def distorted(self, plane: Float[np.ndarray, "m 2"]) -> Float[np.ndarray, "m 2"]:
        return plane + _monomials(plane)[0] @ self.bend.T


def bent_lens(model: "pycolmap.Reconstruction", progress: Progress) -> Cameras | None:
    """The lens of a model's only camera as a POLYNOMIAL in its pixels; None where its own model explains the images
    about as well, or is a fisheye, or where there are too few frames and observations to tell.
    """
    if len(model.reg_image_ids()) < _LEAST_FRAMES:
        return None
    progress(_STAGE, 0, 4)
    clip = _clip(model, _FEW)
    hopeful = clip is not None and len(clip.judge.point) >= _LEAST_HELD and _gains(clip)
    progress(_STAGE, 1, 4)
    clip = _clip(model, _MOST) if hopeful else None
    best = None if clip is None else _fitted(clip, progress)
    progress(_STAGE, 4, 4)
    return None if best is None else _camera_of(best, model)


def errors_left_out(model: "pycolmap.Reconstruction", progress: Progress = silent) -> dict[int, float] | None:
    """Median error of observations left out, px, under a model's own lens (0) and polynomials by their degree; None of
    a fisheye.
    """
    clip = _clip(model, _MOST)
    return None if clip is None else {k: clip.error(found) for k, found in _by_degree(clip, progress).items()}


def _gains(clip: _Clip) -> bool:
    """Return whether a few steps with a polynomial explain observations left out that as many without do not."""
    if clip.error(clip.start) < _GOOD:
        return False
    held, bent = (clip.error(clip.adjusted(clip.start, degree, _TRIAL)) for degree in (0, 3))
    return bent < _TRIED * held


def _by_degree(clip: _Clip, progress: Progress) -> dict[int, Bundle]:
    """The clip adjusted with its lens held, and with polynomials of degree 3 and 5."""
    found = {0: clip.adjusted(clip.start, 0)}
    for done, (before, degree) in enumerate(((0, 3), (3, 5)), 2):
        found[degree] = clip.adjusted(found[before], degree)
        progress(_STAGE, done, 4)
    return found


def _fitted(clip: _Clip, progress: Progress) -> Bundle | None:
    """The bundle with the lens that explains observations left out; None where that is the one that there is."""
    found = _by_degree(clip, progress)
    errors = {degree: clip.error(bundle) for degree, bundle in found.items()}
    told = ", ".join(f"{error:.3f} px under degree {degree}" for degree, error in errors.items())
    log.info("error of observations left out, under the lens as degree 0: %s", told)
    best = 5 if errors[5] < _NEXT * errors[3] else 3
    return found[best] if errors[best] < _BETTER * errors[0] else None


def _clip(model: "pycolmap.Reconstruction", most: int) -> _Clip | None:
    """A model as it is adjusted, of its observations about so many at most; None of a fisheye."""
    images = [model.images[i] for i in sorted(model.reg_image_ids())]
    lens = _as_polynomial(model.cameras[images[0].camera_id])
    if lens is None:
        return None
    number = {image.image_id: k for k, image in enumerate(images)}
    rng = np.random.default_rng(0)
    tracks = [point.track.elements for point in model.points3D.values()]
    xyz = np.array([point.xyz for point in model.points3D.values()]).reshape(-1, 3)
    share = most / max(1, sum(len(track) for track in tracks))
    chosen = [k for k in range(len(tracks)) if len(tracks[k]) > 2 and rng.random() < share]
    frame, point, xy, left_out = [], [], [], []
    for new, k in enumerate(chosen):
        out = rng.integers(len(tracks[k])) if len(tracks[k]) >= _LONG else -1
        for j, element in enumerate(tracks[k]):
            frame.append(number[element.image_id])
            point.append(new)
            xy.append(model.images[element.image_id].points2D[element.point2D_idx].xy)
            left_out.append(j == out)
    poses = [image.cam_from_world() for image in images]
    R, t = (np.array(part) for part in zip(*((p.rotation.matrix(), p.translation) for p in poses), strict=True))
    seen = _Observed(np.array(frame, np.int64), np.array(point, np.int64), np.array(xy).reshape(-1, 2))
    judge = np.array(left_out, bool)
    start = Bundle(R, t, xyz[chosen], np.concatenate([lens.K, lens.bend.ravel()]))
    return _Clip(start, seen.some(~judge), seen.some(judge))


def _as_polynomial(camera: "pycolmap.Camera") -> _Lens | None:
    """The polynomial that a lens of COLMAP's is; None of a fisheye."""
    params = list(camera.params)
    match camera.model.name:
        case "SIMPLE_RADIAL":
            K, (k1, k2, p1, p2) = [params[0], *params[:3]], (params[3], 0.0, 0.0, 0.0)
        case "OPENCV":
            K, (k1, k2, p1, p2) = params[:4], params[4:]
        case _:
            return None
    bend = np.zeros((2, len(EXPONENTS)))

    def add(axis: int, i: int, j: int, value: float) -> None:
        bend[axis, EXPONENTS.index((i, j))] += value

    for axis, (i, j) in enumerate(((1, 0), (0, 1))):
        for twice_x, twice_y, value in ((1, 0, k1), (0, 1, k1), (2, 0, k2), (1, 1, 2 * k2), (0, 2, k2)):
            add(axis, 2 * twice_x + i, 2 * twice_y + j, value)
    for axis, i, j, value in ((0, 1, 1, 2 * p1), (0, 2, 0, 3 * p2), (0, 0, 2, p2)):
        add(axis, i, j, value)
    for axis, i, j, value in ((1, 2, 0, p1), (1, 0, 2, 3 * p1), (1, 1, 1, 2 * p2)):
        add(axis, i, j, value)
    return _Lens(np.array(K), bend)


def _camera_of(bundle: Bundle, model: "pycolmap.Reconstruction") -> Cameras:
    camera = model.cameras[next(iter(model.images.values())).camera_id]
    lens = _Lens.of(bundle)
    fx, fy, cx, cy = lens.K
    K = torch.tensor([[[fx, 0, cx], [0, fy, cy], [0, 0, 1]]], dtype=torch.float64)
    assert lens.bend.size == len(DISTORTION_PARAMETERS["POLYNOMIAL"])
    distortion = torch.from_numpy(lens.bend.reshape(1, -1))
    return Cameras(K, distortion, torch.eye(4, dtype=torch.float64)[None], camera.width, camera.height, "POLYNOMIAL")


def _monomials(x: Float[np.ndarray, "m 2"]) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """x^i y^j of all exponents, and their derivatives by x and by y."""
    powers = [np.ones_like(x), x]
    for _ in range(4):
        powers.append(powers[-1] * x)
    value = np.stack([powers[i][:, 0] * powers[j][:, 1] for i, j in EXPONENTS], 1)
    by_x = np.stack([i * powers[max(i - 1, 0)][:, 0] * powers[j][:, 1] for i, j in EXPONENTS], 1)
    by_y = np.stack([j * powers[i][:, 0] * powers[max(j - 1, 0)][:, 1] for i, j in EXPONENTS], 1)
    return value, by_x, by_y
