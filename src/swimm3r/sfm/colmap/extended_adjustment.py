"""Bundle adjustment with unknowns that COLMAP's has not: a lens of another kind, turns of the camera within a frame.

Poses, points and other unknowns u become those of the least

    sum 2 (sqrt(1 + |e_o|^2 / c^2) - 1) + sum (u_k / s)^2,

e_o the reprojection error of observation o in pixels under COLMAP's soft L1 loss of width c, and s the
prior standard deviation of the other unknowns, infinite without a prior. Steps are Levenberg and Marquardt's, points
eliminated first (Triggs et al. 2000, section 6).
"""

from dataclasses import dataclass, replace
from typing import Protocol, runtime_checkable

import numpy as np
from jaxtyping import Float, Int
from scipy import sparse
from scipy.sparse.linalg import splu
from scipy.spatial.transform import Rotation

_DAMPING, _LESS, _MOST = 1e-3, 1e-9, 1e6  # share by which diagonals are enlarged: at first, at least, before giving up
_FACTOR = 5  # by which damping falls after a step that lowers the sum, and rises otherwise
_CONVERGED = 1e-4  # share of the sum by which a step lowers it
_STAYING = 1e-9  # on all diagonals: frames, points and other unknowns that no observation is of stay


@dataclass(frozen=True)
class Bundle:
    """Poses, world to camera, points of the world and other unknowns."""

    R: Float[np.ndarray, "n 3 3"]
    t: Float[np.ndarray, "n 3"]
    xyz: Float[np.ndarray, "p 3"]
    others: Float[np.ndarray, " k"]


@runtime_checkable
class Observed(Protocol):
    """Observations o of points in frames, and how their errors follow from a bundle."""

    @property
    def frame(self) -> Int[np.ndarray, " o"]: ...

    @property
    def point(self) -> Int[np.ndarray, " o"]: ...

    @property
    def width(self) -> float:
        """c in pixels."""
        ...

    @property
    def prior_std(self) -> float:
        """s, in the units of the other unknowns."""
        ...

    def errors(self, bundle: Bundle) -> Float[np.ndarray, "o 2"]:
        """Reprojection errors in pixels."""
        ...

    def by_place(self, bundle: Bundle) -> Float[np.ndarray, "o 2 3"]:
        """Derivatives of the errors by the places of the points in the axes of the cameras."""
        ...

    def by_others(self, bundle: Bundle) -> sparse.csr_array:
        """Derivatives of the errors, [2 o, k], by the other unknowns."""
        ...


def places(bundle: Bundle, observed: Observed) -> Float[np.ndarray, "o 3"]:
    """Observed points in the axes of the cameras that show them."""
    turned = np.einsum("oij,oj->oi", bundle.R[observed.frame], bundle.xyz[observed.point])
    return turned + bundle.t[observed.frame]


def total(bundle: Bundle, observed: Observed) -> float:
    """The sum that is to become least."""
    squared = np.square(observed.errors(bundle) / observed.width).sum(-1)
    return float(2 * (np.sqrt(1 + squared) - 1).sum() + np.square(bundle.others / observed.prior_std).sum())


def adjusted(bundle: Bundle, observed: Observed, steps: int, *, points_stay: bool = False) -> Bundle:
    """The bundle of the least sum near this one, or that after so many steps; its points may be known and stay."""
    damping, before = _DAMPING, total(bundle, observed)
    for _ in range(steps):
        equations = _NormalEquations.of(bundle, observed)
        while True:
            trial = equations.step(bundle, damping, points_stay)
            after = total(trial, observed)
            if after < before:
                break
            damping *= _FACTOR
            if damping > _MOST:
                return bundle
        converged = before - after < _CONVERGED * before
        bundle, before, damping = trial, after, max(damping / _FACTOR, _LESS)
        if converged:
            break
    return bundle


def blocks(J: Float[np.ndarray, "o r k"], column: Int[np.ndarray, " o"], count: int) -> sparse.csr_array:
    """Jacobians of single observations as one sparse matrix with `count` groups of columns."""
    m, rows, k = J.shape
    indices = np.repeat((column[:, None] * k + np.arange(k))[:, None], rows, 1).reshape(-1)
    return sparse.csr_array((J.reshape(-1), indices, np.arange(m * rows + 1) * k), shape=(m * rows, count * k))


