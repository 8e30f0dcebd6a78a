"""Similarities of three-dimensional space as estimators of models use them: single ones, in numpy.

`swimm3r.geometry` has their differentiable kin, which moves poses, too.
"""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float


@dataclass(frozen=True)
class Sim3:
    """x -> scale R x + t."""

    scale: float
    R: Float[np.ndarray, "3 3"]
    t: Float[np.ndarray, "3"]

    def __call__(self, xyz: Float[np.ndarray, "*n 3"]) -> Float[np.ndarray, "*n 3"]:
        """The points in the target's axes."""
        return self.scale * xyz @ self.R.T + self.t

    def inverse(self) -> "Sim3":
        """The way back."""
        return Sim3(1 / self.scale, self.R.T, -(self.R.T @ self.t) / self.scale)

    def after(self, first: "Sim3") -> "Sim3":
        """`first`, then this one."""
        return Sim3(self.scale * first.scale, self.R @ first.R, self(first.t))


IDENTITY = Sim3(1.0, np.eye(3), np.zeros(3))


def fit_similarity(
    source: Float[np.ndarray, "n 3"], target: Float[np.ndarray, "n 3"], weights: Float[np.ndarray, " n"] | None = None
) -> Sim3 | None:
    """The similarity with the least squared error (Umeyama 1991); None where the points leave it open."""
    w = np.ones(len(source)) if weights is None else weights
    w = w / w.sum()
    mean_s, mean_t = w @ source, w @ target
    s, t = source - mean_s, target - mean_t
    U, spread, Vt = np.linalg.svd((t * w[:, None]).T @ s)
    variance = w @ (s**2).sum(1)
    if not spread[1] > 1e-6 * spread[0] or not variance > 0:
        return None
    flip = np.array([1.0, 1.0, np.sign(np.linalg.det(U @ Vt))])
    R = (U * flip) @ Vt
    scale = float(spread @ flip / variance)
    if not scale > 0:
        return None
    return Sim3(scale, R, mean_t - scale * R @ mean_s)
