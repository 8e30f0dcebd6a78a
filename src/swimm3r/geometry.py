"""Rotations, similarity alignment, relative poses and epipolar geometry.

Conventions: OpenCV axes; poses are cam2world 4x4, x_world = R x_cam + C; quaternions wxyz; pixel centers at +0.5. The
relative pose "i from j" is W_i W_j^-1 with W = cam2world^-1: it takes camera j's coordinates to camera i's. Epipolar
geometry follows x_j^T F x_i = 0. Everything takes batch dimensions, keeps the dtype it is given and is differentiable.
"""

from dataclasses import dataclass
from typing import Literal

import torch
from jaxtyping import Float
from torch import Tensor
from torch.nn.functional import normalize

SymmetricForm = Literal["mean", "root_sum_square"]


class DegenerateAlignmentError(ValueError):
    """The points or poses do not determine the alignment that was asked for."""


@dataclass(frozen=True)
class Similarity:
    """x -> scale R x + t."""

    scale: Float[Tensor, ""]
    R: Float[Tensor, "3 3"]
    t: Float[Tensor, "3"]

    def points(self, points: Float[Tensor, "*b 3"]) -> Float[Tensor, "*b 3"]:
        """The points in the target frame."""
        return self.scale * points @ self.R.mT + self.t

    def poses(self, cam2world: Float[Tensor, "*b 4 4"]) -> Float[Tensor, "*b 4 4"]:
        """The poses in the target frame; rotation blocks stay rotations, so camera-space depths scale by `scale`."""
        # a scale inside the rotation block would leave depths in the old unit, and the water's attenuation with them
        return pose_from(self.R @ cam2world[..., :3, :3], self.points(cam2world[..., :3, 3]))

    def inverse(self) -> "Similarity":
        """The way back."""
        return Similarity(1 / self.scale, self.R.mT, -(self.R.mT @ self.t) / self.scale)


def rotation_from_quaternion(q: Float[Tensor, "*b 4"]) -> Float[Tensor, "*b 3 3"]:
    """Rotation matrices of wxyz quaternions, which need not be normalized (but not be zero)."""
    w, x, y, z = normalize(q, dim=-1).unbind(-1)
    rows = (
        torch.stack((1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)), -1),
        torch.stack((2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)), -1),
        torch.stack((2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)), -1),
    )
    return torch.stack(rows, -2)


def quaternion_from_rotation(R: Float[Tensor, "*b 3 3"]) -> Float[Tensor, "*b 4"]:
    """Unit wxyz quaternions with w >= 0."""
    (r00, r01, r02), (r10, r11, r12), (r20, r21, r22) = (row.unbind(-1) for row in R.unbind(-2))
    # four readings of the same quaternion, row k being 4 q_k q; the longest one is free of cancellation
    readings = torch.stack(
        (
            torch.stack((1 + r00 + r11 + r22, r21 - r12, r02 - r20, r10 - r01), -1),
            torch.stack((r21 - r12, 1 + r00 - r11 - r22, r01 + r10, r02 + r20), -1),
            torch.stack((r02 - r20, r01 + r10, 1 - r00 + r11 - r22, r12 + r21), -1),
            torch.stack((r10 - r01, r02 + r20, r12 + r21, 1 - r00 - r11 + r22), -1),
        ),
        -2,
    )
    longest = readings.diagonal(dim1=-2, dim2=-1).argmax(-1)
    q = normalize(readings.gather(-2, longest[..., None, None].expand(*longest.shape, 1, 4)).squeeze(-2), dim=-1)
    return torch.where(q[..., :1] < 0, -q, q)


def so3_exp(omega: Float[Tensor, "*b 3"]) -> Float[Tensor, "*b 3 3"]:
    """Rotation matrices of rotation vectors, radians (Rodrigues); smooth at zero."""
    squared = (omega * omega).sum(-1)[..., None, None]
    small = squared < 1e-8
    angle = torch.where(small, torch.ones_like(squared), squared).sqrt()
    sine = torch.where(small, 1 - squared / 6, angle.sin() / angle)
    versine = torch.where(small, 0.5 - squared / 24, 2 * ((angle / 2).sin() / angle) ** 2)
    W = skew(omega)
    return torch.eye(3, dtype=omega.dtype, device=omega.device) + sine * W + versine * (W @ W)


def so3_log(R: Float[Tensor, "*b 3 3"]) -> Float[Tensor, "*b 3"]:
    """Rotation vectors, radians, of length 0..pi; smooth at the identity, exact up to half a turn."""
    q = quaternion_from_rotation(R)
    w, v = q[..., :1], q[..., 1:]
    squared = (v * v).sum(-1, keepdim=True)
    small = squared < 1e-16
    sine = torch.where(small, torch.ones_like(squared), squared).sqrt()
    return v * torch.where(small, 2 / w.clamp(min=0.5), 2 * torch.atan2(sine, w) / sine)


