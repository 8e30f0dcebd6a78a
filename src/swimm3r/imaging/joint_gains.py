"""Gains of all frames at once, from the colors that they give to the points they share.

In logarithms, point t in frame f is off from what is expected of it by

    delta_tf = sum_k w_k(x_tf) g_fk + c_t,    sum_f g_fk = 0

with terms w_k of the place x in the image, the constant 1 among them, gains g_f of each frame, and a change c_t of the
point. Frames and points by turns would take long to agree where frames share few points: here the c_t are eliminated,
and conjugate gradients, preconditioned by the frames' own blocks, find the g_f of weighted least squares.
"""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from scipy.sparse import csr_matrix

_STEPS, _CLOSE = 500, 1e-3  # of conjugate gradients, and the share of the first residual that they end at


@dataclass(frozen=True)
class GainEvidence:
    """The evidence of single frames on their own gains: the normal equations about no gain."""

    information: np.ndarray  # [f, k, k]
    products: np.ndarray  # [f, k, c], or [f, k, 1] for all channels


@dataclass(frozen=True)
class JointGains:
    """The gains of all frames, and the change of each observation's point."""

    gains: np.ndarray  # [f, k, c], 0 on average over frames
    changes: np.ndarray  # [o, c]


def joint_gains(
    delta: np.ndarray, terms: np.ndarray, weight: np.ndarray, point: np.ndarray, frame: np.ndarray, alone: GainEvidence
) -> JointGains:
    """The gains that observations (`delta` [o, c], `terms` [o, k], `weight` [o]) and every frame `alone` agree on.

    `point` [o] and `frame` [o] number what is observed, and the frame that shows it.
    """
    frames, terms_of_frame = alone.products.shape[:2]
    numbers = np.unique(point, return_inverse=True)[1]
    columns = frame[:, None] * terms_of_frame + np.arange(terms_of_frame)
    starts = np.arange(len(terms) + 1) * terms_of_frame
    A = csr_matrix((terms.ravel(), columns.ravel(), starts), shape=(len(terms), frames * terms_of_frame))
    to_frames = A.multiply(weight[:, None]).tocsr().T.tocsr()
    to_points = csr_matrix((weight, (numbers, np.arange(len(weight)))))
    of_point = np.asarray(to_points.sum(1)).clip(1e-12)

    def beyond_points(values: np.ndarray) -> np.ndarray:
        return values - ((to_points @ values) / of_point)[numbers]

    def normal(x: np.ndarray) -> np.ndarray:
        shared = (to_frames @ beyond_points(A @ x.reshape(-1, x.shape[-1]))).reshape(x.shape)
        return _centered(shared + alone.information @ x)

    blocks = np.linalg.inv(_own_information(terms, weight, frame, frames) + alone.information)
    right = (to_frames @ beyond_points(delta)).reshape(frames, terms_of_frame, -1) + alone.products
    gains = _solved(normal, _centered(right), lambda x: _centered(blocks @ x))
    left = delta - A @ gains.reshape(-1, delta.shape[1])
    return JointGains(gains, ((to_points @ left) / of_point)[numbers])


def _centered(gains: np.ndarray) -> np.ndarray:
    return gains - gains.mean(0)


def _own_information(terms: np.ndarray, weight: np.ndarray, frame: np.ndarray, frames: int) -> np.ndarray:
    """Sum of w t t' over the observations of each frame, [f, k, k]."""
    count = terms.shape[1]
    out = np.empty((frames, count, count))
    for i in range(count):
        for j in range(i, count):
            out[:, i, j] = out[:, j, i] = np.bincount(frame, weight * terms[:, i] * terms[:, j], minlength=frames)
    return out


def _solved(
    normal: Callable[[np.ndarray], np.ndarray], right: np.ndarray, near: Callable[[np.ndarray], np.ndarray]
) -> np.ndarray:
    """Conjugate gradients, of every channel by itself; `near` is about the inverse of `normal`."""

    def dot(a: np.ndarray, b: np.ndarray) -> np.ndarray:
        return np.einsum("fkc,fkc->c", a, b)

    x, left = np.zeros_like(right), right
    ahead = preconditioned = near(left)
    slope = dot(left, preconditioned)
    goal = _CLOSE**2 * slope
    for _ in range(_STEPS):
        if np.all(slope <= goal):
            break
        image = normal(ahead)
        step = slope / np.maximum(dot(ahead, image), 1e-300)
        x, left = x + step * ahead, left - step * image
        preconditioned = near(left)
        before, slope = slope, dot(left, preconditioned)
        ahead = preconditioned + slope / np.maximum(before, 1e-300) * ahead
    return x