def division_jacobian(place: Float[np.ndarray, "o 3"]) -> Float[np.ndarray, "o 2 3"]:
    """Derivatives of (x / z, y / z)."""
    z = place[:, 2]
    out = np.zeros((len(z), 2, 3))
    out[:, 0, 0] = out[:, 1, 1] = 1 / z
    out[:, :, 2] = -place[:, :2] / z[:, None] ** 2
    return out


def pose_jacobian(place: Float[np.ndarray, "o 3"], by_place: Float[np.ndarray, "o 2 3"]) -> Float[np.ndarray, "o 2 6"]:
    """Derivatives by rotation vectors and shifts of the cameras, both after their poses in their own axes."""
    return np.concatenate([by_place @ -cross(place), by_place], -1)


def cross(v: Float[np.ndarray, "o 3"]) -> Float[np.ndarray, "o 3 3"]:
    """Matrices of the cross products of these vectors with others."""
    out = np.zeros((len(v), 3, 3))
    out[:, 2, 1], out[:, 0, 2], out[:, 1, 0] = v.T
    return out - np.swapaxes(out, 1, 2)


@dataclass(frozen=True)
class _NormalEquations:
    """[[A, W], [W^T, V]] (x, p) = (a, v) of poses with other unknowns, x of q = 6 n + k, and points."""

    A: sparse.csr_array  # q q
    W: sparse.csr_array  # q 3p
    V: Float[np.ndarray, "p 3 3"]
    a: Float[np.ndarray, " q"]
    v: Float[np.ndarray, " v"]

    @classmethod
    def of(cls, bundle: Bundle, observed: Observed) -> "_NormalEquations":
        error = observed.errors(bundle)
        root = (1 + np.square(error / observed.width).sum(-1)) ** -0.25 / observed.width  # of the loss's weight
        by_place = observed.by_place(bundle) * root[:, None, None]
        by_pose = pose_jacobian(places(bundle, observed), by_place)
        by_point = by_place @ bundle.R[observed.frame]
        by_others = sparse.diags_array(np.repeat(root, 2)) @ observed.by_others(bundle)
        to_points = blocks(by_point, observed.point, len(bundle.xyz))
        J = sparse.hstack([blocks(by_pose, observed.frame, len(bundle.R)), by_others], format="csr")
        error = (error * root[:, None]).reshape(-1)
        free = np.zeros(6 * len(bundle.R))
        prior = np.concatenate([free, np.full(len(bundle.others), observed.prior_std**-2.0)])
        V = np.zeros((len(bundle.xyz), 3, 3))
        np.add.at(V, observed.point, np.einsum("oij,oik->ojk", by_point, by_point))
        return cls(
            (J.T @ J + sparse.diags_array(prior)).tocsr(),
            (J.T @ to_points).tocsr(),
            V,
            -J.T @ error - prior * np.concatenate([free, bundle.others]),
            -to_points.T @ error,
        )

    def step(self, bundle: Bundle, damping: float, points_stay: bool) -> Bundle:
        """The bundle that the damped equations lead to."""
        A = self.A + sparse.diags_array(damping * self.A.diagonal() + _STAYING)
        if points_stay:
            return _moved(bundle, splu(A.tocsc()).solve(self.a), np.zeros_like(bundle.xyz))
        diagonal = np.einsum("pii->pi", self.V)
        V = self.V + (damping * diagonal + _STAYING)[:, :, None] * np.eye(3)
        inverse = blocks(np.linalg.inv(V), np.arange(len(V)), len(V))
        WV = self.W @ inverse
        x = splu((A - WV @ self.W.T).tocsc()).solve(self.a - WV @ self.v)
        return _moved(bundle, x, (inverse @ (self.v - self.W.T @ x)).reshape(-1, 3))


def _moved(bundle: Bundle, x: Float[np.ndarray, " q"], points: Float[np.ndarray, "p 3"]) -> Bundle:
    """A bundle by its poses' and other unknowns' steps x, and those of its points."""
    n = len(bundle.R)
    poses = x[: 6 * n].reshape(n, 6)
    turn = Rotation.from_rotvec(poses[:, :3]).as_matrix()
    return replace(
        bundle,
        R=turn @ bundle.R,
        t=np.einsum("nij,nj->ni", turn, bundle.t) + poses[:, 3:],
        xyz=bundle.xyz + points,
        others=bundle.others + x[6 * n :],
    )
