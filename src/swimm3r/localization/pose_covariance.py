"""Uncertainty of a pose that was fitted to pixels of known points.

pycolmap refines a pose by the Cauchy loss c^2 log(1 + r^2 / c^2) of the distances r between pixels and reprojected
points, whose weights are w = 1 / (1 + r^2 / c^2). The covariance of such an M-estimate (Huber 1981, chapter 7) is

    D s^2 (J^T J)^-1,   s^2 = sum(w^2 r^2) / (2 n - 6) / mean(w^2)^2

with the Jacobian J of the n inliers' pixels: least squares, with a variance that the inliers' own residuals tell.
Neighboring points of a map err alike, so that n of them tell less than n. The design effect (Kish 1965)

    D = k / (k - 6) sum_cells g^T (s^2 J^T J)^-1 g / 6,   g = sum_cell J_i^T w_i (pixel_i - reprojected_i) / mean(w^2)

over the k cells of the image that hold inliers is 1 of independent errors; less is taken for 1. An error that all
points share, such as drift of the map, is not in the covariance.
"""

from dataclasses import replace

import torch
from jaxtyping import Float
from torch import Tensor

from swimm3r.cameras import Cameras, project
from swimm3r.geometry import pose_from, so3_exp

_LOSS_SCALE = 1.0  # pixels: c of pycolmap's AbsolutePoseRefinementOptions
_UNKNOWNS = 6
_CELLS = 6  # along the longer side of the image


def pose_jacobian(
    camera: Cameras, cam2world: Float[Tensor, "4 4"], points: Float[Tensor, "n 3"], step: float = 1e-5
) -> Float[Tensor, "n2 6"]:
    """Central differences of the points' pixels, rows u and v in turn, by the pose's turn and shift in camera axes."""
    columns = []
    for axis in torch.eye(6, dtype=torch.float64) * step:
        both = [pose_from(so3_exp(sign * axis[:3]), sign * axis[3:]) for sign in (1.0, -1.0)]
        views = [project(replace(camera, cam2world=(cam2world @ motion)[None]), points[None])[0][0] for motion in both]
        columns.append((views[0] - views[1]).flatten() / (2 * step))
    return torch.stack(columns, -1)


def pose_covariance(
    camera: Cameras, cam2world: Float[Tensor, "4 4"], points: Float[Tensor, "n 3"], pixels: Float[Tensor, "n 2"]
) -> Float[Tensor, "6 6"]:
    """Covariance of a pose refined by `absolute_pose`, in the order and the axes of ROS's PoseWithCovariance.

    Rows are the camera center's x, y, z in the unit of the map, then turns about the map's x, y and z axes in radians:
    the true pose is center + d and exp(a) R. `camera` is the image's lens, points and pixels are the inliers. Infinite
    where they do not determine a pose.
    """
    unknown = torch.full((_UNKNOWNS, _UNKNOWNS), torch.inf, dtype=torch.float64)
    off = pixels - project(replace(camera, cam2world=cam2world[None]), points[None])[0][0]
    squared = off.square().sum(-1)
    J = pose_jacobian(camera, cam2world, points)
    factor, fault = torch.linalg.cholesky_ex(J.mT @ J)
    if 2 * len(points) <= _UNKNOWNS or int(fault) or not bool(torch.isfinite(factor).all()):
        return unknown
    weight = 1 / (1 + squared / _LOSS_SCALE**2)
    slope = weight.square().mean()
    noise = (weight.square() * squared).sum() / (2 * len(points) - _UNKNOWNS) / slope**2
    inverse = torch.cholesky_inverse(factor)
    pulls = torch.einsum("nki,nk->ni", J.reshape(-1, 2, _UNKNOWNS), weight[:, None] * off) / slope
    R, none = cam2world[:3, :3], torch.zeros(3, 3, dtype=torch.float64)
    to_map = torch.cat([torch.cat([none, R], 1), torch.cat([R, none], 1)])
    return _design_effect(camera, pixels, pulls, inverse / noise) * noise * to_map @ inverse @ to_map.mT


def _design_effect(
    camera: Cameras, pixels: Float[Tensor, "n 2"], pulls: Float[Tensor, "n 6"], metric: Float[Tensor, "6 6"]
) -> float:
    """D of the equation above, at least 1."""
    side = max(camera.width, camera.height) / _CELLS
    column, row = (pixels / side).floor().unbind(-1)
    cells, cell = torch.unique(row * 10 * _CELLS + column, return_inverse=True)
    if len(cells) <= _UNKNOWNS:
        return 1.0
    summed = torch.zeros(len(cells), _UNKNOWNS, dtype=torch.float64).index_add_(0, cell, pulls)
    total = torch.einsum("ki,ij,kj->", summed, metric, summed) / _UNKNOWNS
    return max(1.0, float(total) * len(cells) / (len(cells) - _UNKNOWNS))
