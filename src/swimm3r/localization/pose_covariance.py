"""Uncertainty of a pose that was fitted to pixels of known points.

pycolmap refines a pose by the Cauchy loss c^2 log(1 + r^2 / c^2) of the distances r between pixels and reprojected
points, whose weights are w = 1 / (1 + r^2 / c^2). The covariance of such an M-estimate (Huber 1981, chapter 7) is

    D s^2 (J^T J)^-1,   s^2 = sum(w^2 r^2) / (2 n - 6) / mean(w^2)^2

with the Jacobian J of the n inliers' pixels: least squares, with a variance that the inliers' own residuals tell.
Neighboring points of a map err alike, so that n of them tell less than n. The design effect (Kish 1965)

    D = k / (k - 6) sum_cells g^T (s^2 J^T J)^-1 g / 6,   g = sum_cell J_i^T w_i (pixel_i - reprojected_i) / mean(w^2)

over the k cells of the image that hold inliers is 1 of independent errors; less is taken for 1. An error that all
points share, such as drift of the map, is not in the covariance.

Of a camera that turned while its rows were exposed, the pixels are those of half time, and the turn is three unknowns
more: J has three columns more, 9 takes the place of 6, and J^T J + s^2 P that of J^T J, with P the inverse variances of
the turns that are expected. The pose's block of the inverse is the covariance for any turn.
"""

from dataclasses import replace

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from swimm3r.cameras import Cameras, project
from swimm3r.geometry import pose_from, so3_exp
from swimm3r.imaging.turned_rows import half_time_pixels
from swimm3r.sfm.colmap.shutter.turning import EXPECTED_TURN

_LOSS_SCALE = 1.0  # pixels: c of pycolmap's AbsolutePoseRefinementOptions
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


def turn_jacobian(
    camera: Cameras, filmed: Float[Tensor, "n 2"], turn: Float[np.ndarray, "3"], step: float = 1e-5
) -> Float[Tensor, "n2 3"]:
    """Central differences of pixels at half time, rows u and v in turn, by the turn while they were exposed."""
    columns = []
    for axis in np.eye(3) * step:
        later, sooner = (half_time_pixels(camera, filmed, turn + sign * axis) for sign in (1.0, -1.0))
        columns.append((later - sooner).flatten() / (2 * step))
    return torch.stack(columns, -1)


def pose_covariance(
    camera: Cameras,
    cam2world: Float[Tensor, "4 4"],
    points: Float[Tensor, "n 3"],
    pixels: Float[Tensor, "n 2"],
    turn: Float[np.ndarray, "3"] | None = None,
) -> Float[Tensor, "6 6"]:
    """Covariance of a pose refined by `absolute_pose`, in the order and the axes of ROS's PoseWithCovariance.

    Rows are the camera center's x, y, z in the unit of the map, then turns about the map's x, y and z axes in radians:
    the true pose is center + d and exp(a) R. `camera` is the image's lens, points and pixels are the inliers. Infinite
    where they do not determine a pose. With a `turn`, the pose is that of half time (`turned_pose`) and pixels are as
    filmed.
    """
    J, prior = pose_jacobian(camera, cam2world, points), torch.zeros(6, dtype=torch.float64)
    if turn is not None:
        J = torch.cat([J, -turn_jacobian(camera, pixels, turn)], 1)
        prior = torch.cat([prior, torch.full((3,), EXPECTED_TURN**-2, dtype=torch.float64)])
        pixels = half_time_pixels(camera, pixels, turn)
    off = pixels - project(replace(camera, cam2world=cam2world[None]), points[None])[0][0]
    squared, unknowns = off.square().sum(-1), len(prior)
    weight = 1 / (1 + squared / _LOSS_SCALE**2)
    slope = weight.square().mean()
    noise = (weight.square() * squared).sum() / (2 * len(points) - unknowns) / slope**2
    information = J.mT @ J + noise * prior.diag()
    factor, fault = torch.linalg.cholesky_ex(information)
    if 2 * len(points) <= unknowns or int(fault) or not bool(torch.isfinite(factor).all()):
        return torch.full((6, 6), torch.inf, dtype=torch.float64)
    inverse = torch.cholesky_inverse(factor)
    pulls = torch.einsum("nki,nk->ni", J.reshape(-1, 2, unknowns), weight[:, None] * off) / slope
    R, none = cam2world[:3, :3], torch.zeros(3, 3, dtype=torch.float64)
    to_map = torch.cat([torch.cat([none, R], 1), torch.cat([R, none], 1)])
    scale = _design_effect(camera, pixels, pulls, inverse / noise) * noise
    return scale * to_map @ inverse[:6, :6] @ to_map.mT


def _design_effect(
    camera: Cameras, pixels: Float[Tensor, "n 2"], pulls: Float[Tensor, "n p"], metric: Float[Tensor, "p p"]
) -> float:
    """D of the equation above, at least 1."""
    unknowns = len(metric)
    side = max(camera.width, camera.height) / _CELLS
    column, row = (pixels / side).floor().unbind(-1)
    cells, cell = torch.unique(row * 10 * _CELLS + column, return_inverse=True)
    if len(cells) <= unknowns:
        return 1.0
    summed = torch.zeros(len(cells), unknowns, dtype=torch.float64).index_add_(0, cell, pulls)
    total = torch.einsum("ki,ij,kj->", summed, metric, summed) / unknowns
    return max(1.0, float(total) * len(cells) / (len(cells) - unknowns))