def rotation_from_6d(columns: Float[Tensor, "*b 6"]) -> Float[Tensor, "*b 3 3"]:
    """Gram-Schmidt of two 3-vectors, the first two columns of the rotation (Zhou et al. 2019); identity 100 010."""
    x = normalize(columns[..., :3], dim=-1)
    y = normalize(columns[..., 3:] - (x * columns[..., 3:]).sum(-1, keepdim=True) * x, dim=-1)
    return torch.stack((x, y, torch.linalg.cross(x, y)), -1)


def rotation_to_6d(R: Float[Tensor, "*b 3 3"]) -> Float[Tensor, "*b 6"]:
    """The first two columns."""
    return torch.cat((R[..., :, 0], R[..., :, 1]), -1)


def rotation_angle(R: Float[Tensor, "*b 3 3"]) -> Float[Tensor, "*b"]:
    """Angle of each rotation, radians, 0..pi; accurate at both ends, unlike acos of the trace."""
    twice_axis = torch.stack(
        (R[..., 2, 1] - R[..., 1, 2], R[..., 0, 2] - R[..., 2, 0], R[..., 1, 0] - R[..., 0, 1]), -1
    )
    return torch.atan2(twice_axis.norm(dim=-1), R.diagonal(dim1=-2, dim2=-1).sum(-1) - 1)


def mean_rotation(rotations: Float[Tensor, "n 3 3"]) -> Float[Tensor, "3 3"]:
    """The chordal mean: the rotation with the least sum of squared Frobenius distances."""
    return _nearest_rotation(rotations.sum(0))


def skew(v: Float[Tensor, "*b 3"]) -> Float[Tensor, "*b 3 3"]:
    """[v]x, with [v]x u = v x u."""
    x, y, z = v.unbind(-1)
    o = torch.zeros_like(x)
    rows = (torch.stack((o, -z, y), -1), torch.stack((z, o, -x), -1), torch.stack((-y, x, o), -1))
    return torch.stack(rows, -2)


def pose_from(R: Float[Tensor, "*b 3 3"], t: Float[Tensor, "*b 3"]) -> Float[Tensor, "*b 4 4"]:
    """4x4 of a rotation and a translation (for cam2world: the camera center)."""
    bottom = torch.tensor([0.0, 0.0, 0.0, 1.0], dtype=R.dtype, device=R.device).expand(*R.shape[:-2], 1, 4)
    return torch.cat((torch.cat((R, t[..., None]), -1), bottom), -2)


def invert_poses(poses: Float[Tensor, "*b 4 4"]) -> Float[Tensor, "*b 4 4"]:
    """world2cam of cam2world, and back."""
    Rt = poses[..., :3, :3].mT
    return pose_from(Rt, -(Rt @ poses[..., :3, 3:]).squeeze(-1))


def relative_poses(
    cam2world_i: Float[Tensor, "*b 4 4"], cam2world_j: Float[Tensor, "*b 4 4"]
) -> Float[Tensor, "*b 4 4"]:
    """W_i W_j^-1, from camera j's coordinates to camera i's; its translation is the center of j seen from i."""
    to_i = cam2world_i[..., :3, :3].mT
    baseline = cam2world_j[..., :3, 3:] - cam2world_i[..., :3, 3:]  # exact zero for one center, far from the origin too
    return pose_from(to_i @ cam2world_j[..., :3, :3], (to_i @ baseline).squeeze(-1))


def align_similarity(
    source: Float[Tensor, "n 3"], target: Float[Tensor, "n 3"], min_flatness: float = 1e-3
) -> Similarity:
    """The similarity with the least squared error from `source` to `target` (Umeyama 1991).

    Points on a line leave the turn about it open: DegenerateAlignmentError when fewer than 3 points come, or when in
    either set the spread across the main direction is under `min_flatness` of the spread along it (`align_poses` can
    still align such a track).
    """
    if len(source) < 3:
        raise DegenerateAlignmentError(f"a similarity needs at least 3 points, got {len(source)}")
    for name, points in (("source", source), ("target", target)):
        spread = torch.linalg.svdvals(points - points.mean(0))
        if not torch.isfinite(spread).all():
            raise ValueError(f"the {name} points are not all finite")
        if spread[1] <= min_flatness * spread[0]:
            raise DegenerateAlignmentError(f"the {name} points lie on a line or on one spot; spreads {spread.tolist()}")
    return _umeyama(source, target)


def align_poses(source: Float[Tensor, "n 4 4"], target: Float[Tensor, "n 4 4"]) -> Similarity:
    """The similarity from `source` to `target` cam2world poses: turn from the orientations, then scale and shift.

    The rotation is the chordal mean of R_target R_source^T, so a straight track is enough, unlike for
    `align_similarity`; scale and translation are the least-squares fit of the centers under it. Raises
    DegenerateAlignmentError for fewer than 2 distinct centers, which hold no scale, and for tracks that run against
    their orientations, where the best scale is not positive.
    """
    rotations, centers = source[:, :3, :3], source[:, :3, 3]
    target_rotations, target_centers = target[:, :3, :3], target[:, :3, 3]
    if len(source) < 2:
        raise DegenerateAlignmentError(f"the scale of a track needs at least 2 poses, got {len(source)}")
    R = mean_rotation(target_rotations @ rotations.mT)
    from_mean = (centers - centers.mean(0)) @ R.mT
    squared_spread = (from_mean**2).sum()
    if squared_spread <= 1e-18 * (centers**2).sum():
        raise DegenerateAlignmentError(f"the {len(source)} source centers are one spot, which holds no scale")
    scale = (from_mean * (target_centers - target_centers.mean(0))).sum() / squared_spread
    if not scale > 0:
        raise DegenerateAlignmentError(f"orientations and centers contradict each other: scale {scale.item():.3g}")
    return Similarity(scale, R, target_centers.mean(0) - scale * (R @ centers.mean(0)))


def best_similarity(source: Float[Tensor, "n 4 4"], target: Float[Tensor, "n 4 4"]) -> Similarity | None:
    """The similarity of the poses, of their centers where orientations contradict those, None where neither is fixed.

    A dive's centers alone leave its turn to a few percent of bending: on two reconstructions of ruie_cyan_slope the
    orientations are 3.5 degrees apart under the similarity of the centers, 0.4 under that of the poses.
    """
    try:
        return align_poses(source, target)
    except DegenerateAlignmentError:
        try:
            return align_similarity(source[:, :3, 3], target[:, :3, 3])
        except DegenerateAlignmentError:
            return None


def essential_from_poses(
    cam2world_i: Float[Tensor, "*b 4 4"], cam2world_j: Float[Tensor, "*b 4 4"]
) -> Float[Tensor, "*b 3 3"]:
    """E = [t]x R of "j from i", so that x_j^T E x_i = 0 for normalized image points; of the baseline's length."""
    j_from_i = relative_poses(cam2world_j, cam2world_i)
    return skew(j_from_i[..., :3, 3]) @ j_from_i[..., :3, :3]


def fundamental_from_poses(
    cam2world_i: Float[Tensor, "*b 4 4"],
    cam2world_j: Float[Tensor, "*b 4 4"],
    K_i: Float[Tensor, "*#b 3 3"],
    K_j: Float[Tensor, "*#b 3 3"],
) -> Float[Tensor, "*b 3 3"]:
    """F = K_j^-T E K_i^-1 with x_j^T F x_i = 0 in (undistorted) pixels."""
    E = essential_from_poses(cam2world_i, cam2world_j)
    return torch.linalg.inv(K_j).mT @ E @ torch.linalg.inv(K_i)


def epipolar_distances(
    F: Float[Tensor, "*#b 3 3"], xy_i: Float[Tensor, "*#b 2"], xy_j: Float[Tensor, "*#b 2"]
) -> Float[Tensor, "*b 2"]:
    """Distance of x_i from the line F^T x_j and of x_j from the line F x_i, pixels.

    No epsilon is added to the line normals: entries of F in pixels are about 1e-6, and the 1e-8 customary in other
    code is not small beside their squares. NaN where F is zero: cameras with one center have no epipolar lines.
    """
    F = F / F.flatten(-2).norm(dim=-1)[..., None, None]
    x_i, x_j = (torch.cat((xy, torch.ones_like(xy[..., :1])), -1) for xy in (xy_i, xy_j))
    line_j = (F @ x_i[..., None]).squeeze(-1)
    line_i = (F.mT @ x_j[..., None]).squeeze(-1)
    residual = (x_j * line_j).sum(-1).abs()
    smallest = torch.finfo(F.dtype).tiny  # only a point exactly on the epipole has no line
    return torch.stack([residual / line[..., :2].norm(dim=-1).clamp(min=smallest) for line in (line_i, line_j)], -1)


def symmetric_epipolar_error(
    F: Float[Tensor, "*#b 3 3"],
    xy_i: Float[Tensor, "*#b 2"],
    xy_j: Float[Tensor, "*#b 2"],
    form: SymmetricForm = "mean",
) -> Float[Tensor, "*b"]:
    """Both epipolar distances of a match as one number, pixels.

    `mean` is (d_i + d_j) / 2, `root_sum_square` is sqrt(d_i^2 + d_j^2) (3R-GS): sqrt 2 larger for equal distances.
    """
    distances = epipolar_distances(F, xy_i, xy_j)
    return distances.mean(-1) if form == "mean" else distances.norm(dim=-1)


def _umeyama(source: Float[Tensor, "n 3"], target: Float[Tensor, "n 3"]) -> Similarity:
    from_mean, to_mean = source - source.mean(0), target - target.mean(0)
    R = _nearest_rotation(to_mean.mT @ from_mean)
    scale = (to_mean * (from_mean @ R.mT)).sum() / (from_mean**2).sum()
    return Similarity(scale, R, target.mean(0) - scale * (R @ source.mean(0)))


def _nearest_rotation(M: Float[Tensor, "3 3"]) -> Float[Tensor, "3 3"]:
    """The rotation nearest to a matrix in the Frobenius norm."""
    U, _, Vt = torch.linalg.svd(M)
    handedness = torch.ones(3, dtype=M.dtype, device=M.device)
    handedness[2] = torch.sign(torch.linalg.det(U @ Vt))
    return (U * handedness) @ Vt
